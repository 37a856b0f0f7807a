"""One pass over all episodes: everything that the plots and tables need, in memory that does not grow with n."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.errors import RunFolderError
from harness.records.reader import stored_columns
from harness.report.histograms import Axis, FineHistogram
from harness.report.run_folder import RunFolder, floats
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import CRASH, FAILED, OUTCOMES, BoolArray, FloatArray, IntArray

MOST_CAUSES = 1_000
CANDIDATES = 50
"""Crashes kept per ranking: more than are shown, because with a share of traces only some of the worst have one."""
R2DOT_MPS, R2_M = Axis(-30.0, 20.0, 0.5), Axis(0.0, 150.0, 2.5)


@dataclass(frozen=True)
class Crash:
    """One crash as its row in ``episodes`` describes it; units as in the schema."""

    episode: int
    impact_speed_mps: float
    crash_time_s: float
    log_weight: float
    cut_in_step: float
    cut_in_r2_m: float
    cut_in_r2dot_mps: float
    component: int

    @property
    def weight(self) -> float:
        """What this one crash adds to the sum that is the estimate: likelihood ratio, or p_s/n_s in a shell."""
        return math.exp(self.log_weight)

    @property
    def cut_in_time_s(self) -> float:
        """Time at the start of the step in which BV cut in."""
        return STEP_S * self.cut_in_step


NUMBERS = (*(column.name for column in fields(Crash)), "n_control_steps")


class WorstCrashes:
    """The first `CANDIDATES` crashes by one key, kept while streaming; ties go to the smaller episode index."""

    def __init__(self, key: str) -> None:
        self.key = key
        self.crashes: list[Crash] = []

    def add(self, columns: dict[str, FloatArray], is_crash: BoolArray) -> None:
        """Offer a batch: ``columns`` by field name, each of shape (m,)."""
        rows = np.flatnonzero(is_crash & np.isfinite(columns[self.key]))
        best = rows[np.lexsort((columns["episode"][rows], -columns[self.key][rows]))[:CANDIDATES]]
        self.crashes += [_crash(columns, int(row)) for row in best]
        self.crashes.sort(key=lambda crash: (-getattr(crash, self.key), crash.episode))
        del self.crashes[CANDIDATES:]


def _crash(columns: dict[str, FloatArray], row: int) -> Crash:
    values: dict[str, Any] = {column.name: float(columns[column.name][row]) for column in fields(Crash)}
    return Crash(**{**values, "episode": int(values["episode"]), "component": int(values["component"])})


class RunSummary:
    """Counts, weight sums and histograms of a run.

    Weighted sums use the likelihood ratio of each episode: divided by the number of tests they say how often something
    happens in naturalistic driving. Tests from shells weigh p_s/n_s instead, and their sums need no division:
    `per_test` knows. Failed episodes are counted but have no weight.

    Attributes
    ----------
    log_scales : ndarray, shape (S,), optional
        For tests that were drawn from shells: added to the recorded log-weight of each, see `_log_scales`.
    count, weight : ndarray, shape (5,)
        Episodes and sum of weights per outcome, in the order of ``OUTCOMES``.
    causes : Counter of str
        Failed episodes per cause.
    stratum_crash, response_time_s : FineHistogram
        Of crashes: number of control steps, time from cut-in to crash.
    cut_in, cut_in_crash : FineHistogram
        Of all cut-ins and of those that crash: R2dot (rows) and R2.
    hardest, heaviest, outermost : WorstCrashes
        By impact speed, by weight, and (of tests from shells) from the most careless shell inwards.
    """

    def __init__(self, log_scales: FloatArray | None = None) -> None:
        self.log_scales = log_scales
        self.count, self.weight = np.zeros(len(OUTCOMES)), np.zeros(len(OUTCOMES))
        self.causes: Counter[str] = Counter()
        self.log_weight_range = (math.inf, -math.inf)
        self.log10_weight, self.log10_weight_crash = (FineHistogram(Axis(-80.0, 20.0, 0.02)) for _ in range(2))
        self.stratum_crash = FineHistogram(Axis(-0.5, 600.5, 1.0))
        self.impact_speed_mps = FineHistogram(Axis(0.0, 80.0, 0.1))
        self.crash_time_s, self.response_time_s = (FineHistogram(Axis(0.0, 60.0, 0.1)) for _ in range(2))
        self.cut_in, self.cut_in_crash = (FineHistogram(R2DOT_MPS, R2_M) for _ in range(2))
        self.hardest, self.heaviest = WorstCrashes("impact_speed_mps"), WorstCrashes("log_weight")
        self.outermost = WorstCrashes("component")

    @property
    def n_episodes(self) -> int:
        """Number of tests, failed ones included."""
        return int(self.count.sum())

    @property
    def n_crashes(self) -> int:
        """Number of sampled crashes."""
        return int(self.count[CRASH])

    @property
    def n_failed(self) -> int:
        """Number of tests that failed."""
        return int(self.count[FAILED])

    @property
    def all_weights_one(self) -> bool:
        """Whether no maneuver was drawn from an importance function: plain naturalistic driving."""
        return self.log_weight_range == (0.0, 0.0)

    @property
    def from_shells(self) -> bool:
        """Whether tests were drawn from shells."""
        return self.log_scales is not None

    def per_test(self, weight: float) -> float:
        """How often per naturalistic test something happens whose weights add up to ``weight``."""
        return weight if self.from_shells else weight / max(self.n_episodes, 1)

    def add(self, batch: pa.RecordBatch, outcome: IntArray) -> None:
        """Add a batch whose outcomes are given as indices into ``OUTCOMES``."""
        columns = {name: floats(batch.column(name)) for name in NUMBERS}
        if self.log_scales is not None:
            columns["log_weight"] = columns["log_weight"] + self.log_scales[columns["component"].astype(np.int64)]
        valid, crash = outcome != FAILED, outcome == CRASH
        weight = np.where(valid, np.exp(columns["log_weight"]), 0.0)
        self.count += np.bincount(outcome, minlength=len(OUTCOMES))
        self.weight += np.bincount(outcome, weights=weight, minlength=len(OUTCOMES))
        self._add_causes(batch.column("failure"))
        self._add_weights(columns["log_weight"], weight, valid, crash)
        for grid, rows in ((self.cut_in, valid), (self.cut_in_crash, crash)):
            grid.add(weight[rows], columns["cut_in_r2dot_mps"][rows], columns["cut_in_r2_m"][rows])
        self._add_crashes(columns, weight, crash)

    def _add_causes(self, failure: pa.Array) -> None:
        for item in failure.drop_null().value_counts():
            cause = item["values"].as_py()
            # Causes may hold numbers and so be all different: memory stays bounded, the count per outcome is exact.
            if cause in self.causes or len(self.causes) < MOST_CAUSES:
                self.causes[cause] += item["counts"].as_py()

    def _add_weights(self, log_weight: FloatArray, weight: FloatArray, valid: BoolArray, crash: BoolArray) -> None:
        low, high = self.log_weight_range
        seen = log_weight[valid]
        self.log_weight_range = (float(seen.min(initial=low)), float(seen.max(initial=high)))
        for histogram, rows in ((self.log10_weight, valid), (self.log10_weight_crash, crash)):
            histogram.add(weight[rows], log_weight[rows] / math.log(10.0))

    def _add_crashes(self, columns: dict[str, FloatArray], weight: FloatArray, crash: BoolArray) -> None:
        for histogram, values in (
            (self.stratum_crash, columns["n_control_steps"]),
            (self.impact_speed_mps, columns["impact_speed_mps"]),
            (self.crash_time_s, columns["crash_time_s"]),
            (self.response_time_s, columns["crash_time_s"] - STEP_S * columns["cut_in_step"]),
        ):
            histogram.add(weight[crash], values[crash])
        for ranking in (self.hardest, self.heaviest, self.outermost):
            ranking.add(columns, crash)


def summarise(run: RunFolder) -> RunSummary:
    """Stream over all episodes of a run, in index order; a `RunFolderError` where one has an unknown outcome."""
    summary = RunSummary(_log_scales(run) if run.campaign.testing.method == "shells" else None)
    for batch in run.episodes(*NUMBERS, "outcome", "failure"):
        summary.add(batch, _outcome_index(batch.column("outcome"), run))
    return summary


def _log_scales(run: RunFolder) -> FloatArray:
    """Logarithm of 1/n_s per shell, shape (S,): it turns recorded weights p_s into ones that add up to probabilities.

    A record carries log p_s, because it is written before anybody knows how many tests its shell will get. Weights
    p_s/n_s add up to Σ p_s c_s; weights p_s would count a shell as often as it was tested. A shell without tests has
    scale 0, and no test to use it.
    """
    tests: Counter[int] = Counter()
    for batch in run.episodes("component"):
        for item in batch.column("component").value_counts():
            tests[item["values"].as_py()] += item["counts"].as_py()
    if min(tests, default=0) < 0:
        raise RunFolderError(
            str(run.path / "episodes"),
            found="a test without shell (component -1)",
            expected="the shell that each test was drawn from",
            mend="The records are not those of a run with testing.method shells: run the campaign again.",
        )
    return -np.log([float(max(tests[shell], 1)) for shell in range(max(tests, default=-1) + 1)])


def _outcome_index(column: pa.Array, run: RunFolder) -> IntArray:
    index = pc.index_in(column.cast(pa.string()), pa.array(OUTCOMES), skip_nulls=True)
    if index.null_count:
        unknown = column.filter(pc.is_null(index))[0].as_py()
        raise RunFolderError(
            str(run.path / "episodes"),
            found="an episode without outcome" if unknown is None else f"the outcome {unknown!r}",
            expected=f"one of {', '.join(OUTCOMES)}",
            mend="The records are from another version of the harness: use that version, or run again.",
        )
    return np.asarray(index).astype(np.int64)


class LateralFacts(NamedTuple):
    """Of the tests as sampled: 5 %, 50 % and 95 % quantiles of the leads (s) of cut-ins, and crashes by contact."""

    n_cut_ins: int
    lead_s: list[float]
    n_crashes: int
    n_side: int


def lateral_facts(run: RunFolder) -> LateralFacts | None:
    """How cut-ins showed themselves before BV overlapped; None where they are one step."""
    if "lead_steps" not in stored_columns(run.path):
        return None
    leads, contacts = [np.zeros(0)], Counter[str]()
    for batch in run.episodes("lead_steps", "cut_in_step", "contact"):
        leads.append(floats(batch.filter(pc.is_valid(batch.column("cut_in_step"))).column("lead_steps")))
        contacts.update(batch.column("contact").drop_null().to_pylist())
    lead_s = STEP_S * np.concatenate(leads)
    quantiles = np.quantile(lead_s, (0.05, 0.5, 0.95)).tolist() if lead_s.size else [math.nan] * 3
    return LateralFacts(lead_s.size, quantiles, contacts.total(), contacts["side"])
