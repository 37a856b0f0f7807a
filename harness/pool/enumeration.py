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

import hashlib
import math
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_inline, compiled_threads
from harness.episode.path import (
    Followers,
    Trajectory,
    empty_trajectory,
    leave,
    state_in,
    walk,
    weigh_cut_ins,
    who_crashes,
)
from harness.maneuvers import CUT_IN, acceleration
from harness.random_stream import LV_DRAWS, uniform
from harness.traffic.lateral import draw_lead
from harness.traffic.laws import Environment, cut_in_hazard, draw_acceleration, free_driving, opportunity
from harness.unboxed import unboxed
from harness.vehicles.kinematics import CONTACT_M, gap, next_speed
from harness.vocabulary import LV, BoolArray, FloatArray, Int8Array, IntArray, RecordArray

FREE_DRAWS_PER_CUT_IN = 256
"""Stride of the uniforms for BV's free driving: each cut-in time of a path has draws of its own."""
STRIDE = 4
"""Steps between the cut-ins of a path that are asked; `benchmarks.pool_stride` says what other numbers would cost."""


class ShadowRuns(NamedTuple):
    """What vehicles did without a cut-in, on paths (n,); for one that keeps its speed, `HOLDING` (0,).

    ``n_steps``, ``failed`` (n,): steps that are on record, and whether the vehicle failed then. ``x_m``, ``v_mps``
    (n, steps + 1) are its positions and speeds, undefined beyond.
    """

    n_steps: IntArray
    failed: BoolArray
    x_m: FloatArray
    v_mps: FloatArray

    def mean_distance_m(self, weight: FloatArray) -> float:
        """Mean distance that the vehicle drives where nobody cuts in; paths have the ``weight`` (n,)."""
        whole, rows = ~self.failed, np.arange(len(self.n_steps))
        distance = self.x_m[rows, self.n_steps] - self.x_m[:, 0]
        return float((weight * distance)[whole].sum() / weight[whole].sum())

    def digest(self) -> str:
        """Hash of what is on record."""
        digest = hashlib.sha256(self.n_steps.tobytes() + self.failed.tobytes())
        known = np.arange(self.x_m.shape[1]) <= self.n_steps[:, None]
        for values in (self.x_m, self.v_mps):
            digest.update(values[known].tobytes())
        return digest.hexdigest()


HOLDING = ShadowRuns(np.zeros(0, np.int64), np.zeros(0, np.bool_), np.zeros((0, 1)), np.zeros((0, 1)))


class CutInsOnPaths(NamedTuple):
    """All cut-ins that are asked of paths: rows are paths, columns steps.

    ``probability`` (n, steps) is ``stride`` · P(BV cuts in in that step | path) where it is asked, else 0: with uniform
    offsets the sum over any set of cut-ins has its probability as mean. ``crashes`` (n, steps) has one bit per driver.
    ``unknown`` (n,) is the most that the probability of a cut-in after a failure of the AV can be, wherever it may be
    then: every wish to change lanes is carried out.
    """

    probability: FloatArray
    crashes: IntArray
    unknown: FloatArray


class Script(NamedTuple):
    """Maneuvers of LV and BV on paths (n,), as an episode records them.

    ``lv``, ``bv`` (n, draws), 31 marking the cut-in; ``n_lv``, ``n_bv`` (n,) how many there are. ``lead`` (n,) is how
    many steps earlier BV begins to move sideways.
    """

    lv: Int8Array
    bv: Int8Array
    n_lv: IntArray
    n_bv: IntArray
    lead: IntArray


def enumerate_cut_ins(
    seed: int,
    index: IntArray,
    state: RecordArray,
    environment: Environment,
    followers: Followers,
    runs: ShadowRuns = HOLDING,
    stride: int = 1,
    offset: IntArray | None = None,
) -> CutInsOnPaths:
    """Every ``stride``-th cut-in of paths, ``index`` and initial ``state`` (n,); ``offset`` (n,) is each one's first.

    Drivers take over from the AV after the step of the onset.
    """
    shape = index.size, int(environment.numbers["max_steps"])
    found = CutInsOnPaths(np.zeros(shape), np.zeros(shape, np.int64), np.zeros(index.size))
    first = np.zeros(index.size, np.int64) if offset is None else offset
    room = empty_trajectory(environment)
    known = unboxed(environment), unboxed(followers), unboxed(runs)
    _enumerate(seed, index, state, stride, first, *known, unboxed(room), unboxed(found))
    return found


