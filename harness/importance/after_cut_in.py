"""Challenge after the cut-in: the probability that a surrogate rear-ends BV, by backward induction.

BV drives freely and redraws its acceleration every hold period; the surrogate reacts in every step. At redraw times the
state (v_BV, R2, R2dot) is Markov, so with ``h`` the hold period

    U_0 = 0,   U_{i+1}(s) = Σ_a p(a | v_BV) [1 if the pair collides while a is held, else U_i(s'(s, a))].

Levels of U are stored about one second apart (time remaining in the episode); the challenge of a maneuver,
C(s, a) = 1 or U(s'), is stored for the longest remaining time.
"""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled_inline, compiled_threads
from harness.importance.grid import AFTER, GridPoints, interpolate, locate, points_of, shape_of, state_at
from harness.maneuvers import N_ACCELERATIONS, acceleration
from harness.traffic.driving import Environment, acceleration_pmf, free_driving
from harness.vehicles.kinematics import CONTACT_M, STEP_S, next_speed
from harness.vehicles.models import driver_acceleration
from harness.vocabulary import Float32Array, FloatArray, RecordArray

LEVELS = 12
"""Seconds of remaining time that are told apart; later crashes are counted in the last level."""
COLLIDED = -1.0


@compiled_inline
def hold_period(
    speed: float, r2: float, r2dot: float, bv_acceleration: float, driver: RecordArray, steps: int
) -> tuple[float, float, float]:
    """(v_BV, R2, R2dot) after ``steps`` steps of a held acceleration, with the surrogate following.

    v_BV is `COLLIDED` if the surrogate hit BV.
    """
    follower = speed - r2dot
    for _ in range(steps):
        a = driver_acceleration(driver, follower, speed, r2)
        speed_after = next_speed(speed, bv_acceleration)
        follower_after = next_speed(follower, a)
        r2 += 0.5 * (speed + speed_after - follower - follower_after) * STEP_S
        speed, follower = speed_after, follower_after
        if r2 < CONTACT_M:
            return COLLIDED, r2, speed - follower
    return speed, r2, speed - follower


@compiled_threads
def transitions(driver: RecordArray, steps: int, points: GridPoints, out: Float32Array) -> None:
    """State one hold period later for every grid state and acceleration; ``out`` (v, R2, R2dot, 31, 3)."""
    for i, j, k in np.ndindex(out.shape[:3]):
        v, r2, r2dot = state_at(points, i, j, k)
        for m in range(N_ACCELERATIONS):
            after = hold_period(v, r2, r2dot, acceleration(m), driver[0], steps)
            out[i, j, k, m, 0], out[i, j, k, m, 1], out[i, j, k, m, 2] = after


@compiled_inline
def value_of(after: Float32Array, value: Float32Array) -> float:
    """1 if the pair collided, else the value of the state reached."""
    if after[0] == COLLIDED:
        return 1.0
    return interpolate(value, locate(AFTER, after[0], after[1], after[2]))


@compiled_threads
def backward_step(after: Float32Array, pmf: FloatArray, value: Float32Array, out: Float32Array) -> None:
    """One induction step: ``out`` = U_{i+1} from ``value`` = U_i; ``pmf`` (v, 31)."""
    for i, j, k in np.ndindex(out.shape):
        total = 0.0
        for m in range(N_ACCELERATIONS):
            if pmf[i, m] > 0.0:
                total += pmf[i, m] * value_of(after[i, j, k, m], value)
        out[i, j, k] = total


@compiled_threads
def maneuver_challenge(after: Float32Array, value: Float32Array, out: Float32Array) -> None:
    """C(s, a) for the 31 accelerations; ``out`` has shape (v, R2, R2dot, 31)."""
    for i, j, k, m in np.ndindex(out.shape):
        out[i, j, k, m] = value_of(after[i, j, k, m], value)


@compiled_threads
def free_driving_table(speeds: FloatArray, environment: Environment, out: FloatArray) -> None:
    """Free-driving probabilities at grid speeds; ``out`` (v, 31)."""
    for i in range(speeds.size):
        acceleration_pmf(free_driving(speeds[i], environment), environment, out[i])


def level_steps(hold_steps: int) -> int:
    """Steps between two stored levels of U: the multiple of the hold period nearest to one second."""
    return hold_steps * max(1, round(10 / hold_steps))


def build_after_cut_in(environment: Environment, driver: RecordArray) -> tuple[Float32Array, Float32Array]:
    """Tables of one surrogate, ``driver`` (1,).

    Returns
    -------
    value : ndarray of float32, shape (LEVELS + 1, v, R2, R2dot)
        U by remaining time, level 0 being none.
    maneuvers : ndarray of float32, shape (v, R2, R2dot, 31)
        C(s, a) with the longest remaining time.
    """
    points, shape = points_of(AFTER), shape_of(AFTER)
    hold = int(environment.numbers["hold_steps"])
    pmf = np.empty((points.speed.size, N_ACCELERATIONS))
    free_driving_table(points.speed, environment, pmf)
    after = np.empty((*shape, N_ACCELERATIONS, 3), np.float32)
    transitions(driver, hold, points, after)
    value = np.zeros((LEVELS + 1, *shape), np.float32)
    current, following = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for level in range(1, LEVELS + 1):
        for _ in range(level_steps(hold) // hold):
            backward_step(after, pmf, current, following)
            current, following = following, current
        value[level] = current
    maneuvers = np.empty((*shape, N_ACCELERATIONS), np.float32)
    maneuver_challenge(after, current, maneuvers)
    return value, maneuvers
