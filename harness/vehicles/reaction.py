"""How a driver gets from what its model wants to what it does: it may react late, change slowly, and remember."""

from __future__ import annotations

import math

from harness.compiled import compiled_inline, compiled_threads
from harness.random_stream import AV_DRAWS, uniform
from harness.vehicles.kinematics import STEP_S
from harness.vehicles.models import CAREFUL_COMPETENT_KIND, FUZZY_SAFETY_KIND, driver_acceleration
from harness.vehicles.references import Memory, careful_competent, fuzzy_safety, need_based
from harness.vocabulary import FloatArray, IntArray, Record, RecordArray


@compiled_inline
def reaction_steps(driver: Record, seed: int, episode: int) -> int:
    """Steps that pass after the cut-in before the driver reacts, its inattention in this episode included."""
    if driver.inattention_probability > 0.0 and uniform(seed, episode, AV_DRAWS, 0) < driver.inattention_probability:
        return int(driver.delay_steps + driver.inattention_steps)
    return int(driver.delay_steps)


@compiled_inline
def nothing_yet(used_up: float) -> Memory:
    """What a driver remembers before it acts: it has kept its speed, and seen no danger."""
    return Memory(0.0, math.inf, used_up)


@compiled_inline
def react(driver: Record, memory: Memory, step: int, speed: float, lead_speed: float, gap: float) -> Memory:
    """What a driver does in a step, as what it will remember of it.

    ``step`` counts from 0, the first one in which it acts.
    """
    danger = memory.danger
    if driver.kind >= 0:
        wanted = driver_acceleration(driver, speed, lead_speed, gap)
    elif driver.kind == CAREFUL_COMPETENT_KIND:
        wanted, danger = careful_competent(driver, memory, step, speed, lead_speed, gap)
    elif driver.kind == FUZZY_SAFETY_KIND:
        wanted, danger = fuzzy_safety(driver, memory, step, speed, lead_speed, gap)
    else:
        wanted, danger = need_based(driver, memory, step, speed, lead_speed, gap)
    change = driver.max_jerk_mps3 * STEP_S
    return Memory(min(max(wanted, memory.acceleration - change), memory.acceleration + change), danger, memory.used_up)


@compiled_threads
def expected_accelerations(
    driver: RecordArray, begin: IntArray, speed: FloatArray, lead_speed: FloatArray, gap: FloatArray, out: FloatArray
) -> None:
    """Accelerations of a driver that sees what was seen, but remembers its own acceleration.

    Starting from the observed acceleration of the step before, a driver that hardly changes it would seem to explain
    any vehicle.

    ``driver`` (1,) is without inattention; ``begin`` (m + 1,) says where each cut-in's steps begin, the cut-in step
    first, and the end. ``speed``, ``lead_speed`` (n,) are those of the vehicle and of the one that cut in (m/s),
    ``gap`` (n,) is bumper to bumper (m); ``out`` (n,) receives accelerations (m/s²).
    """
    for e in range(begin.size - 1):
        memory = nothing_yet(driver[0].used_up_steps)
        for i in range(begin[e], begin[e + 1]):
            step = i - begin[e] - driver[0].delay_steps - 1
            if step >= 0:
                memory = react(driver[0], memory, step, speed[i], lead_speed[i], gap[i])
            out[i] = memory.acceleration
