"""The estimators' only input: a block of consecutive episodes as plain arrays; and blocks from the records of a run.

A block is what a shard of records says about weights and outcomes, and nothing else. Exact Markov chains (in the
tests), the twin and SUMO all end here, so that an estimator cannot tell them apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from harness.campaign.campaign import Campaign
from harness.errors import MEND_PART, RunFolderError
from harness.strata import ShellDesign
from harness.vocabulary import (
    CRASH,
    FAILED,
    OUTCOMES,
    SAMPLING,
    TIMEOUT,
    BoolArray,
    FloatArray,
    Int8Array,
    IntArray,
    Method,
    Sampling,
)

MAX_CONTROL_STEPS = 9
"""Control steps that sparse control variates are built from, at most ([paper] section VI-E)."""
EPISODE_COLUMNS = (
    "episode", "outcome", "event_step", "impact_speed_mps", "n_control_steps", "log_weight", "log_p_event",
    "n_steps", "end_ttc_s", "took_over_step", "braked_step", "asked_to_speed_up", "braked_before", "fell_behind",
)  # fmt: skip
SHELL_COLUMNS = ("component", "cell", "cell_mass")
BASELINE_COLUMNS = ("shadow", "event_mass")
"""Of vehicles that act before the event, where `ShellDesign.candidates` says that they are on record."""
ACTS = "took_over_early", "braked_early", "asked_to_speed_up", "braked_before", "fell_behind", "braked"
"""What AVs do, or ask for in vain, before the event, and whether they brake after its onset; columns of blocks."""
DANGER_TTC_S = 2.0
"""A test whose time was up with less to a collision (s), had the AV kept its acceleration, was cut off [assumed].

