"""What happens around a cut-in, walked without a world: LV and BV before it, BV after it, and who runs into BV.

Neither LV's nor BV's motion depends on the AV, before the cut-in or after it; only the hazard of the cut-in does. So a
trajectory can be walked before the episode is run, or after it, with the same draws and the same arithmetic, and with
any driver behind BV: beside an AV that keeps its speed until the cut-in, or one whose motion has been recorded.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_inline, compiled_threads
from harness.families.cut_in import laws
from harness.families.cut_in.laws import Environment, acceleration
from harness.families.cut_in.vocabulary import State
from harness.random_stream import BV_DRAWS, BV_FREE_DRAWS, LV_DRAWS, uniform
from harness.vehicles.drivers import MOST_FOLLOWERS, Followers
from harness.vehicles.kinematics import CONTACT_M, STEP_S, VEHICLE_LENGTH_M, gap, next_position, next_speed, overlaps
from harness.vehicles.references import Memory, react, still_cruises
from harness.vehicles.sideways import onset_of, perceived_in
from harness.vocabulary import AV, BV, LV, FloatArray, Int8Array, Record, RecordArray

AV_START_M = 100.0
NO_CRASH, WAS_AHEAD, FOLLOWS = -1, -2, -3
SAFE_M = 0.01
"""A gap that no rounding of positions makes a contact."""
FOLLOWER_DTYPE = np.dtype(
    [(name, np.int64) for name in ("driver", "encloses", "first", "end", "cruises")]
    + [(name, np.float64) for name in ("x", "v", "acceleration", "danger", "used_up")]
)


class Trajectory(NamedTuple):
    """Room for one; positions in m, speeds in m/s.

    ``lv``, ``bv`` (draws,) are maneuver indices before the cut-in, ``x``, ``v`` (steps + 1, 3) the motion of LV, BV, AV
    without it, and ``hazard`` (steps,) that of cutting in.
    ``free`` (draws,) are BV's maneuvers after the cut-in, ``x_after``, ``v_after`` (steps + 1,) its motion, and
    ``slowest`` (steps + 1,) the lowest speed that it will have from there on. ``follower`` (`MOST_FOLLOWERS`,) are
    those behind it.
    """

    lv: Int8Array
    bv: Int8Array
    x: FloatArray
    v: FloatArray
    hazard: FloatArray
    free: Int8Array
    x_after: FloatArray
    v_after: FloatArray
    slowest: FloatArray
    follower: RecordArray


def lengths(environment: Environment) -> tuple[int, int, int]:
    """Steps of an episode, those of a hold period, and how many maneuvers one vehicle can draw.

    The cut-in restarts BV's clock and is itself an entry of its path.
    """
    max_steps, hold_steps = int(environment.numbers["max_steps"]), int(environment.numbers["hold_steps"])
    return max_steps, hold_steps, -(-max_steps // hold_steps) + 2


def empty_trajectory(environment: Environment) -> Trajectory:
    """Room for a trajectory of an environment."""
    max_steps, _, draws = lengths(environment)
    motion = dict.fromkeys(("x", "v"), (max_steps + 1, 3))
    shapes = motion | {"lv": draws, "bv": draws, "free": draws, "hazard": max_steps, "follower": MOST_FOLLOWERS}
    kinds = dict.fromkeys(("lv", "bv", "free"), np.dtype(np.int8)) | {"follower": FOLLOWER_DTYPE}
    return Trajectory._make(
        np.zeros(shapes.get(name, max_steps + 1), kinds.get(name, np.dtype(np.float64))) for name in Trajectory._fields
    )


@compiled_inline
def place(state: State, x: FloatArray, v: FloatArray) -> None:
    """Positions and speeds (3,) of LV, BV, AV in an initial state; (3, n) in several."""
    x[AV] = AV_START_M
    x[BV] = AV_START_M + VEHICLE_LENGTH_M + state.r2_m
    x[LV] = x[BV] + VEHICLE_LENGTH_M + state.r1_m
    v[BV] = state.v_bv_mps
    v[LV] = np.maximum(state.v_bv_mps + state.r1dot_mps, 0.0)
    v[AV] = state.v_bv_mps - state.r2dot_mps


@compiled_inline
def state_of(x: FloatArray, v: FloatArray) -> State:
    """State from positions and speeds (3,) of LV, BV, AV."""
    return State(v[BV], gap(x[LV], x[BV]), v[LV] - v[BV], gap(x[BV], x[AV]), v[BV] - v[AV])


@compiled_inline
def walk(
    state: State, seed: int, episode: int, until: int, ends_passed: bool, environment: Environment, path: Trajectory
) -> int:
    """Walk from an initial state to a step, or to the end that an episode without cut-in finds; returns the step.

    The AV keeps its speed, and ``ends_passed`` says whether the walk ends where it has passed BV.
    """
    hold_steps = environment.numbers.hold_steps
    place(state, path.x[0], path.v[0])
    for step in range(until):
        m, x, v, after = step // hold_steps, path.x[step], path.v[step], path.v[step + 1]
        if step > 0 and (gap(x[LV], x[BV]) < CONTACT_M or (ends_passed and gap(x[BV], x[AV]) <= 0.0)):
            return step
        if step % hold_steps == 0:
            u_lv, u_bv = uniform(seed, episode, LV_DRAWS, m), uniform(seed, episode, BV_DRAWS, m)
            path.lv[m] = laws.drive_freely(u_lv, v[LV], environment)
            path.bv[m] = laws.draw_acceleration(u_bv, laws.car_following(state_of(x, v), environment), environment)
        after[LV], after[BV] = next_speed(v[LV], acceleration(path.lv[m])), next_speed(v[BV], acceleration(path.bv[m]))
        after[AV] = v[AV]
        for vehicle in range(3):
            path.x[step + 1, vehicle] = next_position(x[vehicle], v[vehicle], after[vehicle])
    return until


@compiled_inline
def weigh_cut_ins(steps: int, environment: Environment, path: Trajectory) -> float:
    """Write the cut-in hazard of each step that has been walked; returns their sum."""
    total = 0.0
    for step in range(steps):
        state = state_of(path.x[step], path.v[step])
        accepted = laws.acceptance(state.r2_m, state.r2dot_mps, environment)
        path.hazard[step] = laws.cut_in_hazard(laws.opportunity(state, environment), accepted, environment)
        total += path.hazard[step]
    return total


@compiled_inline
def leave(cut: int, until: int, seed: int, episode: int, first: int, environment: Environment, path: Trajectory) -> int:
    """BV's motion from its cut-in in step ``cut`` to a step; returns how many maneuvers that takes.

    They are drawn, ``first`` being the index of the first.
    """
    hold_steps = environment.numbers.hold_steps
    x, v = path.x[cut, BV], path.v[cut, BV]
    a = acceleration(path.bv[cut // hold_steps])
    draws = 0
    for step in range(cut, until):
        if step > cut and (step - cut - 1) % hold_steps == 0:
            u = uniform(seed, episode, BV_FREE_DRAWS, first + draws)
            path.free[draws] = laws.drive_freely(u, v, environment)
            a = acceleration(path.free[draws])
            draws += 1
        v_after = next_speed(v, a)
        x = next_position(x, v, v_after)
        v = v_after
        path.x_after[step + 1], path.v_after[step + 1] = x, v
    path.slowest[until] = v
    for step in range(until - 1, cut, -1):
        path.slowest[step] = min(path.slowest[step + 1], path.v_after[step])
    return draws


@compiled_inline
def take_over(
    place: int,
    d: int,
    drivers: RecordArray,
    late: int,
    encloses: bool,
    cut: int,
    lead: int,
    environment: Environment,
    path: Trajectory,
) -> None:
    """Driver ``d`` is to take over from the AV after the step of the onset, as follower ``place``; see `follow`.

    It reacts ``late`` steps after it has perceived BV. One that ``encloses`` others acts from the onset.
    """
    driver, one, onset = drivers[d], path.follower[place], onset_of(cut, lead)
    perceives_m = 0.0 if encloses else driver.perceives_lateral_m
    perceived, earlier = perceived_in(perceives_m, cut, lead, environment.lateral.distance_m)
    one.driver, one.encloses, one.first, one.end = d, encloses, perceived + late, FOLLOWS
    one.x, one.v = path.x[onset + 1, AV], path.v[onset + 1, AV]
    one.acceleration, one.danger, one.used_up = 0.0, math.inf, driver.used_up_steps + earlier
    one.cruises = driver.cruises and not encloses
    if onset == cut and gap(path.x_after[cut + 1], one.x) < CONTACT_M:
        one.end = cut + 1


@compiled_inline
def follow(n: int, drivers: RecordArray, cut: int, lead: int, until: int, path: Trajectory) -> None:
    """Drive the first ``n`` followers behind BV, which shows ``lead`` steps before its cut-in that it will come over.

    ``end`` of each receives the step after which it has run into BV, `NO_CRASH` or `WAS_AHEAD`, and ``v`` its speed
    then. One that encloses others also counts as having run into BV where it has passed it before the overlap: a slower
    one may not have. Side by side, because each waits for its own last result in every operation of a step.
    """
    left = 0
    for i in range(n):
        left += path.follower[i].end == FOLLOWS
    for step in range(onset_of(cut, lead) + 1, until):
        if left == 0:
            return
        x_bv, v_bv, x_next = path.x_after[step], path.v_after[step], path.x_after[step + 1]
        if step <= cut:
            x_bv, v_bv = path.x[step, BV], path.v[step, BV]
        for i in range(n):
            one = path.follower[i]
            if one.end != FOLLOWS:
                continue
            driver, ahead = drivers[one.driver], gap(x_bv, one.x)
            if step > cut and never_reaches(driver, one.v, ahead, path.slowest[step], until - step):
                one.end = NO_CRASH
                left -= 1
                continue
            if step >= one.first:
                memory = Memory(one.acceleration, one.danger, one.used_up)
                memory = react(driver, memory, step - one.first, one.v, v_bv, ahead)
                one.cruises = still_cruises(one.cruises, step > cut, memory.acceleration)
                one.acceleration, one.danger = 0.0 if one.cruises else memory.acceleration, memory.danger
            v_after = next_speed(one.v, one.acceleration)
            one.x, one.v = next_position(one.x, one.v, v_after), v_after
            if step >= cut and gap(x_next, one.x) < CONTACT_M:
                one.end = step + 1 if one.encloses or overlaps(x_next, one.x) else WAS_AHEAD
                left -= 1
    for i in range(n):
        if path.follower[i].end == FOLLOWS:
            path.follower[i].end = NO_CRASH


@compiled_inline
def never_reaches(driver: Record, speed: float, ahead: float, slowest: float, steps: int) -> bool:
    """Whether a driver stays behind even at full throttle from now on; BV is ``ahead`` (m), never below ``slowest``.

    The gap that is left is concave in time, so that its ends decide.
    """
    rest = steps * STEP_S
    left = ahead + (slowest - speed) * rest - 0.5 * max(driver.max_acceleration_mps2, 0.0) * (rest * rest)
    return ahead > SAFE_M and left > SAFE_M


@compiled_inline
def who_crashes(followers: Followers, cut: int, lead: int, environment: Environment, path: Trajectory) -> int:
    """One bit for each attentive driver that runs into BV hard enough to count; see `follow`.

    Of the envelope every crash counts: who stays behind it may be the harder for crashing later.
    """
    drivers, envelope, until = followers.drivers, followers.envelope, environment.numbers.max_steps
    found = n = 0
    if envelope >= 0:
        late = drivers[envelope].delay_steps
        take_over(0, envelope, drivers, late, True, cut, lead, environment, path)
        follow(1, drivers, cut, lead, until, path)
        if path.follower[0].end < 0:
            return 0
        found = 1 << envelope
    for d in range(drivers.size):
        if d != envelope:
            take_over(n, d, drivers, drivers[d].delay_steps, False, cut, lead, environment, path)
            n += 1
    follow(n, drivers, cut, lead, until, path)
    for i in range(n):
        one = path.follower[i]
        above = followers.counts_above_mps
        if one.end >= 0 and (above == 0.0 or one.v - path.v_after[one.end] > above):
            found |= 1 << one.driver
    return found


@compiled_threads
def mean_test_distance(seed: int, states: RecordArray, environment: Environment, path: Trajectory) -> float:
    """Mean distance (m) that the AV drives in an overtaking without cut-in; ``path`` is room to work in."""
    total = 0.0
    for i in range(states.size):
        steps = walk(states[i], seed, i, environment.numbers.max_steps, True, environment, path)
        total += path.v[0, AV] * (0.1 * steps)
    return float(total / states.size)
