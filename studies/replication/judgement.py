"""What replications say about a method: bias, true and claimed variance, coverage, tests needed.

A coverage is judged by the binomial test against its nominal value, one-sided, with Holm's correction (S. Holm, A
simple sequentially rejective multiple test procedure, Scand. J. Statist. 6, 1979, 65) over all vehicles or chains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from harness.estimators.estimate import Estimate
from harness.estimators.likelihood import Level
from harness.estimators.limits import clopper_pearson
from harness.vocabulary import FloatArray
from studies.replication.populations import Known

COVERAGE_CONFIDENCE = 0.95
SIGNIFICANCE = 0.05
NEGLIGIBLE_OUTSIDE = 1e-3
"""Largest share of a vehicle's crashes beyond the boundary with which it still meets the assumption of a statement."""
WANTED_RHW = 0.3
FORMER = ", by the former rule"
"""Ends the name of a result that is a sibling, to fail: what the rule of that name took the place of."""


@dataclass(frozen=True)
class Row:
    """What one replication of a campaign reported, and nothing that only the experimenter knows.

    The result is an estimator, a statement of shells, a comparison with a reference driver, or the difference of two
    vehicles; ``crash_rate`` is a rate, or the ratio, share or difference that it names; NaN if there is none. An
    interval is refused, and as wide as can be, where crashes lie on too few paths.
    """

    result: str
    replication: int
    n_tests: int
    n_crashes: int
    crash_rate: float
    std_error: float
    ci_low: float
    ci_high: float
    reached: bool
    n_crashes_outside: int = 0
    refused: bool = False


def estimate_row(result: str, replication: int, found: Estimate, *, reached: bool, outside: int = 0) -> Row:
    """Row of an estimate with one interval."""
    numbers = found.crash_rate, found.std_error, found.ci_low, found.ci_high
    counts = found.n_episodes, found.n_crashes
    return Row(result, replication, *counts, *numbers, reached, outside, refused=bool(found.cautions))


@dataclass(frozen=True, eq=False)
class Subject:
    """What the experimenter knows about a vehicle or a chain.

    Its crash rate is the truth for all results but ``others``. ``crashes_outside`` is, for each result that assumes a
    boundary, the share of its crash rate beyond it.
    """

    name: str
    crash_rate: Known
    others: dict[str, Known] = field(default_factory=dict)
    crashes_outside: dict[str, float] = field(default_factory=dict)

    def truth(self, result: str) -> Known:
        """What a result estimates."""
        return self.others.get(result.removesuffix(FORMER), self.crash_rate)

    def meets_assumption_of(self, result: str) -> bool:
        """Whether what a result assumes holds for it."""
        return self.crashes_outside.get(result.removesuffix(FORMER), 0.0) < NEGLIGIBLE_OUTSIDE


Judgement = dict[str, Any]
"""What `judge` finds, by the names of its keys."""


def judge(subject: Subject, result: str, rows: Sequence[Row], confidence: float) -> Judgement:
    """Judge one method on one vehicle by its rows; `corrected` then adds the corrected p-values.

    ``confidence`` is the nominal coverage. Bias and relative variances are over the ``scale`` of the truth (`Known`).
    The assumption is not met by a statement about vehicles that do not crash outside, and one that does; coverage is
    not judged then, and has no p-values. Tests for the wanted RHW, 0.3, follow from the true variance at this number of
    tests, if it was fixed. ``reached`` is the share of replications that reached the precision asked for. Those refused
    count as covered; where they have no value either, nothing else takes notice of them.
    """
    table, known, n = pd.DataFrame(rows), subject.truth(result), len(rows)
    truth, scale, known_rows = known.value, known.scale, table[np.isfinite(table.crash_rate)]
    with np.errstate(divide="ignore", invalid="ignore"):  # of what never crashes nothing relative is known
        errors = (known_rows.crash_rate.to_numpy() - truth) / scale
        claimed = known_rows.std_error.to_numpy() / scale
    covered = int(((table.ci_low <= truth) & (truth <= table.ci_high)).sum())
    low, high = map(float, clopper_pearson(covered, n, (1.0 - COVERAGE_CONFIDENCE) / 2.0))
    tests_5, median, tests_95 = table.n_tests.quantile([0.05, 0.5, 0.95]).tolist()
    fixed, relvar = not table.reached.any() and table.n_tests.nunique() == 1, _mean(errors**2)
    met, z = subject.meets_assumption_of(result), Level.two_sided(confidence).z
    return {
        "subject": subject.name,
        "result": result,
        "replications": n,
        "truth": truth,
        "scale": scale,
        "assumption_met": met,
        "bias": _mean(errors),
        "bias_std_error": float(errors.std(ddof=1)) / math.sqrt(errors.size) if errors.size > 1 else math.nan,
        "true_relvar": relvar,
        "claimed_relvar": _mean(claimed**2),
        "covered": covered,
        "coverage": covered / n,
        "coverage_low": low,
        "coverage_high": high,
        "p_value": float(binomtest(covered, n, confidence, alternative="less").pvalue) if met else None,
        "tests_median": median,
        "tests_5": tests_5,
        "tests_95": tests_95,
        "tests_for_wanted_rhw": (z / WANTED_RHW) ** 2 * (relvar * median) if fixed else None,
        "reached": float(table.reached.mean()),
        "alarm": float((table.n_crashes_outside > 0).mean()),
        "refused": float(table.refused.mean()),
        "low_median": float(table.ci_low.median()),
        "high_median": float(table.ci_high.median()),
    }


def _mean(values: FloatArray) -> float:
    """Mean of some numbers, NaN of none."""
    return float(values.mean()) if values.size else math.nan


def corrected(judgements: Sequence[Judgement]) -> list[Judgement]:
    """The same with p-values corrected over all subjects, for each result by itself, and what they say at 5 %."""
    found = [{**one, "p_value_holm": None, "coverage_too_low": False} for one in judgements]
    for result in {one["result"] for one in judgements}:
        judged = [one for one in found if one["result"] == result and one["p_value"] is not None]
        for one, p in zip(judged, holm([one["p_value"] for one in judged]), strict=True):
            one |= {"p_value_holm": p, "coverage_too_low": p < SIGNIFICANCE}
    return found


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's corrected p-values, in the order given."""
    order = np.argsort(p_values, kind="stable")
    raised = np.minimum(1.0, np.arange(len(order), 0, -1) * np.array(p_values)[order])
    adjusted: list[float] = np.maximum.accumulate(raised)[np.argsort(order)].tolist()
    return adjusted
