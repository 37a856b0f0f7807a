"""Drivers who follow a vehicle from the start of a test, and meet an event behind it.

Until the onset a driver follows by its model. From then on it keeps the acceleration that it has until it has perceived
the event and its delay is over; then its model decides again. It looks at the vehicle ahead on its lane, and at one
that the event reveals as soon as it has perceived that, whichever asks for less.

The reference driver of UN Regulation No. 157 is careful and competent as in `references`, with the danger of lead
braking: it has evaluated that ``risk_evaluation_s`` after it has seen the vehicle ahead brake harder than
``perceives_braking_mps2`` (for 0 it knows of the danger at the onset), and one revealed as late after it has seen it.
The IDM by which it follows waits for its reaction time after the onset, too: else it would react faster than a human.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from harness.compiled import compiled_inline
from harness.vehicles.drivers import (
    CAREFUL_COMPETENT_KIND,
    CONSTANT_KIND,
    IDM_KIND,
    SMALLEST_GAP_M,
    driver_acceleration,
    idm_acceleration,
)
from harness.vehicles.kinematics import STEP_S
from harness.vehicles.references import Memory, built_up, changing, following, part_after
from harness.vocabulary import Record

_ROUNDING = 1e-9


@compiled_inline
def headway_of(driver: Record, natural_s: float, speed: float) -> float:
    """Time headway T (s) of a driver: its own, or that with which its IDM keeps the natural one at a speed (m/s)."""
    if not math.isnan(driver.time_headway_s):
        return float(driver.time_headway_s)
    ratio = min(speed / driver.desired_speed_mps, 1.0)
    squared = ratio * ratio
    return float(max(natural_s * math.sqrt(1.0 - squared * squared) - driver.minimum_gap_m / speed, 0.0))


@compiled_inline
def seen_after(perceives_m: float, lateral_mps: float, clear: int) -> int:
    """Steps from the onset of a lateral motion (m/s) until it has reached ``perceives_m``, or is over (``clear``)."""
    return min(math.ceil(perceives_m / (lateral_mps * STEP_S) - _ROUNDING), clear)


@compiled_inline
def braking_seen_after(driver: Record) -> int:
    """Steps from the onset of braking until a driver can see it; the reference's times count from the onset itself."""
    return 0 if driver.kind == CAREFUL_COMPETENT_KIND else 1


class Ahead(NamedTuple):
    """A vehicle ahead, as a driver sees it: speed (m/s), gap (m), acceleration (m/s²) in the step before.

    The gap is infinite where nobody is there, or seen, and the speed then the driver's own.
    """

    speed: float
    gap: float
    acceleration: float


@compiled_inline
def behind(driver: Record, headway_s: float, speed: float, lead: Ahead) -> float:
    """Acceleration (m/s²) of a driver's model behind one vehicle."""
    if driver.kind < 0:
        return following(driver, headway_s, speed, lead.speed, lead.gap)
    if driver.kind != IDM_KIND:
        return driver_acceleration(driver, speed, lead.speed, lead.gap)
    wanted = idm_acceleration(driver, headway_s, speed, lead.speed, max(lead.gap, SMALLEST_GAP_M))
    return float(min(max(wanted, driver.min_acceleration_mps2), driver.max_acceleration_mps2))


@compiled_inline
def follow_on(
    driver: Record, headway_s: float, memory: Memory, since: int, late: bool, speed: float, lead: Ahead, revealed: Ahead
) -> Memory:
    """Memory of a driver, with its acceleration, after a step.

    ``since`` counts steps from the first in which it reacts to the event, and is negative before; it is ``late``
    between the onset and that.
    """
    before, danger = memory.acceleration, memory.danger
    if late or (driver.kind == CONSTANT_KIND and since < 0):
        return memory
    if driver.kind == CAREFUL_COMPETENT_KIND and since >= 0:
        wanted, danger = careful_competent(driver, headway_s, memory, since, speed, lead, revealed)
    else:
        wanted = behind(driver, headway_s, speed, lead)
        if revealed.gap < math.inf:
            wanted = min(wanted, behind(driver, headway_s, speed, revealed))
    change = driver.max_jerk_mps3 * STEP_S
    return Memory(min(max(wanted, before - change), before + change), danger, memory.used_up)


@compiled_inline
def careful_competent(
    driver: Record, headway_s: float, memory: Memory, since: int, speed: float, lead: Ahead, revealed: Ahead
) -> tuple[float, float]:
    """Acceleration (m/s²) of the careful and competent human, and the step in which the danger has been evaluated."""
    danger, is_revealed = memory.danger, revealed.gap < math.inf
    minded = revealed if is_revealed else lead
    if speed <= minded.speed:
        danger = math.inf
    else:
        hardest = driver.perceives_braking_mps2
        if danger == math.inf and (is_revealed or lead.acceleration < -hardest or hardest == 0.0):
            danger = since + driver.risk_evaluation_s / STEP_S
        if minded.gap < driver.critical_ttc_s * (speed - minded.speed):
            danger = min(danger, float(since))
    coasts = part_after(since, danger, 0.0)
    idle = changing(coasts, memory.acceleration, max(-driver.coasting_mps2, driver.min_acceleration_mps2))
    coasting = min(idle, 0.0)
    nearest = lead if lead.gap < revealed.gap else revealed
    follows = built_up(driver, memory, coasting, behind(driver, headway_s, speed, nearest))
    follows_on = part_after(since, 0.0, driver.reaction_steps)
    if coasts == 0.0:
        return changing(follows_on, idle, follows), danger
    brakes = built_up(driver, memory, coasting, driver.min_acceleration_mps2)
    braking = part_after(since, danger, driver.reaction_steps)  # within the other part: no danger is before the onset
    a = (1.0 - follows_on) * idle + (follows_on - braking) * min(idle, follows) + braking * brakes
    return a, danger
