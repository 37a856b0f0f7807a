"""One pass over all episodes: everything that the plots and tables need, in memory that does not grow with n."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from harness.errors import RunFolderError
from harness.records.schemas import CRASH, FAILED, OUTCOMES
from harness.report.cut_in_grid import CutInGrid
from harness.report.fine_histogram import FineHistogram, Floats
from harness.report.run_folder import RunFolder
from harness.report.shard_tables import episode_batches
from harness.report.shell_weights import log_scales
from harness.report.worst_crashes import WorstCrashes
from harness.vehicles.kinematics import STEP_S

NUMBERS = (
    "episode",
    "log_weight",
    "n_control_steps",
    "component",
    "v_bv_mps",
    "cut_in_step",
    "cut_in_r2_m",
    "cut_in_r2dot_mps",
    "crash_time_s",
    "impact_speed_mps",
)
COLUMNS = (*NUMBERS, "outcome", "failure")
MOST_CAUSES = 1_000


def _weights() -> FineHistogram:
    return FineHistogram(-80.0, 20.0, 0.02)


def _seconds() -> FineHistogram:
    return FineHistogram(0.0, 60.0, 0.1)


def _strata() -> FineHistogram:
    return FineHistogram(-0.5, 600.5, 1.0)


@dataclass
class RunSummary:
    """Counts, weight sums and histograms of a run.

    Weighted sums use the likelihood ratio of each episode: divided by the number of tests they say how often something
    happens in naturalistic driving. Tests from shells weigh p_s/n_s instead, and their sums need no division:
    `per_test` knows. Failed episodes are counted but have no weight.

    Attributes
    ----------
    log_scales : ndarray, shape (S,), optional
        For tests that were drawn from shells: added to the recorded log-weight of each, see `shell_weights`.
    count, weight : ndarray, shape (5,)
        Episodes and sum of weights per outcome, in the order of ``OUTCOMES``.
    causes : Counter of str
        Failed episodes per cause.
    log10_weight, log10_weight_crash : FineHistogram
        Of log10 of the weight, all episodes and crashes.
    stratum_crash, impact_speed_mps, crash_time_s, response_time_s : FineHistogram
        Of crashes: number of control steps, impact speed, time of the crash, time from cut-in to crash.
    cut_in, cut_in_crash : CutInGrid
        All cut-ins, and those that ended in a crash.
    hardest, heaviest, outermost : WorstCrashes
        By impact speed, by weight, and (of tests from shells) from the most careless shell inwards.
    """

    log_scales: Floats | None = None
    count: Floats = field(default_factory=lambda: np.zeros(len(OUTCOMES)))
    weight: Floats = field(default_factory=lambda: np.zeros(len(OUTCOMES)))
    causes: Counter[str] = field(default_factory=Counter)
    weights_seen: tuple[float, float] = (math.inf, -math.inf)
    log10_weight: FineHistogram = field(default_factory=_weights)
    log10_weight_crash: FineHistogram = field(default_factory=_weights)
    stratum_crash: FineHistogram = field(default_factory=_strata)
    impact_speed_mps: FineHistogram = field(default_factory=lambda: FineHistogram(0.0, 80.0, 0.1))
    crash_time_s: FineHistogram = field(default_factory=_seconds)
    response_time_s: FineHistogram = field(default_factory=_seconds)
    cut_in: CutInGrid = field(default_factory=CutInGrid)
    cut_in_crash: CutInGrid = field(default_factory=CutInGrid)
    hardest: WorstCrashes = field(default_factory=lambda: WorstCrashes("impact_speed_mps"))
    heaviest: WorstCrashes = field(default_factory=lambda: WorstCrashes("log_weight"))
    outermost: WorstCrashes = field(default_factory=lambda: WorstCrashes("component"))

    @property
    def n_episodes(self) -> int:
        """Number of tests, failed ones included."""
        return int(self.count.sum())

    @property
    def n_crashes(self) -> int:
        """Number of sampled crashes."""
        return int(self.count[CRASH])

    @property
    def all_weights_one(self) -> bool:
        """Whether no maneuver was drawn from an importance function: plain naturalistic driving."""
        return self.weights_seen == (0.0, 0.0)

    @property
    def from_shells(self) -> bool:
        """Whether tests were drawn from shells."""
        return self.log_scales is not None

    def per_test(self, weight: float) -> float:
        """How often per naturalistic test something happens whose weights add up to ``weight``."""
        return weight if self.from_shells else weight / max(self.n_episodes, 1)

    def add(self, batch: pa.RecordBatch, outcome: npt.NDArray[np.int64]) -> None:
        """Add a batch whose outcomes are given as indices into ``OUTCOMES``."""
        columns = {name: _floats(batch.column(name)) for name in NUMBERS}
        if self.log_scales is not None:
            columns["log_weight"] = columns["log_weight"] + self.log_scales[columns["component"].astype(np.int64)]
        valid, crash = outcome != FAILED, outcome == CRASH
        log_weight = columns["log_weight"]
        weight = np.where(valid, np.exp(log_weight), 0.0)
        self.count += np.bincount(outcome, minlength=len(OUTCOMES))
        self.weight += np.bincount(outcome, weights=weight, minlength=len(OUTCOMES))
        self._add_causes(batch.column("failure"))
        self._add_weights(log_weight, weight, valid, crash)
        self._add_cut_ins(columns, weight, valid, crash)
        self._add_crashes(columns, weight, crash)

    def _add_causes(self, failure: pa.Array) -> None:
        if failure.null_count == len(failure):
            return
        for item in failure.drop_null().value_counts():
            cause = item["values"].as_py()
            # Causes may hold numbers and so be all different: memory stays bounded, the count per outcome is exact.
            if cause in self.causes or len(self.causes) < MOST_CAUSES:
                self.causes[cause] += item["counts"].as_py()

    def _add_weights(
        self, log_weight: Floats, weight: Floats, valid: npt.NDArray[np.bool_], crash: npt.NDArray[np.bool_]
    ) -> None:
        if valid.any():
            low, high = self.weights_seen
            seen = log_weight[valid]
            self.weights_seen = (min(low, float(seen.min())), max(high, float(seen.max())))
        log10 = log_weight / math.log(10.0)
        self.log10_weight.add(log10[valid], weight[valid])
        self.log10_weight_crash.add(log10[crash], weight[crash])

    def _add_cut_ins(
        self, columns: dict[str, Floats], weight: Floats, valid: npt.NDArray[np.bool_], crash: npt.NDArray[np.bool_]
    ) -> None:
        for grid, rows in ((self.cut_in, valid), (self.cut_in_crash, crash)):
            grid.add(columns["cut_in_r2_m"][rows], columns["cut_in_r2dot_mps"][rows], weight[rows])

    def _add_crashes(self, columns: dict[str, Floats], weight: Floats, crash: npt.NDArray[np.bool_]) -> None:
        response_time_s = columns["crash_time_s"] - STEP_S * columns["cut_in_step"]
        for histogram, values in (
            (self.stratum_crash, columns["n_control_steps"]),
            (self.impact_speed_mps, columns["impact_speed_mps"]),
            (self.crash_time_s, columns["crash_time_s"]),
            (self.response_time_s, response_time_s),
        ):
            histogram.add(values[crash], weight[crash])
        self.hardest.add(columns, crash)
        self.heaviest.add(columns, crash)
        if self.from_shells:
            self.outermost.add(columns, crash)


def summarise(run: RunFolder) -> RunSummary:
    """Stream over all episodes of a run, in index order.

    Raises
    ------
    RunFolderError
        If a shard is damaged or holds an unknown outcome.
    """
    summary = RunSummary(log_scales(run) if run.method == "shells" else None)
    for batch in episode_batches(run, COLUMNS):
        summary.add(batch, _outcome_index(batch.column("outcome"), run))
    return summary


def _floats(column: pa.Array) -> Floats:
    return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)


def _outcome_index(column: pa.Array, run: RunFolder) -> npt.NDArray[np.int64]:
    encoded = column if isinstance(column, pa.DictionaryArray) else column.dictionary_encode()
    names = encoded.dictionary.to_pylist()
    unknown = sorted({str(name) for name in names} - set(OUTCOMES))
    if unknown or encoded.null_count:
        raise RunFolderError(
            str(run.path / "episodes"),
            found=f"the outcome {unknown[0]!r}" if unknown else "an episode without outcome",
            expected=f"one of {', '.join(OUTCOMES)}",
            mend="The records are from another version of the harness: use that version, or run again.",
        )
    index_of = np.array([OUTCOMES.index(name) for name in names], dtype=np.int64)
    return np.asarray(index_of[encoded.indices.to_numpy(zero_copy_only=False)])
