"""How a lane change shows itself: lateral motion from its onset to the step in which the other lane is taken.

States are counted as everywhere: a vehicle begins to move at the end of step ``onset``, overlaps at the end of step
``at = onset + lead``, and is at ``distance · (s - onset - 1) / lead`` in state s between them. A lead of zero is the
lane change of one step.
"""

from __future__ import annotations

import math

from harness.compiled import compiled_inline

TO_OVERLAP_M = 1.7
"""From a first lateral motion: a lane of 3.6 m less a car of 1.9 m [derived]."""
_ROUNDING = 1e-9


@compiled_inline
def onset_of(at: int, lead: int) -> int:
    """Step at whose end the vehicle begins to move sideways: at the earliest the first of the test."""
    return max(at - lead, 0)


@compiled_inline
def lateral_position(state: int, at: int, lead: int, distance_m: float) -> float:
    """How far (m) the vehicle has come over in a state between onset and overlap."""
    if state > at or lead == 0:
        return distance_m
    return distance_m * (state + lead - at - 1) / lead


@compiled_inline
def perceived_in(perceives_m: float, at: int, lead: int, distance_m: float) -> tuple[int, float]:
    """First step in which a driver may act who perceives a lateral motion of ``perceives_m``, or else the overlap.

    And the part of a step by which it was perceived earlier, for drivers whose delays need not be whole steps.
    """
    until = float(lead)
    if lead > 0 and perceives_m < distance_m:
        until = perceives_m * lead / distance_m
    perceived = max(at - lead + until, float(onset_of(at, lead)))
    first = math.ceil(perceived - _ROUNDING)
    return first + 1, max(first - perceived, 0.0)
