"""All estimators from one pass over the blocks of a campaign."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from harness.estimators.accumulator import Accumulator
from harness.estimators.block import Block
from harness.estimators.both_ways import BothWays
from harness.estimators.convergence import Convergence
from harness.estimators.diagnostics import Diagnostics
from harness.estimators.estimate import Estimate, Unavailable
from harness.estimators.mixture_cv import MixtureCv
from harness.estimators.nade import Nade
from harness.estimators.nde import Nde
from harness.estimators.scv import Scv
from harness.estimators.shells import Shells
from harness.methods import ESTIMATORS, SAMPLING, EstimatorName

_CLASSES: dict[EstimatorName, type[Accumulator]] = {
    "nde": Nde,
    "nade": Nade,
    "mixture_cv": MixtureCv,
    "scv": Scv,
    "shells": Shells,
}


@dataclass(frozen=True)
class PassResult:
    """What one pass over a campaign's blocks gives.

    Attributes
    ----------
    estimates : dict
        Per asked estimator an `Estimate`, or `Unavailable` with the reason.
    headline : str
        Name of the method's own estimator.
    headline_estimate : Estimate
        Its estimate, asked for or not.
    diagnostics : Diagnostics
        Sums of weights and ratios.
    convergence : list of dict
        The headline estimate on growing prefixes.
    """

    estimates: dict[EstimatorName, Estimate | Unavailable]
    headline: EstimatorName
    headline_estimate: Estimate
    diagnostics: Diagnostics
    convergence: list[dict[str, Any]]


def accumulator(name: EstimatorName) -> BothWays:
    """Empty state of an estimator, for those who feed it themselves (the runner does, for stopping)."""
    return BothWays(_CLASSES[name]())


def one_pass(
    blocks: Iterable[Block],
    names: Sequence[EstimatorName] = ESTIMATORS,
    *,
    confidence: float = 0.9,
    make: Callable[[EstimatorName], Accumulator] = lambda name: _CLASSES[name](),
) -> PassResult:
    """Feed every block to every estimator that can use it.

    Parameters
    ----------
    blocks : iterable of Block
        Contiguous and in index order, from episode 0.
    names : sequence of str
        Estimators asked for.
    confidence : float
        Level of all intervals.
    make : callable
        Gives an empty accumulator by name; the place to ask for another basis of `scv`.

    Raises
    ------
    ValueError
        If there is no episode, or a block does not follow the one before.
    """
    states: dict[EstimatorName, BothWays] = {}
    refusals: dict[EstimatorName, str] = {}
    diagnostics, convergence, own = Diagnostics(), Convergence(), None
    n = 0
    for block in blocks:
        if block.first_episode != n:
            raise ValueError(f"expected a block from episode {n} on, got one from {block.first_episode}")
        if own is None:
            own = SAMPLING[block.method].headline
            states, refusals = _choose([*dict.fromkeys([own, *names])], block, make)
        n += len(block)
        diagnostics.add(block)
        for state in states.values():
            state.add(block)
        if convergence.due(n):
            convergence.add(states[own].result(confidence))
    if own is None or n == 0:
        raise ValueError("an estimate needs at least one episode")
    results: dict[EstimatorName, Estimate] = {name: state.result(confidence) for name, state in states.items()}
    convergence.add(results[own])
    estimates = {name: results[name] if name in results else Unavailable(refusals[name]) for name in names}
    return PassResult(estimates, own, results[own], diagnostics, convergence.points())


def _choose(
    names: Sequence[EstimatorName], block: Block, make: Callable[[EstimatorName], Accumulator]
) -> tuple[dict[EstimatorName, BothWays], dict[EstimatorName, str]]:
    """Split into estimators that the records allow and reasons for those that they do not."""
    states: dict[EstimatorName, BothWays] = {}
    refusals: dict[EstimatorName, str] = {}
    for name in names:
        reason = _CLASSES[name].refusal(block)
        if reason is None:
            states[name] = BothWays(make(name))
        else:
            refusals[name] = reason
    return states, refusals
