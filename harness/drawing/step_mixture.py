"""Importance sampling of each control step by the mixture of surrogates, as published (NADE)."""

from __future__ import annotations

from harness.drawing.protocol import Source
from harness.estimators.block import MOMENT_COLUMNS


class StepMixture(Source):
    """At critical moments maneuvers are drawn from the mixture of the surrogates' importance functions."""

    episodes_per_s = {"sumo": 1600, "sumo with shim": 2700, "twin": 25000}
    moment_columns = MOMENT_COLUMNS
    uses_tables = True
