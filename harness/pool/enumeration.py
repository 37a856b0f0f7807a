"""The cut-ins that could happen on a naturalistic path, their exact probabilities, and which drivers crash on them.

LV's and BV's motion before the cut-in does not depend on the AV; BV's motion after it is drawn from free driving, which
does not depend on the AV either. So a path is walked once, each of its cut-in times has a probability that is known
once the AV's motion is (it keeps its speed, or has been recorded), and each driver is only a follower behind a given
BV: about a microsecond.

Cut-ins a tenth of a second apart mostly end alike. So of each path only every `STRIDE`-th step is asked, from a random
one on, and counts for the ones around it: that keeps every sum over cut-ins unbiased, and with the same time for more
paths the crash rates become known about three times sooner.
"""

from __future__ import annotations

import math

from harness.arrays import FloatArray, Int8Array, IntArray, RecordArray
from harness.compiled import compiled_inline, compiled_threads
from harness.environment.cut_in import cut_in_hazard, opportunity
from harness.environment.driving import Environment, draw_acceleration, free_driving
from harness.environment.lateral import LateralMotion, draw_lead
from harness.episode.trajectory import (
    Trajectory,
    leave,
    state_in,
    walk_traffic,
    walk_without_cut_in,
    weigh_cut_ins,
    who_crashes,
)
from harness.maneuvers import CUT_IN, acceleration
from harness.outcomes import LV
from harness.random_stream import LV_DRAWS, uniform
from harness.vehicles.kinematics import CONTACT_M, gap, next_speed

FREE_DRAWS_PER_CUT_IN = 256
"""Stride of the uniforms for BV's free driving: each cut-in time of a path has draws of its own."""
STRIDE = 4
"""Steps between the cut-ins of a path that are asked; `benchmarks.pool_stride` says what other numbers would cost."""


@compiled_threads
def enumerate_cut_ins(
    seed: int,
    first: int,
    states: RecordArray,
    environment: Environment,
    drivers: RecordArray,
    envelope: int,
    stride: int,
    offset: IntArray,
    path: Trajectory,
    probability: FloatArray,
    crashes: IntArray,
) -> None:
    """Every ``stride``-th cut-in of consecutive paths, from index ``first`` and initial ``states`` (n,) on.

    Parameters
    ----------
    drivers : structured ndarray, shape (D,)
        At most 62 of them, without inattention; ``envelope`` as in `harness.episode.trajectory.who_crashes`.
    offset : ndarray of int64, shape (n,)
        Step of each path's first cut-in that is asked, less than ``stride``.
    path : Trajectory
        Room to work in.
    probability : ndarray, shape (n, steps)
        Receives ``stride`` · P(BV cuts in in that step | path) where it is asked, else 0. With uniform offsets the sum
        over any set of cut-ins has its probability as mean.
    crashes : ndarray of int64, shape (n, steps)
        Receives one bit per driver.
    """
    probability[:, :] = 0.0
    crashes[:, :] = 0
    for i in range(states.size):
        steps, _ = walk_without_cut_in(states[i], seed, first + i, environment, path)
        hazard = 0.0
        for cut in range(steps):
            before = hazard
            hazard += path.hazard[cut]
            if cut % stride != offset[i] or path.hazard[cut] == 0.0:
                continue
            probability[i, cut] = stride * (math.exp(-before) * -math.expm1(-path.hazard[cut]))
            crashes[i, cut] = who_crashes_after(cut, seed, first + i, drivers, envelope, environment, path)


@compiled_threads
def draw_leads(seed: int, indices: IntArray, cuts: IntArray, lateral: LateralMotion, leads: IntArray) -> None:
    """Leads (steps) of chosen (path, cut-in step) pairs, (n,) each."""
    for i in range(indices.size):
        leads[i] = draw_lead(cuts[i], seed, indices[i], lateral)


@compiled_inline
def who_crashes_after(
    cut: int, seed: int, index: int, drivers: RecordArray, envelope: int, environment: Environment, path: Trajectory
) -> int:
    """One bit for each driver that crashes if BV cuts in in a step of a path that has been walked."""
    max_steps = environment.numbers.max_steps
    leave(cut, max_steps, seed, index, cut * FREE_DRAWS_PER_CUT_IN, 0, environment, path)
    if gap(path.x_lv[cut + 1], path.x_after[cut + 1]) < CONTACT_M:
        return 0  # the episode ends as bv_lv_contact
    lead = draw_lead(cut, seed, index, environment.lateral)
    return who_crashes(drivers, envelope, cut, lead, max_steps, environment.lateral, path)


