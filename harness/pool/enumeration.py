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

from harness.arrays import FloatArray, Int8Array, IntArray, RecordArray
from harness.compiled import compiled_threads
from harness.environment.driving import Environment, draw_acceleration, free_driving
from harness.episode.trajectory import Trajectory, leave, walk, walk_without_cut_in, who_crashes
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
    max_steps = environment.numbers.max_steps
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
            leave(cut, max_steps, seed, first + i, cut * FREE_DRAWS_PER_CUT_IN, 0, environment, path)
            if gap(path.x_lv[cut + 1], path.x_after[cut + 1]) >= CONTACT_M:  # else the episode ends as bv_lv_contact
                crashes[i, cut] = who_crashes(drivers, envelope, cut, max_steps, path)


@compiled_threads
def write_pairs(
    seed: int,
    indices: IntArray,
    cuts: IntArray,
    states: RecordArray,
    environment: Environment,
    path: Trajectory,
    lv: Int8Array,
    bv: Int8Array,
    n_lv: IntArray,
    n_bv: IntArray,
) -> None:
    """Maneuvers of chosen (path, cut-in step) pairs, ``indices`` and ``cuts`` (n,), as an episode records them.

    ``lv``, ``bv`` (n, draws) receive them, 31 marking the cut-in; ``n_lv``, ``n_bv`` (n,) how many there are. LV goes
    on to draw, to the end of the episode. ``path`` is room to work in.
    """
    n = environment.numbers
    for i in range(indices.size):
        cut = cuts[i]
        walk(states[i], seed, indices[i], 0, n.max_steps, environment, path)
        before = cut // n.hold_steps + 1
        for m in range(before):
            lv[i, m], bv[i, m] = path.lv[m], path.bv[m]
        bv[i, before] = CUT_IN
        drawn = leave(cut, n.max_steps, seed, indices[i], cut * FREE_DRAWS_PER_CUT_IN, 0, environment, path)
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
