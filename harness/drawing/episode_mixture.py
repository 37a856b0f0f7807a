"""Whole episodes from one importance function each, of a surrogate or the defensive forced cut-in."""

from __future__ import annotations

from harness.drawing.protocol import Source


class EpisodeMixture(Source):
    """The importance function is drawn once per episode: the weight knows them all; the forced one bounds it."""

    episodes_per_s = {"sumo": 2000, "sumo with shim": 3000, "twin": 18000}
    uses_tables = True
