"""The cut-ins that could happen on a naturalistic path, their exact probabilities, and which drivers crash on them.

LV's and BV's motion before the cut-in does not depend on the AV, which keeps its speed; BV's motion after it is drawn
from free driving, which does not depend on the AV either. So a path is walked once, each of its cut-in times has a
known probability, and each driver is only a follower behind a given BV: about a microsecond.

Cut-ins a tenth of a second apart mostly end alike. So of each path only every `STRIDE`-th step is asked, from a random
one on, and counts for the ones around it: that keeps every sum over cut-ins unbiased, and with the same time for more
paths the crash rates become known about three times sooner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.arrays import FloatArray, Int8Array, IntArray, Record, RecordArray
from harness.compiled import compiled_inline, compiled_threads
from harness.environment.cut_in import acceptance, cut_in_hazard, opportunity
from harness.environment.driving import Environment, draw_car_following, draw_free_driving
from harness.episode.begin import place
from harness.maneuvers import CUT_IN, acceleration
from harness.outcomes import AV, BV, LV
from harness.random_stream import BV_DRAWS, BV_FREE_DRAWS, LV_DRAWS, uniform
from harness.vehicles.kinematics import CONTACT_M, gap, next_position, next_speed
from harness.vehicles.reaction import reacting_acceleration

FREE_DRAWS_PER_CUT_IN = 256
"""Stride of the uniforms for BV's free driving: each cut-in time of a path has draws of its own."""
STRIDE = 4
"""Steps between the cut-ins of a path that are asked; `benchmarks.pool_stride` says what other numbers would cost."""
NO_CRASH = -1


class Path(NamedTuple):
    """LV's and BV's motion without a cut-in, and the AV at constant speed.

    ``lv``, ``bv`` (draws,) are maneuver indices. ``x_lv``, ``x_bv``, ``x_av``, ``v_bv`` (steps + 1,) are positions (m)
    and speeds (m/s); ``hazard`` (steps,) the cut-in hazard of each step. ``x``, ``v`` (3,) are the initial placement.
    ``x_after``, ``v_after`` (steps + 1,) receive BV's motion after a cut-in.
    """

    lv: Int8Array
    bv: Int8Array
    x_lv: FloatArray
    x_bv: FloatArray
    v_bv: FloatArray
    x_av: FloatArray
    hazard: FloatArray
    x: FloatArray
    v: FloatArray
    x_after: FloatArray
    v_after: FloatArray


def empty_path(max_steps: int, draws: int) -> Path:
    """Room for one path."""
    n = max_steps + 1
    return Path(
        lv=np.zeros(draws, np.int8),
        bv=np.zeros(draws, np.int8),
        x_lv=np.zeros(n),
        x_bv=np.zeros(n),
        v_bv=np.zeros(n),
        x_av=np.zeros(n),
        hazard=np.zeros(max_steps),
        x=np.zeros(3),
        v=np.zeros(3),
        x_after=np.zeros(n),
        v_after=np.zeros(n),
    )


@compiled_inline
def walk(seed: int, index: int, state: FloatArray, environment: Environment, path: Path) -> int:
    """Walk path ``index`` from an initial state (5,) until no cut-in can follow; returns its steps."""
    n = environment.numbers[0]
    place(state, path.x, path.v)
    x_lv, x_bv, x_av = path.x[LV], path.x[BV], path.x[AV]
    v_lv, v_bv, v_av = path.v[LV], path.v[BV], path.v[AV]
    a_lv = a_bv = 0.0
    draws = 0
    for step in range(n.max_steps):
        r1, r1dot = gap(x_lv, x_bv), v_lv - v_bv
        r2, r2dot = gap(x_bv, x_av), v_bv - v_av
        path.x_lv[step], path.x_bv[step], path.v_bv[step], path.x_av[step] = x_lv, x_bv, v_bv, x_av
        if step > 0 and (r1 < CONTACT_M or r2 <= 0.0):
            return step
        if step % n.hold_steps == 0:
            path.lv[draws] = draw_free_driving(uniform(seed, index, LV_DRAWS, draws), v_lv, environment)
            path.bv[draws] = draw_car_following(uniform(seed, index, BV_DRAWS, draws), v_bv, r1, r1dot, environment)
            a_lv, a_bv = acceleration(path.lv[draws]), acceleration(path.bv[draws])
            draws += 1
        path.hazard[step] = cut_in_hazard(
            opportunity(v_bv, r1, r1dot, environment), acceptance(r2, r2dot, environment), environment
        )
        after_lv, after_bv = next_speed(v_lv, a_lv), next_speed(v_bv, a_bv)
        x_lv = next_position(x_lv, v_lv, after_lv)
        x_bv = next_position(x_bv, v_bv, after_bv)
        x_av = next_position(x_av, v_av, v_av)
        v_lv, v_bv = after_lv, after_bv
    last = n.max_steps
    path.x_lv[last], path.x_bv[last], path.v_bv[last], path.x_av[last] = x_lv, x_bv, v_bv, x_av
    return int(n.max_steps)