@compiled_threads
def _enumerate(
    seed: int,
    index: IntArray,
    state: RecordArray,
    stride: int,
    offset: IntArray,
    environment: Environment,
    followers: Followers,
    runs: ShadowRuns,
    path: Trajectory,
    found: CutInsOnPaths,
) -> None:
    max_steps = environment.numbers.max_steps
    for i in range(index.size):
        if runs.n_steps.size == 0:
            steps = reach = walk(state[i], seed, index[i], 0, max_steps, True, environment, path)
        else:
            reach = walk(state[i], seed, index[i], 0, max_steps, False, environment, path)
            steps = min(runs.n_steps[i], reach)
            for step in range(steps + 1):
                path.x_av[step], path.v_av[step] = runs.x_m[i, step], runs.v_mps[i, step]
        weigh_cut_ins(steps, environment, path)
        hazard = 0.0
        for cut in range(steps):
            if path.hazard[cut] > 0.0 and cut % stride == offset[i]:
                found.probability[i, cut] = stride * (math.exp(-hazard) * -math.expm1(-path.hazard[cut]))
                if followers.drivers.size > 0:
                    found.crashes[i, cut] = who_crashes_after(cut, seed, index[i], followers, environment, path)
            hazard += path.hazard[cut]
        if runs.failed.size > 0 and runs.failed[i]:
            most = 0.0
            for step in range(steps, reach):
                most += cut_in_hazard(opportunity(state_in(step, path), environment), 1.0, environment)
            found.unknown[i] = math.exp(-hazard) * -math.expm1(-most)


@compiled_inline
def who_crashes_after(
    cut: int, seed: int, index: int, followers: Followers, environment: Environment, path: Trajectory
) -> int:
    """One bit for each driver that crashes if BV cuts in in a step of a path that has been walked."""
    leave(cut, environment.numbers.max_steps, seed, index, cut * FREE_DRAWS_PER_CUT_IN, 0, environment, path)
    if gap(path.x_lv[cut + 1], path.x_after[cut + 1]) < CONTACT_M:
        return 0  # the episode ends as bv_lv_contact
    return who_crashes(followers, cut, draw_lead(cut, seed, index, environment.lateral), environment, path)


def write_script(
    seed: int,
    index: IntArray,
    cut: IntArray,
    state: RecordArray,
    environment: Environment,
    draws_per_cut_in: int = FREE_DRAWS_PER_CUT_IN,
) -> Script:
    """What LV and BV do on paths, ``index`` and initial ``state`` (n,), with cut-ins in steps ``cut`` (n,), -1: none.

    After a cut-in LV goes on to draw, to the end of the episode. ``draws_per_cut_in`` is 0 for an episode.
    """
    room, n = empty_trajectory(environment), index.size
    lv, bv = np.zeros((2, n, room.lv.size), np.int8)
    n_lv, n_bv = np.zeros((2, n), np.int64)
    script = Script(lv, bv, n_lv, n_bv, np.zeros(n, np.int64))
    _write(seed, index, cut, state, draws_per_cut_in, unboxed(environment), unboxed(room), unboxed(script))
    return script


@compiled_threads
def _write(
    seed: int,
    index: IntArray,
    cut: IntArray,
    state: RecordArray,
    draws_per_cut_in: int,
    environment: Environment,
    path: Trajectory,
    script: Script,
) -> None:
    n, lv, bv = environment.numbers, script.lv, script.bv
    for i in range(index.size):
        until = cut[i] + 1 if cut[i] >= 0 else n.max_steps
        steps = walk(state[i], seed, index[i], 0, until, False, environment, path)
        before = (steps - 1) // n.hold_steps + 1
        for m in range(before):
            lv[i, m], bv[i, m] = path.lv[m], path.bv[m]
        script.n_lv[i] = script.n_bv[i] = before
        if cut[i] < 0:
            continue
        bv[i, before] = CUT_IN
        drawn = leave(cut[i], n.max_steps, seed, index[i], cut[i] * draws_per_cut_in, 0, environment, path)
        for m in range(drawn):
            bv[i, before + 1 + m] = path.free[m]
        script.n_bv[i] += 1 + drawn
        script.lead[i] = draw_lead(cut[i], seed, index[i], environment.lateral)
        script.n_lv[i] = (n.max_steps - 1) // n.hold_steps + 1
        v = path.v[LV]
        for step in range(n.max_steps):
            m = step // n.hold_steps
            if step % n.hold_steps == 0 and m >= before:
                u = uniform(seed, index[i], LV_DRAWS, m)
                lv[i, m] = draw_acceleration(u, free_driving(v, environment), environment)
            v = next_speed(v, acceleration(lv[i, m]))
