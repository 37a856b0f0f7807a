"""Drivers that remember a danger: the reference drivers of UN Regulation No. 157.

The careful and competent human (`r157-cc`) and the fuzzy safety model (`r157-fsm`) are written from the definitions
that their authors publish with them: K. Mattas et al., JRC-FSM (github.com/ec-jrc/JRC-FSM, commit 01b05c2), where the
former is that of the regulation's annex 4, appendix 3, and the latter that of K. Mattas et al., Accid. Anal. Prev. 148
(2020) 105794. Beside a danger both follow by an IDM: the lower of the two accelerations counts.

Times are in steps and need not be whole: in the step in which a delay ends, the acceleration is the mean of what comes
before and after, by their shares of it. So a driver changes continuously with its delay, and one of a whole number of
steps is that of the step-wise definition.

`react` is how any driver gets from what its model wants to what it does: late, no faster than its jerk, remembering.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from harness.compiled import compiled_inline
from harness.random_stream import AV_DRAWS, uniform
from harness.vehicles.drivers import CAREFUL_COMPETENT_KIND, SMALLEST_GAP_M, driver_acceleration, idm_acceleration
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import Record


class Memory(NamedTuple):
    """What a driver remembers from step to step.

    ``acceleration`` (m/s²) is that of the step before. ``danger`` is the step in which it perceived the danger that it
    reacts to, counted from the first in which it could act: infinite for none, negative for one seen before.
    ``used_up`` (steps) is how long before that first step it perceived that BV comes over.
    """

    acceleration: float
    danger: float
    used_up: float


@compiled_inline
def part_after(step: int, since: float, delay: float) -> float:
    """Part of a step that lies later than a delay after a moment, both in steps: 0 to 1."""
    return min(max(step + 1 - since - delay, 0.0), 1.0)


@compiled_inline
def changing(part: float, before: float, after: float) -> float:
    """Mean of a quantity over a step, which changes from ``before`` to ``after`` for the last ``part`` of it."""
    return (1.0 - part) * before + part * after


@compiled_inline
def following(driver: Record, headway_s: float, speed: float, lead_speed: float, gap: float) -> float:
    """Acceleration (m/s²) of the IDM by which a reference driver follows, at a time headway."""
    wanted = idm_acceleration(driver, headway_s, speed, lead_speed, max(gap, SMALLEST_GAP_M))
    hardest = max(driver.following_min_acceleration_mps2, driver.min_acceleration_mps2)
    return float(min(max(wanted, hardest), driver.max_acceleration_mps2))


@compiled_inline
def built_up(driver: Record, memory: Memory, idle: float, wanted: float) -> float:
    """The acceleration (m/s²) nearest to a wanted one that the brakes reach in a step, from no less than ``idle``."""
    hardest = min(memory.acceleration, idle) - driver.braking_jerk_mps3 * STEP_S
    return float(max(wanted, hardest))


@compiled_inline
def first_perceived(memory: Memory, step: int) -> float:
    """Step in which a danger was perceived that is new in ``step``; in step 0, while BV was still coming over."""
    return -memory.used_up if step == 0 else float(step)


@compiled_inline
def careful_competent(
    driver: Record, memory: Memory, step: int, speed: float, lead_speed: float, gap: float
) -> tuple[float, float]:
    """Acceleration (m/s²) of the careful and competent human, and the step since when there is a danger.

    From a time to collision below the critical one on, until it is no faster than the vehicle ahead, it takes its foot
    off, and brakes once its reaction time has passed, harder by the jerk.
    """
    danger = memory.danger
    if speed <= lead_speed:
        danger = math.inf
    elif danger == math.inf and gap < driver.critical_ttc_s * (speed - lead_speed):
        danger = first_perceived(memory, step)
    idle = 0.0 if danger == math.inf else max(-driver.coasting_mps2, driver.min_acceleration_mps2)
    follows = built_up(driver, memory, idle, following(driver, driver.time_headway_s, speed, lead_speed, gap))
    a = changing(part_after(step, -memory.used_up, driver.reaction_steps), idle, follows)
    if danger < math.inf:
        brakes = built_up(driver, memory, idle, driver.min_acceleration_mps2)
        a = min(a, changing(part_after(step, danger, driver.reaction_steps), idle, brakes))
    return a, danger


@compiled_inline
def between(distance: float, safe: float, unsafe: float) -> float:
    """How unsafe a distance is: 0 from ``safe`` on, 1 below ``unsafe``, linear between."""
    if distance >= safe:
        return 0.0
    if distance < unsafe:
        return 1.0
    return (safe - distance) / (safe - unsafe)


@compiled_inline
def proactive_metric(driver: Record, speed: float, lead_speed: float, gap: float) -> float:
    """PFS, 0 to 1: whether the vehicle ahead could brake, and the driver stop behind it in comfort, or at all."""
    reaction = speed * (driver.reaction_steps * STEP_S)
    leader = (lead_speed * lead_speed) / (2.0 * driver.leader_braking_mps2)
    squared = speed * speed
    safe = reaction + squared / (2.0 * driver.comfortable_braking_mps2) - leader + driver.safe_margin_m
    unsafe = reaction + squared / (2.0 * driver.hard_braking_mps2) - leader
    return between(gap - driver.standstill_gap_m, safe, unsafe)


@compiled_inline
def critical_metric(driver: Record, speed: float, lead_speed: float, gap: float, acceleration: float) -> float:
    """CFS, 0 to 1: whether it hits a vehicle that keeps its speed, if it brakes a reaction time from now."""
    closing = speed - lead_speed
    if closing <= 0.0:
        return 0.0
    delay = driver.reaction_steps * STEP_S
    a = max(acceleration, -driver.comfortable_braking_mps2)
    closing_then = closing + a * delay
    if closing_then < 0.0:  # what it does now is enough, if there is room
        return 1.0 if gap < (closing * closing) / (2.0 * abs(acceleration)) else 0.0
    reaction = (closing + a * delay / 2.0) * delay
    squared = closing_then * closing_then
    safe = reaction + squared / (2.0 * driver.comfortable_braking_mps2)
    unsafe = reaction + squared / (2.0 * driver.hard_braking_mps2)
    return between(gap, safe, unsafe)


@compiled_inline
def fuzzy_braking(driver: Record, memory: Memory, speed: float, lead_speed: float, gap: float) -> float:
    """Deceleration (m/s²) that the fuzzy safety model asks for; 0 if it feels safe."""
    critical = critical_metric(driver, speed, lead_speed, gap, memory.acceleration)
    b = driver.comfortable_braking_mps2
    if critical > 0.0:
        return float(critical * (driver.hard_braking_mps2 - b) + b)
    return float(proactive_metric(driver, speed, lead_speed, gap) * b)


@compiled_inline
def fuzzy_safety(
    driver: Record, memory: Memory, step: int, speed: float, lead_speed: float, gap: float
) -> tuple[float, float]:
    """Acceleration (m/s²) of the fuzzy safety model, and the step since when it has known of a danger.

    It waits once: whoever has braked watches the vehicle ahead.
    """
    danger = memory.danger
    wanted = fuzzy_braking(driver, memory, speed, lead_speed, gap)
    if wanted > 0.0 and danger == math.inf:
        danger = first_perceived(memory, step)
    follows = built_up(driver, memory, 0.0, following(driver, driver.time_headway_s, speed, lead_speed, gap))
    a = changing(part_after(step, -memory.used_up, driver.reaction_steps), 0.0, follows)
    if wanted > 0.0:
        brakes = built_up(driver, memory, 0.0, max(-wanted, driver.min_acceleration_mps2))
        a = min(a, changing(part_after(step, danger, driver.reaction_steps), 0.0, brakes))
    return a, danger


@compiled_inline
def still_cruises(cruises: bool, bv_overlaps: bool, acceleration: float) -> bool:
    """Whether a vehicle that cruises still does: until it first asks to brake (m/s²), or BV is on its lane.

    One rule for all kinds of vehicles. A controller that sees nobody ahead would else speed up, or not, by what it
    takes for its desired speed, and crash three times as often by that alone.
    """
    return cruises and not bv_overlaps and acceleration >= 0.0


@compiled_inline
def reaction_steps(driver: Record, seed: int, episode: int) -> int:
    """Steps that pass after the event before the driver reacts, its inattention in this episode included."""
    if driver.inattention_probability > 0.0 and uniform(seed, episode, AV_DRAWS, 0) < driver.inattention_probability:
        return int(driver.delay_steps + driver.inattention_steps)
    return int(driver.delay_steps)


@compiled_inline
def react(driver: Record, memory: Memory, step: int, speed: float, lead_speed: float, gap: float) -> Memory:
    """Memory of a driver, with its acceleration, after a step.

    ``step`` counts from 0, the first one in which it acts.
    """
    danger = memory.danger
    if driver.kind >= 0:
        wanted = driver_acceleration(driver, speed, lead_speed, gap)
    elif driver.kind == CAREFUL_COMPETENT_KIND:
        wanted, danger = careful_competent(driver, memory, step, speed, lead_speed, gap)
    else:
        wanted, danger = fuzzy_safety(driver, memory, step, speed, lead_speed, gap)
    change = driver.max_jerk_mps3 * STEP_S
    return Memory(min(max(wanted, memory.acceleration - change), memory.acceleration + change), danger, memory.used_up)
