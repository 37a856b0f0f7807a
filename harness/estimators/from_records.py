"""Blocks from the Arrow tables that a run leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.arrays import BoolArray, FloatArray, IntArray
from harness.errors import RunFolderError
from harness.estimators.block import MAX_CONTROL_STEPS, Block
from harness.methods import Method
from harness.records.folder import MEND_SHARD
from harness.strata import ShellDesign

EPISODE_COLUMNS = (
    "episode",
    "outcome",
    "cut_in_step",
    "n_control_steps",
    "log_weight",
    "log_p_cut_in",
    "log_q",
)
SHELL_COLUMNS = ("component",)
MOMENT_COLUMNS = ("episode", "q_sampled", "q")


def block_from_tables(
    episodes: pa.Table,
    moments: pa.Table | None,
    *,
    method: Method,
    alpha: Sequence[float],
    weight_cap: float | None = None,
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
    weight_cap : float, optional
        Bound on Y that the design guarantees; 1 for ``nde`` and never above 1 for ``forced`` whatever is given.
    shells : ShellDesign, optional
        Strata of the campaign, if it draws from shells.

    Raises
    ------
    RunFolderError
        If rows are missing, out of order, or contradict each other.
    """
    index = _column(episodes, "episode").astype(np.int64)
    first = _require_consecutive(index)
    outcome_is = _outcome_is(episodes)
    failed = outcome_is("failed")
    n_control_steps = _column(episodes, "n_control_steps").astype(np.int64)
    ratios = None
    if moments is not None and method == "step_mixture":
        ratios = _first_ratios(moments, index, np.where(failed, 0, n_control_steps))
    return Block(
        first_episode=first,
        method=method,
        crash=outcome_is("crash"),
        failed=failed,
        cut_in=np.asarray(pc.is_valid(episodes.column("cut_in_step"))).astype(np.bool_),
        bv_lv_contact=outcome_is("bv_lv_contact"),
        log_weight=_log_weights(episodes, failed, first),
        log_q=_nested(episodes, "log_q", len(alpha)),
        alpha=np.asarray(alpha, dtype=np.float64),
        n_control_steps=n_control_steps,
        first_ratios=ratios,
        weight_cap=_design_cap(method, weight_cap),
        log_p_cut_in=_log_p_cut_in(episodes, failed),
        component=None if shells is None else _column(episodes, "component").astype(np.int64),
        shells=shells,
    )


def _design_cap(method: Method, given: float | None) -> float | None:
    """Bound on Y: a crash counts 1 under nde, P(cut-in | path) ≤ 1 under forced; else only what is given."""
    if method == "nde":
        return 1.0
    if method == "forced" and given is not None:
        return min(1.0, given)
    return given


def _column(table: pa.Table, name: str) -> FloatArray:
    return np.asarray(table.column(name).to_numpy())


def _outcome_is(episodes: pa.Table) -> Callable[[str], BoolArray]:
    """Give a function from an outcome's name to the rows that ended with it, shape (n,)."""
    column = episodes.column("outcome")
    encoded = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
    whole = encoded.unify_dictionaries().combine_chunks()
    codes = np.asarray(whole.indices.to_numpy(zero_copy_only=False))
    names = whole.dictionary.to_pylist()
    return lambda name: codes == (names.index(name) if name in names else -1)


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


def _require_consecutive(index: IntArray) -> int:
    if len(index) == 0:
        raise RunFolderError("episodes", found="no rows", expected="at least one episode per shard", mend=MEND_SHARD)
    steps = np.diff(index)
    if np.any(steps != 1):
        at = int(np.argmax(steps != 1))
        raise RunFolderError(
            f"episodes, row {at + 1}",
            found=f"episode {index[at + 1]} after episode {index[at]}",
            expected="every episode once, in index order; a failed one is a row too",
            mend=MEND_SHARD,
        )
    return int(index[0])


def _log_weights(episodes: pa.Table, failed: BoolArray, first: int) -> FloatArray:
    """Log weights; that of a failed episode may be unknown and is then 0, the weight of an uncontrolled test."""
    log_weight = np.array(_column(episodes, "log_weight"), dtype=np.float64)
    unknown = np.isnan(log_weight)
    log_weight[unknown & failed] = 0.0
    wrong = (unknown & ~failed) | np.isposinf(log_weight)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise RunFolderError(
            f"episodes, episode {first + at}",
            found=f"log_weight {log_weight[at]}",
            expected="a number: every weight decides the crash rate",
            mend=MEND_SHARD,
        )
    return log_weight


def _log_p_cut_in(episodes: pa.Table, failed: BoolArray) -> FloatArray | None:
    """Log P(cut-in | path) where every finished episode has it, else None."""
    column = episodes.column("log_p_cut_in")
    known = np.asarray(pc.is_valid(column)).astype(np.bool_)
    if not np.all(known | failed):
        return None
    return np.where(known, pc.fill_null(column, -np.inf).to_numpy(), -np.inf)


def _first_ratios(moments: pa.Table, index: IntArray, n_control_steps: IntArray) -> FloatArray:
    """q_j/q_sampled of the first nine control steps of each episode, shape (n, 9, J); 1 beyond the last one."""
    row = _column(moments, "episode").astype(np.int64) - index[0]
    if len(row) and (row[0] < 0 or row[-1] >= len(index) or np.any(np.diff(row) < 0)):
        raise RunFolderError(
            "moments",
            found=f"rows of episodes {row.min() + index[0]} to {row.max() + index[0]}, or out of order",
            expected=f"episodes {index[0]} to {index[-1]}, in order",
            mend=MEND_SHARD,
        )
    counts = np.bincount(row, minlength=len(index))
    _require_moments(counts, n_control_steps, int(index[0]))
    rank = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
    n_surrogates = moments.schema.field("q").type.list_size
    q = _nested(moments, "q", n_surrogates)
    kept = rank < MAX_CONTROL_STEPS
    ratios = np.ones((len(index), MAX_CONTROL_STEPS, n_surrogates))
    ratios[row[kept], rank[kept]] = q[kept] / _column(moments, "q_sampled")[kept, None]
    return ratios


def _require_moments(counts: IntArray, n_control_steps: IntArray, first: int) -> None:
    """Each episode must have all its control steps on record, or its first nine."""
    short = counts < np.minimum(n_control_steps, MAX_CONTROL_STEPS)
    if short.any():
        at = int(np.argmax(short))
        raise RunFolderError(
            f"moments, episode {first + at}",
            found=f"{counts[at]} control steps",
            expected=f"{min(int(n_control_steps[at]), MAX_CONTROL_STEPS)} as the episodes table says",
            mend=MEND_SHARD,
        )
