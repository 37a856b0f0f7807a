"""Ask the surrogates of a pool about stored episodes, and know how often each of them crashes in all traffic."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyarrow as pa

from harness.arrays import BoolArray, Int8Array, IntArray
from harness.environment.driving import Environment
from harness.episode.trajectory import empty_trajectory
from harness.errors import CampaignError, RunFolderError
from harness.pool.cut_ins import Pool, environment_hash
from harness.pool.replay import StoredPaths, replay_surrogates
from harness.records.folder import MEND_SHARD
from harness.resolved import Resolved
from harness.state import STATE_COLUMNS, states_from
from harness.strata import KnownRates

PATH_COLUMNS = ("episode", *STATE_COLUMNS, "n_steps", "cut_in_step", "lv_maneuvers", "bv_maneuvers")
"""What of the episodes table determines LV's and BV's motion."""
_PART = 512
"""Episodes that a thread replays at a time."""


class SurrogateReplay:
    """The surrogates of a pool, in the place of a campaign's AV.

    Parameters
    ----------
    resolved : Resolved
    pool : Pool

    Raises
    ------
    CampaignError
        The pool is of another environment.

    Attributes
    ----------
    known : KnownRates
    """

    def __init__(self, resolved: Resolved, pool: Pool) -> None:
        self._environment: Environment = resolved.environment
        require_same_environment(self._environment, pool)
        self.known = KnownRates(pool.key, pool.names, pool.mu, pool.mu_covariance)
        self._seed = resolved.campaign.seed
        names = list(pool.library.surrogates)
        self._drivers = pool.library.drivers
        self._envelope = names.index(pool.library.envelope)
        self._bits = np.array([names.index(name) for name in pool.names])

    def crashes(self, episodes: pa.Table) -> BoolArray:
        """Which surrogates would have crashed, shape (n, D), in the order of ``known.names``.

        Parameters
        ----------
        episodes : pa.Table
            Consecutive rows of the episodes table; needs `PATH_COLUMNS`.

        Raises
        ------
        RunFolderError
            An episode's maneuvers do not fit its steps.
        """
        stored = stored_paths(episodes, self._seed)
        parts = [rows_of(stored, begin, begin + _PART) for begin in range(0, episodes.num_rows, _PART)]
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            bits = np.concatenate(list(threads.map(self._replay, parts)))
        found: BoolArray = ((bits[:, None] >> self._bits[None, :]) & 1).astype(np.bool_)
        return found

    def _replay(self, stored: StoredPaths) -> IntArray:
        bits = np.zeros(stored.cut_step.size, np.int64)
        room = empty_trajectory(self._environment)
        wrong = replay_surrogates(stored, self._environment, self._drivers, self._envelope, room, bits)
        if wrong >= 0:
            raise RunFolderError(
                f"episodes, episode {stored.first + wrong}",
                found=f"maneuvers that do not lead to a cut-in in step {stored.cut_step[wrong]}",
                expected="the maneuvers that were driven: they determine the episode",
                mend=MEND_SHARD,
            )
        return bits


def require_same_environment(environment: Environment, pool: Pool) -> None:
    """Refuse a pool of another environment: its crash rates would be those of other traffic.

    Raises
    ------
    CampaignError
        It is one.
    """
    own = environment_hash(environment)
    if pool.environment != own:
        raise CampaignError(
            "pool",
            found=f"a pool of another environment ({pool.environment})",
            expected=f"one of the campaign's ({own}): crash rates of surrogates depend on traffic, level of lane "
            "changing and hold time",
            mend="Leave the pool out: the right one is built, which takes about 15 s.",
        )


def rows_of(stored: StoredPaths, begin: int, end: int) -> StoredPaths:
    """Some consecutive rows."""
    rows, edges = slice(begin, end), slice(begin, end + 1)
    return stored._replace(
        first=stored.first + begin,
        state=stored.state[rows],
        n_steps=stored.n_steps[rows],
        cut_step=stored.cut_step[rows],
        lv_begin=stored.lv_begin[edges],
        bv_begin=stored.bv_begin[edges],
    )


def stored_paths(episodes: pa.Table, seed: int) -> StoredPaths:
    """Initial states and maneuvers of consecutive rows of the episodes table; needs `PATH_COLUMNS`."""
    cut_step = episodes.column("cut_in_step").fill_null(-1)
    lv, lv_begin = _lists(episodes.column("lv_maneuvers"))
    bv, bv_begin = _lists(episodes.column("bv_maneuvers"))
    return StoredPaths(
        seed=seed,
        first=int(episodes.column("episode")[0].as_py()),
        state=states_from(np.asarray(episodes.column(name)) for name in STATE_COLUMNS),
        n_steps=np.asarray(episodes.column("n_steps")).astype(np.int64),
        cut_step=np.asarray(cut_step).astype(np.int64),
        lv=lv,
        lv_begin=lv_begin,
        bv=bv,
        bv_begin=bv_begin,
    )


def _lists(column: pa.ChunkedArray) -> tuple[Int8Array, IntArray]:
    """All entries of a list column one after another, and where each row begins, with the end (n + 1,)."""
    lists = column.combine_chunks()
    lengths = np.asarray(lists.value_lengths()).astype(np.int64)
    values = np.array(lists.flatten(), dtype=np.int8)  # a copy: Arrow's own memory is read-only
    return values, np.concatenate([[0], np.cumsum(lengths)])
