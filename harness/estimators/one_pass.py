"""All estimators from one pass over the blocks of a campaign, and what they make of ``estimates.json``."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from harness.estimators import statement as say
from harness.estimators.block import Block
from harness.estimators.diagnostics import Diagnostics
from harness.estimators.estimate import Accumulator, Estimate, FailureBounds, Unavailable, finite_json, require_episodes
from harness.estimators.scv import MixtureCv, Scv
from harness.estimators.shells import Shells
from harness.estimators.weighted import Nade, Nde
from harness.vocabulary import ESTIMATORS, SAMPLING, EstimatorName

ACCUMULATORS: dict[EstimatorName, type[Accumulator]] = {
    "nde": Nde,
    "nade": Nade,
    "mixture_cv": MixtureCv,
    "scv": Scv,
    "shells": Shells,
}
SPACING = 1.01
"""Prefixes closer than 1 % are one dot on a logarithmic axis; thinning them keeps long campaigns' files small."""


def accumulator(name: EstimatorName) -> FailureBounds:
    """Empty state of an estimator, for those who feed it themselves (the runner does, for stopping)."""
    return FailureBounds(ACCUMULATORS[name]())


@dataclass(frozen=True)
class PassResult:
    """What one pass over a campaign's blocks gives.

    Attributes
    ----------
    estimates : dict
        Per asked estimator an `Estimate`, or `Unavailable` with the reason.
    headline, headline_estimate : str, Estimate
        The method's own estimator, asked for or not.
    convergence : list of dict
        The headline estimate on growing prefixes, for plots: block boundaries at least 1 % apart.
    """

    estimates: dict[EstimatorName, Estimate | Unavailable]
    headline: EstimatorName
    headline_estimate: Estimate
    diagnostics: Diagnostics
    convergence: list[dict[str, Any]]


def one_pass(
    blocks: Iterable[Block], names: Collection[EstimatorName] = ESTIMATORS, *, confidence: float = 0.9
) -> PassResult:
    """Feed every block to every estimator that can use it.

    Parameters
    ----------
    blocks : iterable of Block
        Contiguous and in index order, from episode 0.
    names : collection of str
        Estimators asked for.
    confidence : float
        Level of all intervals.

    Raises
    ------
    ValueError
        If there is no episode, or a block does not follow the one before.
    """
    own: EstimatorName | None = None
    states: dict[EstimatorName, FailureBounds] = {}
    refusals: dict[EstimatorName, str | None] = {}
    diagnostics, convergence, n = Diagnostics(), list[dict[str, Any]](), 0
    for block in blocks:
        if block.first_episode != n:
            raise ValueError(f"expected a block from episode {n} on, got one from {block.first_episode}")
        if own is None:
            own = SAMPLING[block.drawn.method].headline
            refusals = {name: ACCUMULATORS[name].refusal(block) for name in (own, *names)}
            states = {name: accumulator(name) for name, reason in refusals.items() if reason is None}
        n += len(block)
        diagnostics.add(block)
        for state in states.values():
            state.add(block)
        if not convergence or n >= convergence[-1]["n"] * SPACING:
            convergence.append(_point(states[own].result(confidence)))
    require_episodes(n)
    assert own is not None
    results = {name: state.result(confidence) for name, state in states.items()}
    if convergence[-1]["n"] != n:
        convergence.append(_point(results[own]))
    estimates = {name: results.get(name) or Unavailable(str(refusals[name])) for name in names}
    return PassResult(estimates, own, results[own], diagnostics, convergence)


def _point(estimate: Estimate) -> dict[str, Any]:
    return {
        "n": estimate.n_episodes,
        "crash_rate": estimate.crash_rate,
        "ci_low": estimate.ci_low,
        "ci_high": estimate.ci_high,
        "rhw": estimate.precision,
        "n_crashes": estimate.n_crashes,
    }


@dataclass(frozen=True)
class CampaignFacts:
    """What estimates must say about the campaign that they belong to.

    Attributes
    ----------
    distance_per_test_m : float or None
        Mean distance that the AV drives in a naturalistic test; None if unknown, and then nothing is said per km.
    importance_names : tuple of str
        Names of the importance functions, in order.
    retraced : dict
        What the run says about the twin retracing its episodes.
    repeated : dict
        What the run says about tests that it ran twice.
    ending : str or None
        When the run ended and which condition decided, in a sentence; None while it goes on.
    decision : dict or None
        What the run has found about the limit that it was asked about; `harness.estimators.stopping.Decision`.
    """

    name: str
    content_hash: str
    lane_change_level: float
    confidence: float = 0.9
    distance_per_test_m: float | None = None
    importance_names: tuple[str, ...] = ()
    retraced: dict[str, Any] | None = None
    repeated: dict[str, Any] | None = None
    ending: str | None = None
    decision: dict[str, Any] | None = None


def estimate_blocks(
    blocks: Iterable[Block], facts: CampaignFacts, *, estimators: Collection[EstimatorName] | None = None
) -> dict[str, Any]:
    """Estimates of blocks that cover a campaign's episodes, as JSON content.

    Parameters
    ----------
    blocks : iterable of Block
        Contiguous and in index order.
    facts : CampaignFacts
    estimators : collection of str, optional
        Which to report beside the method's own; all by default.
    """
    done = one_pass(blocks, estimators or ESTIMATORS, confidence=facts.confidence)
    best = done.headline_estimate
    estimates = {done.headline: best, **done.estimates}
    distance_km = None if facts.distance_per_test_m is None else facts.distance_per_test_m / 1000.0
    retraced = facts.retraced or {"reason": "the run did not retrace its episodes"}
    statements = {name: _said(found, facts, distance_km) for name, found in estimates.items()}
    return finite_json(
        {
            "campaign": facts.name,
            "campaign_hash": facts.content_hash,
            "lane_change_level": facts.lane_change_level,
            "confidence": facts.confidence,
            "n_episodes": best.n_episodes,
            "n_crashes": best.n_crashes,
            "headline": done.headline,
            "distance_per_test_km": distance_km,
            "crash_rate_per_1e6_km": None if distance_km is None else say.per_distance(best, distance_km),
            "estimates": {name: estimate.to_json() for name, estimate in estimates.items()},
            "diagnostics": {**done.diagnostics.result(facts.importance_names), "alarm": {"retraced": retraced}},
            "convergence": done.convergence,
            "statement": statements[done.headline],
            "statements": statements,
            "reference_statements": say.reference_statements(best),
            "boundary_statements": say.boundary_statements(best),
            "scope": say.SCOPE,
            "ending": facts.ending,
            "decision": facts.decision,
        }
    )


def _said(found: Estimate | Unavailable, facts: CampaignFacts, distance_km: float | None) -> str:
    """What an estimator says, led by what it must be warned of and the first reference driver; or why it cannot."""
    if isinstance(found, Unavailable):
        return f"No crash rate from these records: {found.reason.rstrip('.')}."
    answer = say.statement(found, facts.lane_change_level, distance_km)
    text = say.warned(say.repeated_cautions(facts.repeated), " ".join([*say.reference_statements(found)[:1], answer]))
    return text + say.failed_statement(found.details) + say.repeated_statement(facts.repeated)
