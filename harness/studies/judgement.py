"""What replications say about a method: bias, true and claimed variance, coverage, tests needed.

A coverage is judged by the binomial test against its nominal value, one-sided, with Holm's correction (S. Holm, A
simple sequentially rejective multiple test procedure, Scand. J. Statist. 6, 1979, 65) over all vehicles or chains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest, norm

from harness.arrays import FloatArray
from harness.estimators.estimate import finite_json
from harness.estimators.intervals import clopper_pearson
from harness.studies.rows import Rows

COVERAGE_CONFIDENCE = 0.95
SIGNIFICANCE = 0.05
NEGLIGIBLE_OUTSIDE = 1e-3
"""Largest share of a vehicle's crashes beyond the boundary with which it still meets the conditional assumption."""
WANTED_RHW = 0.3


@dataclass(frozen=True)
class Subject:
    """What the experimenter knows about a vehicle or a chain.

    Attributes
    ----------
    name : str
    crash_rate, std_error : float
        The truth, and how well it is known.
    crashes_outside : float
        Share of its crash rate beyond the boundary; 0 where there is none.
    left_out : tuple of str
        Surrogates that are its equals.
    boundary : str or None
        Surrogate up to which strata are inside.
    """

    name: str
    crash_rate: float
    std_error: float = 0.0
    crashes_outside: float = 0.0
    left_out: tuple[str, ...] = ()
    boundary: str | None = None

    @property
    def meets_assumption(self) -> bool:
        """Whether the conditional statement holds for it."""
        return self.crashes_outside < NEGLIGIBLE_OUTSIDE


@dataclass(frozen=True)
class Judgement:
    """One method on one vehicle.

    Attributes
    ----------
    subject, result : str
    replications : int
    truth : float
    assumption_met : bool
        False only for the conditional statement of a vehicle that crashes outside; its coverage is then not judged.
    bias, bias_std_error : float
        Of the mean estimate, relative to the truth.
    true_relvar, claimed_relvar : float
        Variance over the squared truth: of the estimates around the truth, and the mean that they claim.
    covered : int
    coverage, coverage_low, coverage_high : float
        Share of intervals that hold the truth, with its own exact 95 % interval.
    p_value, p_value_holm : float or None
        That the coverage is no lower than nominal; corrected; None where it is not judged.
    tests_median, tests_5, tests_95 : float
    tests_for_wanted_rhw : float or None
        Tests for RHW 0.3 by the true variance at this number of tests; None if the number was not fixed.
    reached : float
        Share of replications that reached the precision asked for.
    alarm : float
        Share of replications in which a crash was seen outside.
    """

    subject: str
    result: str
    replications: int
    truth: float
    assumption_met: bool
    bias: float
    bias_std_error: float
    true_relvar: float
    claimed_relvar: float
    covered: int
    coverage: float
    coverage_low: float
    coverage_high: float
    p_value: float | None
    p_value_holm: float | None
    tests_median: float
    tests_5: float
    tests_95: float
    tests_for_wanted_rhw: float | None
    reached: float
    alarm: float

    @property
    def too_low(self) -> bool:
        """Whether the coverage is significantly below nominal."""
        return self.p_value_holm is not None and self.p_value_holm < SIGNIFICANCE

    def to_json(self) -> dict[str, Any]:
        """Plain content."""
        content: dict[str, Any] = finite_json({**asdict(self), "coverage_too_low": self.too_low})
        return content


def judge(subject: Subject, result: str, rows: Rows, confidence: float, *, conditional: bool = False) -> Judgement:
    """Judge one method on one vehicle; `corrected` then fills in the corrected p-values.

    Parameters
    ----------
    subject : Subject
    result : str
        Name of the estimator or statement.
    rows : Rows
    confidence : float
        Nominal coverage.
    conditional : bool
        Whether the statement holds only for vehicles that meet the assumption.
    """
    truth, n = subject.crash_rate, rows.crash_rate.size
    covered = int(np.count_nonzero((rows.ci_low <= truth) & (truth <= rows.ci_high)))
    low, high = map(float, clopper_pearson(covered, n, (1.0 - COVERAGE_CONFIDENCE) / 2.0))
    met = subject.meets_assumption or not conditional
    tests_5, median, tests_95 = (float(q) for q in np.quantile(rows.n_tests, [0.05, 0.5, 0.95]))
    relvar = float(np.mean((rows.crash_rate / truth - 1.0) ** 2))
    fixed = not rows.reached.any() and bool(np.all(rows.n_tests == rows.n_tests[0]))
    return Judgement(
        subject=subject.name,
        result=result,
        replications=n,
        truth=truth,
        assumption_met=met,
        bias=float(rows.crash_rate.mean()) / truth - 1.0,
        bias_std_error=_std_error(rows.crash_rate) / truth,
        true_relvar=relvar,
        claimed_relvar=float(np.mean(rows.std_error**2)) / truth**2,
        covered=covered,
        coverage=covered / n,
        coverage_low=low,
        coverage_high=high,
        p_value=float(binomtest(covered, n, confidence, alternative="less").pvalue) if met else None,
        p_value_holm=None,
        tests_median=median,
        tests_5=tests_5,
        tests_95=tests_95,
        tests_for_wanted_rhw=_tests_for(WANTED_RHW, relvar * median, confidence) if fixed else None,
        reached=float(rows.reached.mean()),
        alarm=float(np.mean(rows.n_crashes_outside > 0)),
    )


def _std_error(values: FloatArray) -> float:
    return float(values.std(ddof=1)) / math.sqrt(values.size)


def _tests_for(rhw: float, relvar_per_test: float, confidence: float) -> float:
    z = float(norm.isf((1.0 - confidence) / 2.0))
    return (z / rhw) ** 2 * relvar_per_test


def corrected(judgements: Sequence[Judgement]) -> list[Judgement]:
    """The same with p-values corrected over all subjects, for each result by itself."""
    found = {}
    for result in dict.fromkeys(one.result for one in judgements):
        family = [one for one in judgements if one.result == result and one.p_value is not None]
        for one, p in zip(family, holm([one.p_value or 0.0 for one in family]), strict=True):
            found[one.subject, result] = p
    return [Judgement(**{**asdict(one), "p_value_holm": found.get((one.subject, one.result))}) for one in judgements]


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's corrected p-values, in the order given."""
    order = np.argsort(p_values, kind="stable")
    adjusted = np.zeros(len(p_values))
    largest = 0.0
    for rank, place in enumerate(order.tolist()):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[place]))
        adjusted[place] = largest
    return [float(p) for p in adjusted]
