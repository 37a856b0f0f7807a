"""Motion within a step, and when two vehicles overlap, in exactly SUMO's floating-point form (ballistic update)."""

from __future__ import annotations

from harness.compiled import compiled_inline

STEP_S = 0.1
VEHICLE_LENGTH_M = 5.0
CONTACT_M = -0.001
"""SUMO flags a collision when the bumper gap is below minGap · factor − 0.001 m, here with minGap = 0."""


@compiled_inline
def next_speed(speed: float, acceleration: float) -> float:
    """Speed (m/s) after a step at constant acceleration; vehicles do not reverse."""
    return max(speed + acceleration * STEP_S, 0.0)


@compiled_inline
def next_position(position: float, speed: float, speed_after: float) -> float:
    """Position (m) after a step, operation by operation as SUMO computes it.

    SUMO turns the new speed into an acceleration and back, which costs a rounding, and treats a result below zero as
    a stop within the step. Where the speed changes little this is position + 0.5 (v + v_after) dt to the last bit;
    a vehicle that brakes to a standstill shows the difference.
    """
    change = (speed_after - speed) / STEP_S * STEP_S
    if speed + change >= 0.0:
        return position + (speed + 0.5 * change) * STEP_S
    return position - 0.5 * speed * speed / change * STEP_S


@compiled_inline
def gap(leader_position: float, follower_position: float) -> float:
    """Bumper-to-bumper gap (m) between front-bumper positions."""
    return leader_position - VEHICLE_LENGTH_M - follower_position


@compiled_inline
def overlaps(one_position: float, other_position: float) -> bool:
    """Whether two vehicles of one lane touch, whoever is ahead."""
    return gap(one_position, other_position) < CONTACT_M and gap(other_position, one_position) < CONTACT_M