A driver who is going to react has begun to brake by then; with 4 s many were counted that stay clear."""
MOMENT_COLUMNS = ("episode", "q_sampled", "q")
Column = NDArray[Any]


@dataclass(frozen=True, eq=False)
class SamplingPlan:
    """How all tests of a campaign are drawn.

    ``alpha`` (M,) are the mixture weights of the importance functions ``names``; ``weight_cap`` bounds Y =
    1{crash}·weight of every episode by design, seen or not, None if nothing does; ``epsilon`` is the least share of its
    exposure with which the step mixture draws a maneuver; ``shells`` is what is known of the strata, where tests are
    drawn from some. Crashes count with an impact above ``counts_above_mps``, all of them at 0.
    """

    method: Method
    alpha: FloatArray = field(default_factory=lambda: np.zeros(0))
    weight_cap: float | None = None
    shells: ShellDesign | None = None
    counts_above_mps: float = 0.0
    epsilon: float = 0.0
    names: tuple[str, ...] = ()

    @property
    def sampling(self) -> Sampling:
        """What is to be known of the method."""
        return SAMPLING[self.method]


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive episodes ``first_episode … first_episode + n - 1``, in index order.

    ``outcome`` (n,) are places in `OUTCOMES`: a failed episode is a row like any other and never a crash.
    ``log_weight`` (n,) is log p(x_c) - log q_sampled(x_c), exactly 0 without control. ``columns``, also as attributes,
    are what else the method records, a row for each episode: bool (n,) ``happened``, ``cut_off`` (`DANGER_TTC_S`),
    ``took_over_early`` (the AV did something before the event was complete, as BV on its lane), ``asked_to_speed_up``
    (or that in vain) and ``braked_before`` (it asked to brake before anything happened), ``fell_behind`` (it did not
    keep up till then), ``braked`` (by `BRAKED_MPS2` after the onset) and ``braked_early`` (so before it was complete);
    ``impact_mps`` (n,), closing speed at contact, NaN without a crash; ``n_control_steps`` (n,). ``log_q`` (n, M) is,
    per importance function, the sum over control steps of log(q_j/p), -inf where q_j cannot draw the episode;
    ``martingale`` (n, J) the D_j of `harness.estimators.doubly_robust`;
    ``first_ratios`` (n, 9, J) q_j(a_t|s_t)/q_alpha(a_t|s_t) of the first nine control steps, 1 beyond the last one;
    ``log_p_event`` (n,) log P(event | path), where the path is drawn ahead: it bounds Y of that episode alone. Of
    shells ``stratum`` and ``cell`` (n,), ``cell_mass`` (n, C), its path's probability of an event of each cell, and
    `BASELINE_COLUMNS`, with ``step`` (n,) of the event, below 0 where a failed test has come to none.
    """

    first_episode: int
    outcome: Int8Array
    log_weight: FloatArray
    columns: Mapping[str, Column]
    drawn: SamplingPlan

    def __len__(self) -> int:
        return len(self.outcome)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "columns" or name not in self.columns:
            raise AttributeError(f"the block has no {name}")
        return self.columns[name]

    @property
    def crash(self) -> BoolArray:
        """Which episodes ended in a crash of the AV, shape (n,)."""
        return np.asarray(self.outcome == CRASH)

    @property
    def failed(self) -> BoolArray:
        """Which episodes failed, shape (n,)."""
        return np.asarray(self.outcome == FAILED)

    def n_crashes_before_event(self, onset: int | None) -> int:
        """How many episodes ended in a crash before their event, where it is known before its ``onset`` (steps)."""
        early = True if onset is None else self.n_steps <= onset
        return int(np.count_nonzero(self.crash & ~self.happened & early))

    def acts(self) -> dict[str, int]:
        """In how many episodes there was an event, and in how many the AV did each of `ACTS`."""
        counted = {"n_events": self.happened} | {f"n_{act}": self.columns[act] for act in ACTS if act in self.columns}
        return {name: int(np.count_nonzero(rows)) for name, rows in counted.items()}

    def weights(self) -> FloatArray:
        """Likelihood ratios p/q_sampled, shape (n,); infinite where they overflow."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_weight)

    def weighted_crashes(self) -> FloatArray:
        """Y = 1{crash}·weight, shape (n,)."""
        y, crash = np.zeros(len(self)), self.crash
        y[crash] = np.exp(self.log_weight[crash])
        return y

    def mixture_ratios(self) -> FloatArray:
        """q_j(x_c)/q_sampled(x_c) over whole episodes, shape (n, M); 0 where q_j cannot draw the episode."""
        with np.errstate(over="ignore"):
            return np.asarray(np.exp(self.log_q + self.log_weight[:, None]))

    def log_cap(self) -> float:
        """Log of a bound on Y of these tests, whatever the AV does; inf if none is known.

        Of forced events it is P(event | path)/share, the largest. The step mixture draws each maneuver with ε times
        its exposure at least: after l control steps, no more than the longest test has steps, W ≤ ε^-l.
        """
        drawn, sampling = self.drawn, self.drawn.sampling
        if sampling.mixes_steps and drawn.epsilon > 0.0 and "n_steps" in self.columns:
            return -math.log(drawn.epsilon) * int(self.n_steps.max())
        if "log_p_event" not in self.columns or not sampling.forces:
            return math.inf
        share = float(drawn.alpha[0]) if sampling.mixes else 1.0  # of forced events: the defensive component is first
        if share == 0.0:
            return math.inf
        return float(np.max(self.log_p_event, initial=-math.inf)) - math.log(share)

    def ending(self, rows: BoolArray, outcome: int) -> Block:
        """The same episodes, had some of them ended otherwise, each with the weight that it has on record."""
        return replace(self, outcome=np.where(rows, np.int8(outcome), self.outcome)) if rows.any() else self

    def harder_than(self, speed_mps: float) -> Block:
        """The same episodes, where a crash counts only with an impact above this speed."""
        return self.ending(self.crash & (self.impact_mps <= speed_mps), TIMEOUT)

    def failed_as_crashes(self) -> Block:
        """The same episodes had every failed one crashed, each with the weight that it has on record.

        That is the weight up to the step in which it failed. The step depends on nothing that comes after it, so that
        the mean of these weights is the probability to fail, whatever the episodes were drawn by.
        """
        return self.ending(self.failed, CRASH)

    def cut_off_as_failed(self) -> Block:
        """The same episodes, where it is unknown how those would have ended whose time was up before a collision."""
        return self.ending(self.cut_off, FAILED)

    def take(self, rows: slice) -> Block:
        """Cut out the block of some consecutive rows, a slice with step 1."""
        start, stop, _ = rows.indices(len(self))
        is_all = (start, stop) == (0, len(self))
        return self if is_all else self.chosen(slice(start, stop), self.first_episode + start)

    def chosen(self, rows: slice | IntArray, first_episode: int = 0) -> Block:
        """Block of any rows, numbered anew."""
        columns = {name: column[rows] for name, column in self.columns.items()}
        outcome, log_weight = self.outcome[rows], self.log_weight[rows]
        return replace(self, first_episode=first_episode, outcome=outcome, log_weight=log_weight, columns=columns)


def joined(blocks: Sequence[Block]) -> Block:
    """One block of consecutive ones of the same campaign."""
    if len(blocks) == 1:
        return blocks[0]
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    outcome = np.concatenate([block.outcome for block in blocks])
    log_weight = np.concatenate([block.log_weight for block in blocks])
    return replace(blocks[0], outcome=outcome, log_weight=log_weight, columns=columns)


def block_from_tables(
    campaign: Campaign, episodes: pa.Table, moments: pa.Table | None = None, shells: ShellDesign | None = None
) -> Block:
    """Block of one shard; rows that are missing, out of order, or contradict each other are a `RunFolderError`.

    ``episodes`` are consecutive rows of that table, in index order, with `EPISODE_COLUMNS`, of ``shells`` also
    `SHELL_COLUMNS`; ``moments``, of the step mixture, are their control steps in order, with `MOMENT_COLUMNS`.
    """
    sampling = campaign.sampling
    alpha = np.array(campaign.mixture_weights, dtype=np.float64)
    index = _consecutive(episodes)
    outcome = outcome_places(episodes.column("outcome"), "episodes")
    failed = outcome == FAILED
    n_control_steps = _integers(episodes, "n_control_steps")
    close = pc.less(episodes["end_ttc_s"], DANGER_TTC_S)
    early = {
        f"{did}_early": pc.fill_null(pc.less_equal(episodes[f"{did}_step"], episodes["event_step"]), fill_value=False)
        for did in ("took_over", "braked")
    }
    columns: dict[str, Column] = {
        "happened": _known(episodes, "event_step"),
        "n_control_steps": n_control_steps,
        "n_steps": _integers(episodes, "n_steps"),
        "impact_mps": np.asarray(episodes["impact_speed_mps"].to_numpy(), dtype=np.float64),
        "cut_off": (outcome == TIMEOUT) & pc.fill_null(close, fill_value=False).to_numpy(),
        **{name: values.to_numpy() for name, values in early.items()},
        **{name: episodes[name].to_numpy() for name in ("asked_to_speed_up", "braked_before", "fell_behind")},
        "braked": _known(episodes, "braked_step"),
    }
    if sampling.mixes:
        columns["log_q"] = _nested(episodes, "log_q", len(alpha))
        columns["martingale"] = _nested(episodes, "martingale", len(campaign.surrogates))
    if moments is not None and sampling.mixes_steps:
        columns["first_ratios"] = _first_ratios(moments, index, np.where(failed, 0, n_control_steps))
    if np.all(_known(episodes, "log_p_event") | failed):
        columns["log_p_event"] = np.asarray(pc.fill_null(episodes.column("log_p_event"), -np.inf).to_numpy())
    if shells is not None:
        columns["stratum"], columns["cell"] = _integers(episodes, "component"), _integers(episodes, "cell")
        columns["cell_mass"] = _nested(episodes, "cell_mass", len(shells.cell_stratum))
        if shells.candidates:
            columns |= {name: episodes.column(name).to_numpy() for name in BASELINE_COLUMNS}
            step = pc.fill_null(episodes.column("event_step"), -1).to_numpy()
            columns["step"] = np.where(columns["happened"], step, -1 - index).astype(np.int64)
    testing, above_mps = campaign.testing, campaign.crash.counts_above_mps
    cap = None if sampling.controlled else 1.0
    drawn = SamplingPlan(testing.method, alpha, cap, shells, above_mps, testing.epsilon, campaign.importance_names)
    block = Block(int(index[0]), outcome, _log_weights(episodes, failed, int(index[0])), columns, drawn)
    return block.harder_than(above_mps) if above_mps > 0.0 else block


def _consecutive(episodes: pa.Table) -> IntArray:
    """Indices of the episodes, each one more than the last."""
    index = _integers(episodes, "episode")
    if not index.size:
        raise _damaged("episodes", "no rows", "at least one episode per shard")
    if (gaps := np.diff(index) != 1).any():
        row = int(np.argmax(gaps))
        expected = "every episode once, in index order; a failed one is a row too"
        raise _damaged(f"episodes, row {row + 1}", f"episode {index[row + 1]} after episode {index[row]}", expected)
    return index


def _damaged(where: str, found: str, expected: str) -> RunFolderError:
    return RunFolderError(where, found, expected, MEND_PART)


def _integers(table: pa.Table, name: str) -> IntArray:
    return np.asarray(table.column(name).to_numpy()).astype(np.int64)


def _known(table: pa.Table, name: str) -> BoolArray:
    return np.asarray(pc.is_valid(table.column(name))).astype(np.bool_)


def outcome_places(column: pa.ChunkedArray, where: str) -> Int8Array:
    """How each episode ended, as a place in `OUTCOMES`, shape (n,); a `RunFolderError` where one is unknown."""
    coded = column.cast(pa.string()).combine_chunks().dictionary_encode()
    names = coded.dictionary.to_pylist()
    if coded.null_count or not {*names} <= {*OUTCOMES}:
        unknown = next((name for name in names if name not in OUTCOMES), None)
        found = "an episode without outcome" if unknown is None else f"the outcome {unknown!r}"
        mend = "The records are from another version of the harness: use that version, or run again."
        raise RunFolderError(where, found, f"one of {', '.join(OUTCOMES)}", mend)
    return np.asarray(np.array([OUTCOMES.index(name) for name in names], np.int8)[coded.indices.to_numpy()])


def _nested(table: pa.Table, name: str, width: int) -> FloatArray:
    """Read a fixed-size list column as an array of shape (rows, width)."""
    column = table.column(name).combine_chunks()
    values = np.asarray(column.flatten().to_numpy(zero_copy_only=False), dtype=np.float64)
    if len(values) != table.num_rows * width:
        expected = f"{width} in each row, by importance function or surrogate of the campaign"
        mend = "Restore shells.json and campaign.yaml as the run has written them: they, or the tables, are of another."
        raise RunFolderError(f"column {name}", f"{len(values)} numbers in {table.num_rows} rows", expected, mend)
    return values.reshape(table.num_rows, width)


def _log_weights(episodes: pa.Table, failed: BoolArray, first: int) -> FloatArray:
    """Log weights; that of a failed episode may be unknown and is then 0, the weight of an uncontrolled test."""
    log_weight = np.array(episodes.column("log_weight").to_numpy(), dtype=np.float64)
    log_weight[np.isnan(log_weight) & failed] = 0.0
    wrong = np.isnan(log_weight) | np.isposinf(log_weight)
    if wrong.any():
        row = int(np.argmax(wrong))
        found, expected = f"log_weight {log_weight[row]}", "a number: every weight decides the crash rate"
        raise _damaged(f"episodes, episode {first + row}", found, expected)
    return log_weight


def _first_ratios(moments: pa.Table, index: IntArray, n_control_steps: IntArray) -> FloatArray:
    """q_j/q_sampled of the first nine control steps of each episode, shape (n, 9, J); 1 beyond the last one."""
    row = _integers(moments, "episode") - index[0]
    if len(row) and (row[0] < 0 or row[-1] >= len(index) or np.any(np.diff(row) < 0)):
        found = f"rows of episodes {row.min() + index[0]} to {row.max() + index[0]}, or out of order"
        raise _damaged("moments", found, f"episodes {index[0]} to {index[-1]}, in order")
    counts = np.bincount(row, minlength=len(index))
    needed = np.minimum(n_control_steps, MAX_CONTROL_STEPS)
    if (counts < needed).any():
        episode = int(np.argmax(counts < needed))
        expected = f"{needed[episode]} as the episodes table says"
        raise _damaged(f"moments, episode {index[episode]}", f"{counts[episode]} control steps", expected)
    rank = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
    n_surrogates = moments.schema.field("q").type.list_size
    q, q_sampled = _nested(moments, "q", n_surrogates), moments.column("q_sampled").to_numpy()
    first = rank < MAX_CONTROL_STEPS
    ratios = np.ones((len(index), MAX_CONTROL_STEPS, n_surrogates))
    ratios[row[first], rank[first]] = q[first] / q_sampled[first, None]
    return ratios
