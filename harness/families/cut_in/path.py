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
    """Room for one trajectory; positions in m, speeds in m/s.

    Without a cut-in: ``lv``, ``bv`` (draws,) are maneuver indices, ``x``, ``v`` (steps + 1, 3) the motion of LV, BV and
    AV, ``hazard`` (steps,) that of cutting in. After one: ``free`` (draws,) are BV's maneuvers, ``x_after``,
    ``v_after`` (steps + 1,) its motion, ``slowest`` (steps + 1,) the lowest speed that it will have from there on.
    ``follower`` (`MOST_FOLLOWERS`,) are the drivers behind it.
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
    """Walk from an initial state ``until`` a step, or to an earlier end of a test without cut-in; returns that step.

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
    """Draw BV's motion from its cut-in in step ``cut`` ``until`` a step; returns the number of maneuvers.

    ``first`` is the index of their first uniform.
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
    """Let driver ``d`` take over from the AV after the step of the onset, as follower ``place``; see `follow`.

    It reacts ``late`` steps after it has perceived BV. One that ``encloses`` others acts from the onset.
    """
    driver, follower = drivers[d], path.follower[place]
    onset = onset_of(cut, lead)
    perceives_m = 0.0 if encloses else driver.perceives_lateral_m
    perceived, earlier = perceived_in(perceives_m, cut, lead, environment.lateral.distance_m)
    follower.driver, follower.encloses, follower.first, follower.end = d, encloses, perceived + late, FOLLOWS
    follower.x, follower.v = path.x[onset + 1, AV], path.v[onset + 1, AV]
    follower.acceleration, follower.danger, follower.used_up = 0.0, math.inf, driver.used_up_steps + earlier
    follower.cruises = driver.cruises and not encloses
    if onset == cut and gap(path.x_after[cut + 1], follower.x) < CONTACT_M:
        follower.end = cut + 1


@compiled_inline
def follow(n: int, drivers: RecordArray, cut: int, lead: int, until: int, path: Trajectory) -> None:
    """Drive the first ``n`` followers behind BV, which moves sideways from ``lead`` steps before its cut-in on.

    ``end`` of each receives the step after which it has run into BV, `NO_CRASH` or `WAS_AHEAD`, and ``v`` its speed
    then. A follower that encloses others counts as having run into BV also if it has passed BV before the overlap: a
    slower one may not have. They are driven side by side, so that no operation has to wait for the result of the last.
    """
    n_following = 0
    for i in range(n):
        n_following += path.follower[i].end == FOLLOWS
    for step in range(onset_of(cut, lead) + 1, until):
        if n_following == 0:
            return
        x_bv, v_bv, x_next = path.x_after[step], path.v_after[step], path.x_after[step + 1]
        if step <= cut:
            x_bv, v_bv = path.x[step, BV], path.v[step, BV]
        for i in range(n):
            follower = path.follower[i]
            if follower.end != FOLLOWS:
                continue
            driver, ahead = drivers[follower.driver], gap(x_bv, follower.x)
            if step > cut and never_reaches(driver, follower.v, ahead, path.slowest[step], until - step):
                follower.end = NO_CRASH
                n_following -= 1
                continue
            if step >= follower.first:
                memory = Memory(follower.acceleration, follower.danger, follower.used_up)
                memory = react(driver, memory, step - follower.first, follower.v, v_bv, ahead)
                follower.cruises = still_cruises(follower.cruises, step > cut, memory.acceleration)
                follower.acceleration, follower.danger = 0.0 if follower.cruises else memory.acceleration, memory.danger
            v_after = next_speed(follower.v, follower.acceleration)
            follower.x, follower.v = next_position(follower.x, follower.v, v_after), v_after
            if step >= cut and gap(x_next, follower.x) < CONTACT_M:
                follower.end = step + 1 if follower.encloses or overlaps(x_next, follower.x) else WAS_AHEAD
                n_following -= 1
    for i in range(n):
        if path.follower[i].end == FOLLOWS:
            path.follower[i].end = NO_CRASH


@compiled_inline
def never_reaches(driver: Record, speed: float, ahead: float, slowest: float, steps: int) -> bool:
    """Whether a driver stays behind BV even at full throttle; BV is ``ahead`` (m), and never below ``slowest`` (m/s).

    The gap is concave in time, so that it is smallest now or at the end.
    """
    time_s = steps * STEP_S
    gap_then = ahead + (slowest - speed) * time_s - 0.5 * max(driver.max_acceleration_mps2, 0.0) * (time_s * time_s)
    return ahead > SAFE_M and gap_then > SAFE_M


@compiled_inline
def who_crashes(followers: Followers, cut: int, lead: int, environment: Environment, path: Trajectory) -> int:
    """One bit for each attentive driver that runs into BV hard enough to count; see `follow`.

    Every crash of the envelope counts: a driver behind it may crash later, and harder.
    """
    drivers, envelope, until = followers.drivers, followers.envelope, environment.numbers.max_steps
    crashes = n = 0
    if envelope >= 0:
        late = drivers[envelope].delay_steps
        take_over(0, envelope, drivers, late, True, cut, lead, environment, path)
        follow(1, drivers, cut, lead, until, path)
        if path.follower[0].end < 0:
            return 0
        crashes = 1 << envelope
    for d in range(drivers.size):
        if d != envelope:
            take_over(n, d, drivers, drivers[d].delay_steps, False, cut, lead, environment, path)
            n += 1
    follow(n, drivers, cut, lead, until, path)
    for i in range(n):
        follower = path.follower[i]
        above = followers.counts_above_mps
        if follower.end >= 0 and (above == 0.0 or follower.v - path.v_after[follower.end] > above):
            crashes |= 1 << follower.driver
    return crashes


@compiled_threads
def mean_test_distance(seed: int, states: RecordArray, environment: Environment, path: Trajectory) -> float:
    """Mean distance (m) that the AV drives in an overtaking without cut-in; ``path`` is room to work in."""
    total = 0.0
    for i in range(states.size):
        steps = walk(states[i], seed, i, environment.numbers.max_steps, True, environment, path)
        total += path.v[0, AV] * (0.1 * steps)
    return float(total / states.size)