@compiled_threads
def enumerate_recorded(
    seed: int,
    indices: IntArray,
    states: RecordArray,
    n_steps: IntArray,
    x_av: FloatArray,
    v_av: FloatArray,
    environment: Environment,
    drivers: RecordArray,
    envelope: int,
    stride: int,
    offset: IntArray,
    path: Trajectory,
    probability: FloatArray,
    unknown: FloatArray,
    crashes: IntArray,
) -> None:
    """Cut-ins of chosen paths, ``indices`` and ``states`` (n,), beside an AV whose motion has been recorded.

    Parameters
    ----------
    n_steps : ndarray of int64, shape (n,)
        Steps that are on record; less than the path has where the AV failed.
    x_av, v_av : ndarray, shape (n, steps + 1)
        The AV's positions (m) and speeds (m/s).
    stride, offset, probability, crashes
        As for `enumerate_cut_ins`. Drivers take over from the AV after the step of the cut-in.
    unknown : ndarray, shape (n,)
        Receives the most that the probability of a cut-in after the recorded steps can be, wherever the AV may be then:
        every wish to change lanes is carried out. It means something where the AV has failed.
    """
    max_steps = environment.numbers.max_steps
    probability[:, :] = 0.0
    crashes[:, :] = 0
    for i in range(states.size):
        reach = walk_traffic(states[i], seed, indices[i], max_steps, environment, path)
        steps = min(n_steps[i], reach)
        for step in range(steps + 1):
            path.x_av[step], path.v_av[step] = x_av[i, step], v_av[i, step]
        weigh_cut_ins(steps, environment, path)
        hazard = 0.0
        for cut in range(steps):
            if path.hazard[cut] > 0.0 and cut % stride == offset[i]:
                probability[i, cut] = stride * (math.exp(-hazard) * -math.expm1(-path.hazard[cut]))
                if drivers.size > 0:
                    crashes[i, cut] = who_crashes_after(cut, seed, indices[i], drivers, envelope, environment, path)
            hazard += path.hazard[cut]
        most = 0.0
        for step in range(steps, reach):
            most += cut_in_hazard(opportunity(state_in(step, path), environment), 1.0, environment)
        unknown[i] = math.exp(-hazard) * -math.expm1(-most)


@compiled_threads
def write_traffic(
    seed: int,
    indices: IntArray,
    states: RecordArray,
    environment: Environment,
    path: Trajectory,
    lv: Int8Array,
    bv: Int8Array,
) -> None:
    """Maneuvers of LV and BV on chosen paths, ``indices`` and ``states`` (n,), where nobody cuts in: (n, draws)."""
    n = environment.numbers
    for i in range(indices.size):
        steps = walk_traffic(states[i], seed, indices[i], n.max_steps, environment, path)
        for m in range((steps - 1) // n.hold_steps + 1):
            lv[i, m], bv[i, m] = path.lv[m], path.bv[m]


@compiled_threads
def write_pairs(
    seed: int,
    indices: IntArray,
    cuts: IntArray,
    states: RecordArray,
    draws_per_cut_in: int,
    environment: Environment,
    path: Trajectory,
    lv: Int8Array,
    bv: Int8Array,
    n_lv: IntArray,
    n_bv: IntArray,
) -> None:
    """Maneuvers of chosen (path, cut-in step) pairs, ``indices`` and ``cuts`` (n,), as an episode records them.

    ``lv``, ``bv`` (n, draws) receive them, 31 marking the cut-in; ``n_lv``, ``n_bv`` (n,) how many there are. LV goes
    on to draw, to the end of the episode. ``draws_per_cut_in`` is `FREE_DRAWS_PER_CUT_IN` for a pool, 0 for an episode.
    ``path`` is room to work in.
    """
    n = environment.numbers
    for i in range(indices.size):
        cut = cuts[i]
        walk_traffic(states[i], seed, indices[i], cut + 1, environment, path)
        before = cut // n.hold_steps + 1
        for m in range(before):
            lv[i, m], bv[i, m] = path.lv[m], path.bv[m]
        bv[i, before] = CUT_IN
        drawn = leave(cut, n.max_steps, seed, indices[i], cut * draws_per_cut_in, 0, environment, path)
        for m in range(drawn):
            bv[i, before + 1 + m] = path.free[m]
        n_bv[i] = before + 1 + drawn
        n_lv[i] = (n.max_steps - 1) // n.hold_steps + 1
        v = path.v[LV]
        for step in range(n.max_steps):
            m = step // n.hold_steps
            if step % n.hold_steps == 0 and m >= before:
                u = uniform(seed, indices[i], LV_DRAWS, m)
                lv[i, m] = draw_acceleration(u, free_driving(v, environment), environment)
            v = next_speed(v, acceleration(lv[i, m]))
