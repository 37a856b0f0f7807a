"""Which surrogates would have crashed in stored episodes, in the place of an AV that keeps its speed until the cut-in.

Where the AV's crash ended the episode early, BV's free driving goes on under p with the episode's own random numbers:
the weight of the episode is that of its control steps, whatever comes after them.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from harness.compiled import compiled_threads
from harness.episode.path import Followers, Trajectory, empty_trajectory, who_crashes
from harness.errors import CampaignError, RunFolderError
from harness.pool.cut_ins import Pool, environment_hash
from harness.pool.replay import StoredPaths, approach_cut_in, leave_stored, stored_paths
from harness.records.folder import MEND_SHARD
from harness.resolved import Resolved
from harness.traffic.laws import Environment
from harness.unboxed import unboxed
from harness.vocabulary import BV_LV_CONTACT, RUNNING, BoolArray, IntArray


@compiled_threads
def replay_surrogates(
    stored: StoredPaths,
    environment: Environment,
    followers: Followers,
    path: Trajectory,
    crashes: IntArray,
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
        if decided == BV_LV_CONTACT and step == cut + 1:
            continue
        if decided != RUNNING or not leave_stored(i, max_steps, stored, environment, path):
            return i
        crashes[i] = who_crashes(followers, cut, stored.lead[i], environment, path)
    return -1


def drivers_crash(episodes: pa.Table, seed: int, environment: Environment, followers: Followers) -> BoolArray:
    """Which drivers (D,) would have crashed in the place of the AV, shape (n, D).

    ``episodes`` are consecutive rows of the episodes table, with `PATH_COLUMNS`; ``seed`` is that of the campaign.

    Raises
    ------
    RunFolderError
        An episode's maneuvers do not fit its steps.
    """
    stored = stored_paths(episodes, seed)
    bits = np.zeros(episodes.num_rows, np.int64)
    room = empty_trajectory(environment)
    wrong = replay_surrogates(unboxed(stored), unboxed(environment), unboxed(followers), unboxed(room), bits)
    if wrong >= 0:
        raise RunFolderError(
            f"episodes, episode {stored.first + wrong}",
            f"maneuvers that do not lead to a cut-in in step {stored.cut_step[wrong]}",
            "the maneuvers that were driven: they determine the episode",
            MEND_SHARD,
        )
    found: BoolArray = ((bits[:, None] >> np.arange(followers.drivers.size)) & 1).astype(np.bool_)
    return found


class SurrogateReplay:
    """The surrogates of a pool in the place of a campaign's AV; a pool of another environment is a `CampaignError`."""

    def __init__(self, resolved: Resolved, pool: Pool) -> None:
        self._environment, self._seed = resolved.environment, resolved.campaign.seed
        if pool.environment != (own := environment_hash(self._environment)):
            raise CampaignError(
                "pool",
                f"a pool of another environment ({pool.environment})",
                f"one of the campaign's ({own}): crash rates of surrogates depend on traffic, level of lane "
                "changing and hold time",
                "Leave the pool out: the right one is built, which takes about 15 s.",
            )
        names = list(pool.library.surrogates)
        self._followers = pool.library.followers_in(self._environment)
        self._order = [names.index(name) for name in pool.names]

    def crashes(self, episodes: pa.Table) -> BoolArray:
        """Which surrogates would have crashed in consecutive episodes, shape (n, D), in the order of the pool."""
        return drivers_crash(episodes, self._seed, self._environment, self._followers)[:, self._order]
