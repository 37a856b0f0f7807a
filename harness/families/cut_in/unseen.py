"""What data leave open of who cuts in closely: numbers of the traffic at both ends of what they may be."""

from __future__ import annotations

from harness.families.cut_in.parameters import EnvironmentParameters
from harness.families.cut_in.sections import SMALLEST_SHARE, STEP
from harness.families.protocol import LeftOpen

NOT_LOOKING = "cut_in__ignore_share"


def left_open(parameters: EnvironmentParameters) -> LeftOpen | None:
    """The range that is stated for who does not look, or shares of lane changes where none was seen."""
    number, steps = parameters.numbers().get(NOT_LOOKING), parameters.acceptance_steps
    if number is not None and number.range is not None:
        low, high = number.range
        return LeftOpen("", high, ({NOT_LOOKING: low}, {NOT_LOOKING: high}))
    if steps is not None and parameters.unseen:
        least = {f"{STEP}{step}": SMALLEST_SHARE for step in steps.without_events}
        return LeftOpen(parameters.unseen, None, (least, steps.as_if_unseen({})))
    return None
