"""Naturalistic tests: nothing is made more frequent than it is."""

from __future__ import annotations

from harness.drawing.protocol import Source


class Naturalistic(Source):
    """Traffic as it is: tests without weights, of which few have a cut-in."""

    episodes_per_s = {"sumo": 3500, "sumo with shim": 6000, "twin": 70000}
    cut_ins_are_rare = True
