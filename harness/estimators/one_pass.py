"""All estimators from one pass over the blocks of a campaign; which there are, and which answers for which method."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from harness.estimators.block import Block
from harness.estimators.diagnostics import Diagnostics
from harness.estimators.estimate import Accumulator, BothWays, Estimate, Unavailable, require_episodes
from harness.estimators.mixture_cv import MixtureCv
from harness.estimators.nade import Nade, Nde
from harness.estimators.scv import Scv
from harness.estimators.shells import Shells
from harness.methods import ESTIMATORS, SAMPLING, EstimatorName

ACCUMULATORS: dict[EstimatorName, type[Accumulator]] = {
    "nde": Nde,
    "nade": Nade,
    "mixture_cv": MixtureCv,
    "scv": Scv,
    "shells": Shells,
}
SPACING = 1.01
"""Prefixes closer than 1 % are one dot on a logarithmic axis; thinning them keeps long campaigns' files small."""


def accumulator(name: EstimatorName) -> BothWays:
    """Empty state of an estimator, for those who feed it themselves (the runner does, for stopping)."""
    return BothWays(ACCUMULATORS[name]())


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
    states: dict[EstimatorName, BothWays] = {}
    refusals: dict[EstimatorName, str | None] = {}
    diagnostics, convergence, n = Diagnostics(), list[dict[str, Any]](), 0
    for block in blocks:
        if block.first_episode != n:
            raise ValueError(f"expected a block from episode {n} on, got one from {block.first_episode}")
        if own is None:
            own = SAMPLING[block.method].headline
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
