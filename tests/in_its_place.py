"""Surrogates in the AV's place, in the twin, on the paths of stored tests.

The stored maneuvers determine LV's and BV's motion; where the AV's crash ended an episode early, BV goes on under p
with the episode's own random numbers. Weighted, such crashes have the surrogate's rate, whatever the tests were drawn
from and whatever the AV is.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.path import Trajectory, empty_trajectory, end_in, walk, who_crashes
from harness.families.cut_in.replay import StoredPaths, leave_stored, recall
from harness.families.cut_in.script import maneuvers_of, states_of
from harness.pool.kept import Pool
from harness.records.schemas import chosen_from
from harness.resolved import Resolved
from harness.vehicles.drivers import Followers
from harness.vocabulary import CONTACT, FAILED, PASSED, RUNNING, BoolArray, IntArray


@compiled_inline
def approach(i: int, until: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> tuple[int, int]:
    """LV's and BV's stored motion to a step or a decision without cut-in; how it is decided, and the step.

    `FAILED` where fewer maneuvers are stored than that takes.
    """
    known = recall(i, stored, path)
    reach = min(until, known * environment.numbers.hold_steps, environment.numbers.max_steps)
    step = walk(stored.state[i], stored.seed, stored.episode[i], known, reach, True, environment, path)
    decided = end_in(step, path)
    return FAILED if decided == RUNNING and step < until else decided, step


@compiled_inline
def approach_cut_in(i: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> tuple[int, int]:
    """`approach` through the step of the stored cut-in: BV may touch LV before it has left the lane."""
    cut = stored.cut_step[i]
    decided, step = approach(i, cut + 1, stored, environment, path)
    if decided == PASSED and step == cut + 1:  # beside the AV on its own lane: that is for the AV to answer
        return RUNNING, step
    return decided, step


@compiled_threads
def replay_surrogates(
    stored: StoredPaths, environment: Environment, followers: Followers, path: Trajectory, crashes: IntArray
) -> int:
    """Which drivers would have crashed in each stored episode of an AV that keeps its speed until the cut-in.

    ``crashes`` (n,) receives one bit per driver, none without a cut-in; ``path`` is room to work in. Returns the row
    of the first episode whose maneuvers do not fit its steps, or -1.
    """
    max_steps = environment.numbers.max_steps
    for i in range(stored.cut_step.size):
        crashes[i] = 0
        cut = stored.cut_step[i]
        if cut < 0:
            continue
        decided, step = approach_cut_in(i, stored, environment, path)
        if decided == CONTACT and step == cut + 1:
            continue
        if decided != RUNNING or not leave_stored(i, max_steps, stored, environment, path):
            return i
        crashes[i] = who_crashes(followers, cut, stored.script.lead[i], environment, path)
    return -1


def stored_paths(episodes: pa.Table, seed: int) -> StoredPaths:
    """Initial states and maneuvers of rows of the episodes table; needs `path_columns`."""
    chosen = chosen_from(episodes, CUT_IN)
    index, n_steps = (np.asarray(episodes.column(name)).astype(np.int64) for name in ("episode", "n_steps"))
    return StoredPaths(seed, index, states_of(chosen.facts), n_steps, chosen.at, maneuvers_of(chosen))


def drivers_crash(episodes: pa.Table, seed: int, environment: Environment, followers: Followers) -> BoolArray:
    """Which drivers (D,) would have crashed in the place of the AV, shape (n, D).

    ``episodes`` are consecutive rows of the episodes table, with `path_columns`; ``seed`` is that of the campaign.
    """
    stored, bits = stored_paths(episodes, seed), np.zeros(episodes.num_rows, np.int64)
    room = empty_trajectory(environment)
    assert replay_surrogates(unboxed(stored), unboxed(environment), unboxed(followers), unboxed(room), bits) < 0
    found: BoolArray = ((bits[:, None] >> np.arange(followers.drivers.size)) & 1).astype(np.bool_)
    return found


def surrogates_crash(episodes: pa.Table, resolved: Resolved, pool: Pool) -> BoolArray:
    """`drivers_crash` of a pool's surrogates, in its order, shape (n, D)."""
    environment, names = resolved.environment, list(pool.library.surrogates)
    followers = pool.library.followers(environment.lateral.present)
    crashes = drivers_crash(episodes, resolved.campaign.seed, environment, followers)
    return crashes[:, [names.index(name) for name in pool.names]]
