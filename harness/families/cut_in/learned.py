"""On which cut-ins a surrogate crashes that was learned from the vehicle (`harness.pool.learned`)."""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled_threads, unboxed
from harness.families.cut_in.events import FREE_DRAWS_PER_CUT_IN
from harness.families.cut_in.lateral import draw_lead
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.path import SAFE_M, Trajectory, empty_trajectory, leave, walk
from harness.families.protocol import Paths, Recorded
from harness.pool.learned import Learned, bin_of, respond
from harness.vehicles.kinematics import CONTACT_M, STEP_S, gap, next_position, next_speed, overlaps
from harness.vehicles.sideways import onset_of
from harness.vocabulary import BV, BoolArray, FloatArray, IntArray, RecordArray


def learned_crashes(
    environment: Environment,
    seed: int,
    paths: Paths,
    learned: Learned,
    runs: Recorded,
    asked: BoolArray,
    counts_above_mps: float,
) -> BoolArray:
    """On which of the cut-ins ``asked`` (n, steps) of baseline runs the learned surrogate crashes, (n, steps)."""
    found, scratch = np.zeros(asked.shape, np.bool_), unboxed(empty_trajectory(environment))
    wanted, (index, state) = np.zeros(asked.shape[1] + 1), paths
    traffic = unboxed(environment)
    _drive(learned, seed, index, state, traffic, unboxed(runs), scratch, wanted, asked, counts_above_mps, found)
    return found


@compiled_threads
def _drive(
    learned: Learned,
    seed: int,
    index: IntArray,
    state: RecordArray,
    environment: Environment,
    runs: Recorded,
    path: Trajectory,
    wanted: FloatArray,
    asked: BoolArray,
    counts_above_mps: float,
    found: BoolArray,
) -> None:
    until, fastest, dead_steps = environment.numbers.max_steps, max(learned.table.max(), 0.0), learned.dead_steps
    for i in range(index.size):
        walk(state[i], seed, index[i], 0, until, False, environment, path)
        x_run, v_run, n_steps = runs.x_m[i], runs.v_mps[i], runs.n_steps[i]
        for cut in range(asked.shape[1]):
            if not asked[i, cut]:
                continue
            leave(cut, until, seed, index[i], cut * FREE_DRAWS_PER_CUT_IN, 0, environment, path)
            onset = onset_of(cut, draw_lead(cut, seed, index[i], environment.lateral))
            x, v, a = x_run[onset + 1], v_run[onset + 1], (v_run[onset + 1] - v_run[onset]) / STEP_S
            for step in range(onset + 1, until):
                x_bv, v_bv = path.x_after[step], path.v_after[step]
                if step <= cut:
                    x_bv, v_bv = path.x[step, BV], path.v[step, BV]
                ahead, rest = gap(x_bv, x), (until - step) * STEP_S
                left = ahead + (path.slowest[step] - v) * rest - 0.5 * fastest * (rest * rest)
                if step > cut + dead_steps and a <= fastest and left > SAFE_M:
                    break  # it stays behind whatever it does
                wanted[step] = learned.table[bin_of(ahead, v - v_bv)]
                a = respond(learned, a, step, onset + 1, wanted, n_steps, v_run)
                v_after = next_speed(v, a)
                x, v = next_position(x, v, v_after), v_after
                if step >= cut and gap(path.x_after[step + 1], x) < CONTACT_M:
                    impact = v - path.v_after[step + 1]
                    counts = counts_above_mps == 0.0 or impact > counts_above_mps
                    found[i, cut] = counts and overlaps(path.x_after[step + 1], x)
                    break
