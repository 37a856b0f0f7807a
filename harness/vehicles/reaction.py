"""How a driver lags behind its model: it reacts late, changes its acceleration slowly, or does not look.

A driver keeps its speed until it reacts to the cut-in; then its model decides, as fast as its jerk limit allows.
"""

from __future__ import annotations

from harness.arrays import Record
from harness.compiled import compiled_inline
from harness.random_stream import AV_DRAWS, uniform
from harness.vehicles.kinematics import STEP_S
from harness.vehicles.models import driver_acceleration


@compiled_inline
def reaction_steps(driver: Record, seed: int, episode: int) -> int:
    """Steps that pass after the cut-in before the driver reacts, its inattention in this episode included."""
    if driver.inattention_probability > 0.0 and uniform(seed, episode, AV_DRAWS, 0) < driver.inattention_probability:
        return int(driver.delay_steps + driver.inattention_steps)
    return int(driver.delay_steps)


@compiled_inline
def reacting_acceleration(driver: Record, previous: float, speed: float, lead_speed: float, gap: float) -> float:
    """Acceleration (m/s²) of a driver that has reacted; ``previous`` is that of the step before, 0 until then."""
    wanted = driver_acceleration(driver, speed, lead_speed, gap)
    change = driver.max_jerk_mps3 * STEP_S
    return float(min(max(wanted, previous - change), previous + change))
