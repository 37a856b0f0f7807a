"""Ask the surrogates of a pool about stored episodes, and know how often each of them crashes in all traffic."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from harness.arrays import BoolArray, Int8Array, IntArray, RecordArray
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
LEAD = "lead_steps"
"""And since when BV shows what it will do, where cut-ins take time."""


class SurrogateReplay:
    """The surrogates of a pool, in the place of a campaign's AV.

    Raises
    ------
    CampaignError
        The pool is of another environment.

    Attributes
    ----------
    known : KnownRates
    columns : tuple of str
        What of the episodes table it needs.
    """

    def __init__(self, resolved: Resolved, pool: Pool) -> None:
        self._environment, self._seed = resolved.environment, resolved.campaign.seed
        _require_same_environment(self._environment, pool)
        self.known = KnownRates(pool.key, pool.names, pool.mu, pool.mu_covariance, pool.p_cut_in_at_crash)
        self.columns = (*PATH_COLUMNS, *((LEAD,) if self._environment.lateral.present else ()))
        names = list(pool.library.surrogates)
        self._drivers, self._envelope = (
            pool.library.drivers_in(resolved.environment),
            names.index(pool.library.envelope),
        )
        self._order = [names.index(name) for name in pool.names]

    def crashes(self, episodes: pa.Table) -> BoolArray:
        """Which surrogates would have crashed, shape (n, D), in the order of ``known.names``; see `drivers_crash`."""
        return drivers_crash(episodes, self._seed, self._environment, self._drivers, self._envelope)[:, self._order]


def _require_same_environment(environment: Environment, pool: Pool) -> None:
    """Refuse a pool of another environment: its crash rates would be those of other traffic."""
    own = environment_hash(environment)
    if pool.environment != own:
        raise CampaignError(
            "pool",
            found=f"a pool of another environment ({pool.environment})",
            expected=f"one of the campaign's ({own}): crash rates of surrogates depend on traffic, level of lane "
            "changing and hold time",
            mend="Leave the pool out: the right one is built, which takes about 15 s.",
        )


def drivers_crash(
    episodes: pa.Table, seed: int, environment: Environment, drivers: RecordArray, envelope: int
) -> BoolArray:
    """Which drivers (D,) would have crashed in the place of the AV, shape (n, D).

    ``episodes`` are consecutive rows of the episodes table, with `PATH_COLUMNS`, ``seed`` is that of the campaign, and
    ``envelope`` as in `harness.episode.trajectory.who_crashes`.

    Raises
    ------
    RunFolderError
        An episode's maneuvers do not fit its steps.
    """
    stored = stored_paths(episodes, seed)
    bits = np.zeros(episodes.num_rows, np.int64)
    wrong = replay_surrogates(stored, environment, drivers, envelope, empty_trajectory(environment), bits)
    if wrong >= 0:
        raise RunFolderError(
            f"episodes, episode {stored.first + wrong}",
            found=f"maneuvers that do not lead to a cut-in in step {stored.cut_step[wrong]}",
            expected="the maneuvers that were driven: they determine the episode",
            mend=MEND_SHARD,
        )
    found: BoolArray = ((bits[:, None] >> np.arange(drivers.size)) & 1).astype(np.bool_)
    return found


def stored_paths(episodes: pa.Table, seed: int) -> StoredPaths:
    """Initial states and maneuvers of consecutive rows of the episodes table; needs `PATH_COLUMNS`."""
    return StoredPaths(
        seed,
        int(episodes.column("episode")[0].as_py()),
        states_from(np.asarray(episodes.column(name)) for name in STATE_COLUMNS),
        np.asarray(episodes.column("n_steps")).astype(np.int64),
        np.asarray(episodes.column("cut_in_step").fill_null(-1)).astype(np.int64),
        *_lists(episodes.column("lv_maneuvers")),
        *_lists(episodes.column("bv_maneuvers")),
        _leads(episodes),
    )


def _leads(episodes: pa.Table) -> IntArray:
    """Leads (steps) of the cut-ins, shape (n,); zero where those were one step."""
    if LEAD not in episodes.column_names:
        return np.zeros(episodes.num_rows, np.int64)
    return np.asarray(episodes.column(LEAD).fill_null(0)).astype(np.int64)


def _lists(column: pa.ChunkedArray) -> tuple[Int8Array, IntArray]:
    """All entries of a list column one after another, and where each row begins, with the end (n + 1,)."""
    lists = column.combine_chunks()
    lengths = np.asarray(lists.value_lengths()).astype(np.int64)
    values = np.array(lists.flatten(), dtype=np.int8)  # a copy: Arrow's own memory is read-only
    return values, np.concatenate([[0], np.cumsum(lengths)])
