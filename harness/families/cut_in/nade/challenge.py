"""Challenge: the probability that a surrogate crashes, given state and maneuver.

**Recursive, after the cut-in**: the probability that the surrogate rear-ends BV, by backward induction. BV drives
freely and redraws its acceleration every hold period; the surrogate reacts in every step. At redraw times the state
(v_BV, R2, R2dot) is Markov, so with ``h`` the hold period

    U_0 = 0,   U_{i+1}(s) = Σ_a p(a | v_BV) [1 if the pair collides while a is held, else U_i(s'(s, a))].

A surrogate that lags behind what it sees is late in the first period after the cut-in; from the second on it counts as
one who has known of the danger for long, which the state cannot tell. What is wrong with that costs tests alone.
Levels of U are stored about one second apart (time remaining in the episode); the challenge of a maneuver,
C(s, a) = 1 or U(s'), is stored for the longest remaining time. Where U of the time that remains is 0, no surrogate can
crash any more, and nothing is controlled.

**Immediate**, as published for NADE: whether the surrogate crashes if BV acts now and then keeps its speed. The
answer is yes or no, so what is tabulated is smooth: the smallest gap of the roll-out, which goes on below zero as if
the vehicles could overlap. Interpolated, it is negative where the surrogate crashes. Staying has challenge 0.

**Recursive, before the cut-in**: what *not* cutting in now is worth. The AV keeps its speed, so (v_BV, R2, R2dot)
moves with BV's acceleration alone. BV's wish to change lanes enters as the factor OL of the current state, held at
its present value. What is tabulated by backward induction over the hold periods is therefore the expected challenge
met per unit of OL,

    G_t(s) = Σ_a p̄(a | v_BV) { Σ_i Δt accept(R2_i, R2dot_i) C(s_i, cut_in) + G_{t+h}(s'_a) },

with C(s_i, cut_in) = U(state after the cut-in step), and p̄ the car-following accelerations averaged over the
naturalistic (R1, R1dot). Within a hold period the future is known; only its end needs the table.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import reduce

import numpy as np

from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.families.cut_in import laws
from harness.families.cut_in.laws import Environment, InitialStates, acceleration
from harness.families.cut_in.loading import evaluate_laws
from harness.families.cut_in.nade.grid import AFTER, BEFORE, GridPoints, interpolate, locate, points_of, state_at
from harness.families.cut_in.vocabulary import N_ACCELERATIONS, STATE_COLUMNS
from harness.processes import usable_cpus
from harness.vehicles.drivers import FVDM_KIND, SMALLEST_GAP_M, driver_acceleration, fvdm_acceleration, fvdm_shape
from harness.vehicles.kinematics import CONTACT_M, STEP_S, next_speed
from harness.vehicles.references import Memory, react
from harness.vocabulary import Float32Array, FloatArray, Record, RecordArray

LEVELS = 12
"""Seconds of remaining time that are told apart; later crashes are counted in the last level."""
COLLIDED = -1.0
LONG = 1000
"""Steps after which any driver has reacted."""


@compiled_inline
def lags(driver: Record) -> bool:
    """Whether what a driver does depends on more than what it sees in that step."""
    return bool(driver.kind < 0 or driver.delay_steps > 0 or driver.max_jerk_mps3 < math.inf)


@compiled_inline
def acts(driver: Record, memory: Memory, step: int, speed: float, lead_speed: float, r2: float) -> Memory:
    """Memory of a surrogate, with its acceleration, in a step after the cut-in."""
    acting = step - driver.delay_steps
    return memory if acting < 0 else react(driver, memory, acting, speed, lead_speed, r2)


@compiled_inline
def hold_period(
    speed: float, r2: float, r2dot: float, bv_acceleration: float, driver: Record, steps: int, first: int
) -> tuple[float, float, float]:
    """(v_BV, R2, R2dot) after ``steps`` steps of a held acceleration, with the surrogate following.

    v_BV is `COLLIDED` if the surrogate hit BV. The ``first`` step is the 0th after the cut-in, or comes `LONG` after.
    """
    follower = speed - r2dot
    memory = Memory(0.0, math.inf, driver.used_up_steps)
    if first == LONG and driver.kind < 0:  # brakes as hard as it can, as long as there is a danger
        memory = Memory(driver.min_acceleration_mps2, 0.0, driver.used_up_steps)
    for step in range(first, first + steps):
        memory = acts(driver, memory, step, follower, speed, r2)
        speed_after = next_speed(speed, bv_acceleration)
        follower_after = next_speed(follower, memory.acceleration)
        r2 += 0.5 * (speed + speed_after - follower - follower_after) * STEP_S
        speed, follower = speed_after, follower_after
        if r2 < CONTACT_M:
            return COLLIDED, r2, speed - follower
    return speed, r2, speed - follower


@compiled_threads
def transitions(driver: RecordArray, steps: int, first: int, points: GridPoints, out: Float32Array) -> None:
    """State one hold period later for every grid state and acceleration; ``out`` (v, R2, R2dot, 31, 3)."""
    for i, j, k in np.ndindex(out.shape[:3]):
        v, r2, r2dot = state_at(points, i, j, k)
        for m in range(N_ACCELERATIONS):
            after = hold_period(v, r2, r2dot, acceleration(m), driver[0], steps, first)
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


def level_steps(hold_steps: int) -> int:
    """Steps between two stored levels of U: the multiple of the hold period nearest to one second."""
    return hold_steps * max(1, round(10 / hold_steps))


def build_after_cut_in(environment: Environment, driver: RecordArray) -> tuple[Float32Array, Float32Array]:
    """Tables of one surrogate, ``driver`` (1,).

    U by remaining time (LEVELS + 1, v, R2, R2dot), level 0 being none; C(s, a) with the longest (v, R2, R2dot, 31).
    """
    points, hold = points_of(AFTER), int(environment.numbers["hold_steps"])
    after = np.empty((*AFTER.shape, N_ACCELERATIONS, 3), np.float32)
    transitions(driver, hold, LONG, points, after)
    late = None
    if lags(driver.view(np.recarray)[0]):
        transitions(driver, hold, 0, points, late := np.empty_like(after))
    return induced(environment, after, late)


def induced(
    environment: Environment, after: Float32Array, late: Float32Array | None = None
) -> tuple[Float32Array, Float32Array]:
    """The same, from the states ``after`` a hold period (v, R2, R2dot, 31, 3); ``late`` after the first, if it lags."""
    points, shape, hold = points_of(AFTER), AFTER.shape, int(environment.numbers["hold_steps"])
    at_speeds = np.pad(points.speed[:, None], ((0, 0), (0, 2)))  # R1 and R1dot do not matter
    pmf = evaluate_laws(environment, at_speeds).pmf[laws.FREE_DRIVING]
    value = np.zeros((LEVELS + 1, *shape), np.float32)
    current, following = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for level in range(1, LEVELS + 1):
        for _ in range(level_steps(hold) // hold):
            backward_step(after, pmf, current, following)
            current, following = following, current
        value[level] = current
        if late is not None:
            backward_step(late, pmf, following, value[level])  # from one period later on it has reacted
    maneuvers = np.empty((*shape, N_ACCELERATIONS), np.float32)
    maneuver_challenge(after, current, maneuvers)
    return value, maneuvers


_KEEP_SPEED = 20
"""Maneuver index of 0 m/s²."""
_NO_CONTACT_M = 1e3
_ROUNDING_MPS2 = 1e-9


@compiled_inline
def smallest_gaps(
    speed: float, r2: float, r2dot: float, m: int, hold: int, steps_per_level: int, driver: Record, out: FloatArray
) -> None:
    """Smallest gap (m) within every remaining time: ``out`` (levels + 1,), level 0 being none.

    BV takes the maneuver ``m`` for one hold period and then keeps its speed.
    """
    follower = speed - r2dot
    smallest = _NO_CONTACT_M
    out[0] = smallest
    gap_of_shape, shape = math.inf, 1.0
    lagging, memory = lags(driver), Memory(0.0, math.inf, driver.used_up_steps)
    for step in range((out.size - 1) * steps_per_level):
        # tanh takes most of FVDM's time. While the gap shrinks, the last value computed is an upper bound of
        # `fvdm_shape`: where the command is below the limit even for that, rounding included, it brakes fully.
        a = driver.min_acceleration_mps2
        if lagging:
            memory = acts(driver, memory, step, follower, speed, r2)
            a = memory.acceleration
        elif not (
            driver.kind == FVDM_KIND
            and r2 <= gap_of_shape
            and fvdm_acceleration(driver, follower, speed, shape) < a - _ROUNDING_MPS2
        ):
            a = driver_acceleration(driver, follower, speed, r2)
            if driver.kind == FVDM_KIND:
                gap_of_shape, shape = r2, fvdm_shape(driver, max(r2, SMALLEST_GAP_M))
        speed_after = next_speed(speed, acceleration(m) if step < hold else 0.0)
        follower_after = next_speed(follower, a)
        r2 += 0.5 * (speed + speed_after - follower - follower_after) * STEP_S
        speed, follower = speed_after, follower_after
        smallest = min(smallest, r2)
        if (step + 1) % steps_per_level == 0:
            out[(step + 1) // steps_per_level] = smallest


@compiled_threads
def roll_out(
    driver: RecordArray,
    hold: int,
    steps_per_level: int,
    points: GridPoints,
    value: Float32Array,
    maneuvers: Float32Array,
    least: Float32Array,
) -> None:
    """Fill ``maneuvers`` (v, R2, R2dot, 31) with smallest gaps (m), and by remaining time (levels + 1, v, R2, R2dot).

    ``value`` is that of keeping speed, ``least`` the smallest of all maneuvers.
    """
    by_level = np.empty(value.shape[0])
    least[:] = _NO_CONTACT_M
    for i, j, k, m in np.ndindex(maneuvers.shape):
        v, r2, r2dot = state_at(points, i, j, k)
        smallest_gaps(v, r2, r2dot, m, hold, steps_per_level, driver[0], by_level)
        maneuvers[i, j, k, m] = by_level[-1]
        for level in range(by_level.size):
            least[level, i, j, k] = min(least[level, i, j, k], by_level[level])
        if m == _KEEP_SPEED:
            value[:, i, j, k] = by_level


def build_immediate(environment: Environment, driver: RecordArray) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Tables of one surrogate, in metres: value, maneuvers (see `build_after_cut_in`), and least, shaped as value."""
    points, shape = points_of(AFTER), AFTER.shape
    hold = int(environment.numbers["hold_steps"])
    value, least = np.empty((2, LEVELS + 1, *shape), np.float32)
    maneuvers = np.empty((*shape, N_ACCELERATIONS), np.float32)

    def at_speed(i: int) -> None:
        row = slice(i, i + 1)
        points_of_row = points._replace(speed=points.speed[row])
        roll_out(driver, hold, level_steps(hold), points_of_row, value[:, row], maneuvers[row], least[:, row])

    with ThreadPoolExecutor(usable_cpus()) as threads:  # one surrogate may take as long as all others together
        list(threads.map(at_speed, range(points.speed.size)))
    return value, maneuvers, least


