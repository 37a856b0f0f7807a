"""What data leave open of who cuts in closely: numbers of the traffic at both ends of what they may be."""

from __future__ import annotations

from collections.abc import Mapping

from scipy.special import gammainc, gammaincinv

from harness.families.cut_in.parameters import EnvironmentParameters
from harness.families.cut_in.sections import SMALLEST_SHARE, AcceptanceSteps
from harness.families.protocol import LeftOpen

NOT_LOOKING = "cut_in__ignore_share"
STEP = "acceptance_steps__share__"
ONE_SIDED = 0.95
"""Quantile of a step's share that no replicate has drawn."""


def left_open(parameters: EnvironmentParameters) -> LeftOpen | None:
    """The range that is stated for who does not look, or shares of lane changes where none was seen."""
    number, steps = parameters.numbers().get(NOT_LOOKING), parameters.acceptance_steps
    if number is not None and number.range is not None:
        low, high = number.range
        return LeftOpen("", high, ({NOT_LOOKING: low}, {NOT_LOOKING: high}))
    if steps is not None and parameters.unseen:
        least = {f"{STEP}{step}": SMALLEST_SHARE for step in steps.without_events}
        return LeftOpen(parameters.unseen, None, (least, as_if_unseen({}, steps)))
    return None


def as_if_unseen(row: Mapping[str, float], steps: AcceptanceSteps) -> dict[str, float]:
    """A replicate with what zero events leave open upwards, in place of the draw that is right in the mean.

    In all steps without events, whichever carry a vehicle's rate: so what is found serves others, too. Draws are of
    (½)-gamma quantiles over the exposure; the same quantile of 1-gamma is what no event at all refuses.
    """
    moved = dict(row)
    for step in steps.without_events:
        name, exposure = f"{STEP}{step}", (steps.exposure or ())[step]
        below = float(gammainc(0.5, row[name] * exposure)) if name in row else ONE_SIDED
        moved[name] = min(float(gammaincinv(1.0, below)) / exposure, 1.0) if exposure > 0.0 else 1.0
    return moved
