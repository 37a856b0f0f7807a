"""Blocks from the Arrow tables that a run leaves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.errors import RunFolderError
from harness.estimators.block import MAX_CONTROL_STEPS, Block
from harness.records.folder import MEND_SHARD
from harness.strata import ShellDesign
from harness.vocabulary import BoolArray, FloatArray, IntArray, Method

EPISODE_COLUMNS = ("episode", "outcome", "cut_in_step", "n_control_steps", "log_weight", "log_p_cut_in", "log_q")
SHELL_COLUMNS = ("component", "cell", "cell_mass", "ahead_step")
MOMENT_COLUMNS = ("episode", "q_sampled", "q")


def block_from_tables(
    episodes: pa.Table,
    moments: pa.Table | None,
    *,
    method: Method,
    alpha: Sequence[float],
    shells: ShellDesign | None = None,
) -> Block:
    """Block of one shard.

    Parameters
    ----------
    episodes : pa.Table
        Rows of the ``episodes`` table, consecutive and in index order; needs `EPISODE_COLUMNS`.
    moments : pa.Table or None
        Control steps of the same episodes, sorted by episode and step; needs `MOMENT_COLUMNS`. Only used for the
        step mixture.
    method : str
        ``testing.method`` of the campaign.
    alpha : sequence of float
        Mixture weights in the order of ``log_q``, M of them.
    shells : ShellDesign, optional
        Strata of the campaign, if it draws from shells; needs `SHELL_COLUMNS`.

    Raises
    ------
    RunFolderError
        If rows are missing, out of order, or contradict each other.
    """
    index = _integers(episodes, "episode")
    _require_consecutive(index)
    outcomes = episodes.column("outcome").unify_dictionaries().combine_chunks()
    failed, n_control_steps = _ended(outcomes, "failed"), _integers(episodes, "n_control_steps")
    ratios = None
    if moments is not None and method == "step_mixture":
        ratios = _first_ratios(moments, index, np.where(failed, 0, n_control_steps))
    return Block(
        first_episode=int(index[0]),
        method=method,
        crash=_ended(outcomes, "crash"),
        failed=failed,
        cut_in=_known(episodes, "cut_in_step"),
        bv_lv_contact=_ended(outcomes, "bv_lv_contact"),
        log_weight=_log_weights(episodes, failed, int(index[0])),
        log_q=_nested(episodes, "log_q", len(alpha)),
        alpha=np.asarray(alpha, dtype=np.float64),
        n_control_steps=n_control_steps,
        first_ratios=ratios,
        weight_cap=1.0 if method == "nde" else None,
        log_p_cut_in=_log_p_cut_in(episodes, failed),
        stratum=None if shells is None else _integers(episodes, "component"),
        cell=None if shells is None else _integers(episodes, "cell"),
        cell_mass=None if shells is None else _nested(episodes, "cell_mass", len(shells.cell_stratum)),
        shells=shells,
        ahead=None if shells is None or shells.checked is None else _known(episodes, "ahead_step"),
    )


def _damaged(where: str, found: str, expected: str) -> RunFolderError:
    return RunFolderError(where, found=found, expected=expected, mend=MEND_SHARD)


def _integers(table: pa.Table, name: str) -> IntArray:
    return np.asarray(table.column(name).to_numpy()).astype(np.int64)


def _known(table: pa.Table, name: str) -> BoolArray:
    return np.asarray(pc.is_valid(table.column(name))).astype(np.bool_)


def _ended(outcomes: pa.DictionaryArray, name: str) -> BoolArray:
    """Rows that ended so, shape (n,)."""
    return np.asarray(outcomes.indices.to_numpy() == outcomes.dictionary.index(name).as_py())


def _nested(table: pa.Table, name: str, width: int) -> FloatArray:
    """Read a fixed-size list column as an array of shape (rows, width)."""
    column = table.column(name).combine_chunks()
    values = np.asarray(column.flatten().to_numpy(zero_copy_only=False), dtype=np.float64)
    if len(values) != table.num_rows * width:
        raise RunFolderError(
            f"column {name}",
            found=f"{len(values)} numbers in {table.num_rows} rows",
            expected=f"{width} in each row, one per importance function of the campaign",
            mend="The records belong to another campaign or are damaged. " + MEND_SHARD,
        )
    return values.reshape(table.num_rows, width)


def _require_consecutive(index: IntArray) -> None:
    if len(index) == 0:
        raise _damaged("episodes", "no rows", "at least one episode per shard")
    gaps = np.diff(index) != 1
    if gaps.any():
        at = int(np.argmax(gaps))
        raise _damaged(
            f"episodes, row {at + 1}",
            f"episode {index[at + 1]} after episode {index[at]}",
            "every episode once, in index order; a failed one is a row too",
        )


def _log_weights(episodes: pa.Table, failed: BoolArray, first: int) -> FloatArray:
    """Log weights; that of a failed episode may be unknown and is then 0, the weight of an uncontrolled test."""
    log_weight = np.array(episodes.column("log_weight").to_numpy(), dtype=np.float64)
    log_weight[np.isnan(log_weight) & failed] = 0.0
    wrong = np.isnan(log_weight) | np.isposinf(log_weight)
    if wrong.any():
        at = int(np.argmax(wrong))
        found, expected = f"log_weight {log_weight[at]}", "a number: every weight decides the crash rate"
        raise _damaged(f"episodes, episode {first + at}", found, expected)
    return log_weight


def _log_p_cut_in(episodes: pa.Table, failed: BoolArray) -> FloatArray | None:
    """Log P(cut-in | path) where every finished episode has it, else None."""
    if not np.all(_known(episodes, "log_p_cut_in") | failed):
        return None
    return np.asarray(pc.fill_null(episodes.column("log_p_cut_in"), -np.inf).to_numpy())


def _first_ratios(moments: pa.Table, index: IntArray, n_control_steps: IntArray) -> FloatArray:
    """q_j/q_sampled of the first nine control steps of each episode, shape (n, 9, J); 1 beyond the last one."""
    row = _integers(moments, "episode") - index[0]
    if len(row) and (row[0] < 0 or row[-1] >= len(index) or np.any(np.diff(row) < 0)):
        raise _damaged(
            "moments",
            f"rows of episodes {row.min() + index[0]} to {row.max() + index[0]}, or out of order",
            f"episodes {index[0]} to {index[-1]}, in order",
        )
    counts, needed = np.bincount(row, minlength=len(index)), np.minimum(n_control_steps, MAX_CONTROL_STEPS)
    if (counts < needed).any():
        at = int(np.argmax(counts < needed))
        expected = f"{needed[at]} as the episodes table says"
        raise _damaged(f"moments, episode {index[at]}", f"{counts[at]} control steps", expected)
    rank = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
    n_surrogates = moments.schema.field("q").type.list_size
    q, q_sampled = _nested(moments, "q", n_surrogates), moments.column("q_sampled").to_numpy()
    kept = rank < MAX_CONTROL_STEPS
    ratios = np.ones((len(index), MAX_CONTROL_STEPS, n_surrogates))
    ratios[row[kept], rank[kept]] = q[kept] / q_sampled[kept, None]
    return ratios