_NEGLIGIBLE = 1e-7
"""Accelerations rarer than this are left out of the induction (the table steers, it never enters a weight)."""


@compiled_inline
def level_of(step: int, max_steps: int, steps_per_level: int, levels: int) -> int:
    """Level of U that a cut-in in ``step`` has left: the cut-in itself takes one step."""
    return min((max_steps - step - 1) // steps_per_level, levels)


@compiled_inline
def remaining_level(step: int, max_steps: int, steps_per_level: int, levels: int) -> int:
    """Level of U after which nothing of a test can come that redraws in ``step``: rounded up."""
    return min((max_steps - step + steps_per_level - 1) // steps_per_level, levels)


@compiled_inline
def period_value(
    speed: float,
    r2: float,
    r2dot: float,
    bv_acceleration: float,
    step: int,
    steps_per_level: int,
    environment: Environment,
    value: Float32Array,
    later: Float32Array,
) -> float:
    """Expected challenge per unit of OL over one hold period and after it, with a known acceleration."""
    n = environment.numbers
    follower = speed - r2dot
    total = 0.0
    for i in range(n.hold_steps):
        if r2 <= 0.0:
            return total
        accepted = laws.acceptance(r2, speed - follower, environment)
        after = next_speed(speed, bv_acceleration)
        r2 += (0.5 * (speed + after) - follower) * STEP_S
        speed = after
        level = level_of(step + i, n.max_steps, steps_per_level, value.shape[0] - 1)
        total += STEP_S * accepted * interpolate(value[level], locate(AFTER, speed, r2, speed - follower))
    if r2 > 0.0:
        total += interpolate(later, locate(BEFORE, speed, r2, speed - follower))
    return total


@compiled_threads
def backward_period(
    step: int,
    steps_per_level: int,
    environment: Environment,
    value: Float32Array,
    pmf: FloatArray,
    points: GridPoints,
    later: Float32Array,
    out: Float32Array,
) -> None:
    """``out`` = G at ``step`` from ``later`` = G one hold period later; both (v, R2, R2dot)."""
    for i, j, k in np.ndindex(out.shape):
        v, r2, r2dot = state_at(points, i, j, k)
        total = 0.0
        for m in range(N_ACCELERATIONS):
            if pmf[i, m] > _NEGLIGIBLE:
                a = acceleration(m)
                total += pmf[i, m] * period_value(v, r2, r2dot, a, step, steps_per_level, environment, value, later)
        out[i, j, k] = total


def naturalistic_pmf(environment: Environment) -> FloatArray:
    """BV's accelerations at the grid speeds, averaged over (R1, R1dot): shape (v, 31)."""
    side = (np.arange(24) + 0.5) / 24
    gap_u, rate_u = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    sampler = InitialStates(environment.numbers)
    means = []
    for speed in points_of(BEFORE).speed.tolist():
        states = sampler.given_speed(speed, gap_u, rate_u)
        pmf = evaluate_laws(environment, np.column_stack([states[name] for name in STATE_COLUMNS[:3]])).pmf
        means.append(reduce(np.add, pmf[laws.CAR_FOLLOWING] / len(states)))  # one by one: the order decides on bits
    return np.array(means)


def build_before_cut_in(environment: Environment, value: Float32Array) -> Float32Array:
    """G of one surrogate at every redraw time, from its U after the cut-in: ``value`` (levels + 1, v, R2, R2dot).

    Its shape is (redraw times + 1, v, R2, R2dot); it is zero at R2 = 0 and at the end of the episode.
    """
    points, pmf = points_of(BEFORE), naturalistic_pmf(environment)
    hold, steps = int(environment.numbers["hold_steps"]), int(environment.numbers["max_steps"])
    periods = -(-steps // hold)
    law = unboxed(environment)
    table = np.zeros((periods + 1, *BEFORE.shape), np.float32)
    for period in range(periods - 1, -1, -1):
        later, out = table[period + 1], table[period]
        backward_period(period * hold, level_steps(hold), law, value, pmf, points, later, out)
    return table