@compiled_inline
def leave(seed: int, index: int, cut: int, environment: Environment, path: Path, free: Int8Array) -> int:
    """BV's motion from its cut-in in step ``cut`` on; returns how many of ``free`` (draws,) it draws."""
    n = environment.numbers[0]
    x, v = path.x_bv[cut], path.v_bv[cut]
    a = acceleration(path.bv[cut // n.hold_steps])
    draws = 0
    for step in range(cut, n.max_steps):
        if step > cut and (step - cut - 1) % n.hold_steps == 0:
            u = uniform(seed, index, BV_FREE_DRAWS, cut * FREE_DRAWS_PER_CUT_IN + draws)
            free[draws] = draw_free_driving(u, v, environment)
            a = acceleration(free[draws])
            draws += 1
        v_after = next_speed(v, a)
        x = next_position(x, v, v_after)
        v = v_after
        path.x_after[step + 1], path.v_after[step + 1] = x, v
    return draws


@compiled_inline
def follow(driver: Record, late: int, x: float, v: float, cut: int, path: Path, max_steps: int) -> tuple[int, float]:
    """Step after which a driver has run into BV, or `NO_CRASH`, and its speed (m/s) at the end.

    ``x`` (m) and ``v`` (m/s) are the AV's at the cut-in; it reacts ``late`` steps after its first chance.
    """
    a = 0.0
    for step in range(cut, max_steps):
        if step - cut > late:
            a = reacting_acceleration(driver, a, v, path.v_after[step], gap(path.x_after[step], x))
        v_after = next_speed(v, a)
        x = next_position(x, v, v_after)
        v = v_after
        if gap(path.x_after[step + 1], x) < CONTACT_M:
            return step + 1, v
    return NO_CRASH, v


@compiled_inline
def crash_step(driver: Record, late: int, x: float, v: float, cut: int, path: Path, max_steps: int) -> int:
    """Step after which a driver has run into BV, or `NO_CRASH`; see `follow`."""
    return follow(driver, late, x, v, cut, path, max_steps)[0]


@compiled_threads
def enumerate_cut_ins(
    seed: int,
    first: int,
    states: FloatArray,
    environment: Environment,
    drivers: RecordArray,
    envelope: int,
    stride: int,
    offset: IntArray,
    path: Path,
    probability: FloatArray,
    crashes: IntArray,
) -> None:
    """Every ``stride``-th cut-in of consecutive paths.

    Parameters
    ----------
    seed, first : int
        Pool seed, and index of the first path.
    states : ndarray, shape (n, 5)
        Initial states.
    drivers : structured ndarray, shape (D,)
        At most 62 of them, without inattention.
    envelope : int
        The driver that crashes wherever another one does; the others are not asked where it does not. -1 for none.
    stride : int
        Steps from one cut-in that is asked to the next; 1 for all.
    offset : ndarray of int64, shape (n,)
        Step of each path's first one, less than ``stride``.
    path : Path
        Room to work in.
    probability : ndarray, shape (n, steps)
        Receives ``stride`` · P(BV cuts in in that step | path) where it is asked, else 0. With uniform offsets the sum
        over any set of cut-ins has its probability as mean.
    crashes : ndarray of int64, shape (n, steps)
        Receives one bit per driver.
    """
    max_steps = environment.numbers[0].max_steps
    free = np.zeros(max_steps + 1, np.int8)
    for i in range(states.shape[0]):
        steps = walk(seed, first + i, states[i], environment, path)
        hazard = 0.0
        for cut in range(max_steps):
            probability[i, cut] = 0.0
            crashes[i, cut] = 0
            if cut >= steps:
                continue
            before = hazard
            hazard += path.hazard[cut]
            if cut % stride != offset[i] or path.hazard[cut] == 0.0:
                continue
            probability[i, cut] = stride * (math.exp(-before) * -math.expm1(-path.hazard[cut]))
            leave(seed, first + i, cut, environment, path, free)
            if gap(path.x_lv[cut + 1], path.x_after[cut + 1]) < CONTACT_M:
                continue  # BV touches LV before it has left the lane: the episode ends as bv_lv_contact
            x, v = path.x_av[cut], path.v[AV]
            if envelope >= 0 and crash_step(drivers[envelope], 0, x, v, cut, path, max_steps) == NO_CRASH:
                continue
            for d in range(drivers.size):
                driver = drivers[d]
                if d == envelope or crash_step(driver, driver.delay_steps, x, v, cut, path, max_steps) != NO_CRASH:
                    crashes[i, cut] |= 1 << d


@compiled_threads
def write_pairs(
    seed: int,
    indices: IntArray,
    cuts: IntArray,
    states: FloatArray,
    environment: Environment,
    path: Path,
    lv: Int8Array,
    bv: Int8Array,
    n_lv: IntArray,
    n_bv: IntArray,
) -> None:
    """Maneuvers of chosen (path, cut-in) pairs, as an episode records them.

    Parameters
    ----------
    seed : int
    indices, cuts : ndarray, shape (n,)
        Path and cut-in step of each.
    states : ndarray, shape (n, 5)
        Initial states.
    lv, bv : ndarray of int8, shape (n, draws)
        Receive the maneuvers; 31 marks the cut-in. LV goes on to draw, to the end of the episode.
    n_lv, n_bv : ndarray, shape (n,)
        Receive how many there are.
    """
    n = environment.numbers[0]
    free = np.zeros(n.max_steps + 1, np.int8)
    for i in range(indices.size):
        cut = cuts[i]
        walk(seed, indices[i], states[i], environment, path)
        before = cut // n.hold_steps + 1
        for m in range(before):
            lv[i, m], bv[i, m] = path.lv[m], path.bv[m]
        bv[i, before] = CUT_IN
        drawn = leave(seed, indices[i], cut, environment, path, free)
        for m in range(drawn):
            bv[i, before + 1 + m] = free[m]
        n_bv[i] = before + 1 + drawn
        n_lv[i] = (n.max_steps - 1) // n.hold_steps + 1
        v = path.v[LV]
        for step in range(n.max_steps):
            m = step // n.hold_steps
            if step % n.hold_steps == 0 and m >= before:
                lv[i, m] = draw_free_driving(uniform(seed, indices[i], LV_DRAWS, m), v, environment)
            v = next_speed(v, acceleration(lv[i, m]))
