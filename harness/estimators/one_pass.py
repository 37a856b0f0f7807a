"""All estimators from one pass over the blocks of a campaign, with what the records say about the sampling itself.

One of a user's own, ``my.py:Class``, an entry point of the group ``harness.estimators``, or an object, is a class that
names the ``methods`` whose tests it can use, is fed blocks of them (``add``), and says (``result``, at a confidence) a
rate and its standard error, or a whole `Estimate`. ``block.drawn`` is what a block is drawn by.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points
from itertools import chain
from typing import Any, TypeAlias

from harness.campaign.campaign import Campaign
from harness.campaign.sections import LEAST_TESTS
from harness.controllers.find import own_code
from harness.controllers.hosts import cause_of
from harness.errors import CampaignError, HarnessError
from harness.estimators.block import Block, SamplingPlan, joined
from harness.estimators.doubly_robust import DoublyRobust
from harness.estimators.estimate import Accumulator, Estimate, FailureBounds, Note, Point, Unavailable, note
from harness.estimators.scv import MixtureCv, Scv
from harness.estimators.severity import Impacts, Severity
from harness.estimators.shells import SeenShells
from harness.estimators.weighted import Moments, Nade, Nde
from harness.problems import did_you_mean, listed
from harness.vocabulary import CONTACT, ESTIMATORS, METHODS, SAMPLING, EstimatorName, Method

ACCUMULATORS: dict[EstimatorName, Callable[[], Accumulator]] = {
    "nde": Nde,
    "nade": Nade,
    "mixture_cv": MixtureCv,
    "dr": DoublyRobust,
    "scv": Scv,
    "shells": SeenShells,
}
SPACING = 1.01
"""Prefixes closer than 1 % are one dot on a logarithmic axis; thinning them keeps long campaigns' files small."""
FEWEST_TOGETHER, MOST_TOGETHER = 64, 5_000
"""Tests of a block: as many as `one_pass` waits for until it looks again, within these."""
UNKNOWN_MEAN = {"mean": math.nan, "std_error": math.inf}


@dataclass(frozen=True)
class OwnEstimator:
    """What ``make`` makes, once for each pass over the tests; ``name`` is its key in ``estimates.json``."""

    name: str
    make: Callable[[], Any]
    methods: tuple[str, ...]

    def __str__(self) -> str:
        return self.name


AnyEstimator: TypeAlias = EstimatorName | OwnEstimator


class OwnState(Nade):
    """An estimator of one's own, beside the moments of weighted crashes that say whether a mean can be trusted."""

    def __init__(self, estimator: OwnEstimator) -> None:
        super().__init__()
        self._name = estimator.name
        self._own = self._call(deepcopy, self._call(estimator.make))  # as it will be once a test has failed

    def add(self, block: Block) -> None:
        super().add(block)
        self._call(self._own.add, deepcopy(block))  # the others' arrays are not its own to write to

    def result(self, confidence: float) -> Estimate:
        """Its own estimate, or one with a normal interval, our cautions and our upper bound."""
        found = self._call(self._own.result, confidence)
        is_whole, rate, spread = isinstance(found, Estimate), math.nan, math.nan
        with suppress(TypeError, ValueError):
            rate, spread = (found.crash_rate, found.ci_high - found.ci_low) if is_whole else map(float, found)
        if not (math.isfinite(rate) and 0.0 <= spread < math.inf):
            expected = "a rate and its standard error, or an Estimate, of numbers"
            raise HarnessError(f"{self._name}, result", repr(found), expected, "Fix what it returns.")
        estimate = found if is_whole else self.estimate(rate, spread, None, confidence)
        return replace(estimate, warnings=(*estimate.warnings, note("own")))

    def _call(self, work: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return work(*arguments)
        except (Exception, SystemExit) as error:
            mend = "Fix the class; it has to bear being copied, too."
            raise HarnessError(self._name, cause_of(error), "an estimator that raises nothing", mend) from error


class Diagnostics:
    """Running moments of weights and ratios; add blocks, ask for the result. No event begins before ``onset``."""

    _drawn: SamplingPlan  # of the last block

    def __init__(self, onset: int | None = None) -> None:
        self.n, self._onset = 0, onset
        self.counts = Counter[str]()
        self._weight, self._event, self._contact = Moments(), Moments(), Moments()
        self._ratios = defaultdict[int, Moments](Moments)

    def add(self, block: Block) -> None:
        weights, contact = block.weights(), block.outcome == CONTACT
        self._drawn = block.drawn
        self.n += len(block)
        self.counts.update(block.acts(), n_bv_lv_contacts=int(contact.sum()), n_failed=int(block.failed.sum()))
        if n_early := block.n_crashes_before_event(self._onset):
            self.counts["n_crashes_before_event"] += n_early
        self._weight += Moments.of(weights)
        self._event += Moments.of(weights[block.happened])
        self._contact += Moments.of(weights[contact])
        for j, ratios in enumerate(block.mixture_ratios().T if block.drawn.sampling.mixes else ()):
            self._ratios[j] += Moments.of(ratios)

    def result(self) -> dict[str, Any]:
        """Means with standard errors; importance functions without names are numbered."""
        names = self._drawn.names
        ratios = {names[j] if names else f"q_{j}": sums for j, sums in self._ratios.items()}
        return {
            "mean_weight": self._mean(self._weight),
            "mean_weight_event": self._mean(self._event),
            "mean_ratio": {name: self._mean(sums) for name, sums in ratios.items()},
            "bv_lv_contact_share": self._mean(self._contact),
            **self.counts,
        }

    def _mean(self, sums: Moments) -> dict[str, float]:
        has_mean = not self._drawn.sampling.strata
        return {"mean": sums.mean(self.n), "std_error": sums.std_error(self.n)} if has_mean else UNKNOWN_MEAN


def asked_for(estimators: Iterable[Any], where: str) -> list[AnyEstimator]:
    """The estimators that a user asks for: by name, by ``my.py:Class``, as a class, or as an object.

    Raises `HarnessError`: there is no such estimator, or it says not whose tests it can use.
    """
    return [each if isinstance(each, str) and each in ESTIMATORS else _own(each, where) for each in estimators]


def _own(asked: Any, where: str) -> OwnEstimator:
    if isinstance(asked, OwnEstimator):
        return asked
    wanted, made = "a class with methods, add and result (see docs/estimators.md)", asked
    name = getattr(asked, "__name__", type(asked).__name__)
    if isinstance(asked, str):
        installed = {each.name: each.value for each in entry_points(group="harness.estimators")}
        if asked not in installed and ":" not in asked:
            names = [*ESTIMATORS, *installed]
            mend = did_you_mean(asked, names) or "Write my.py:MyEstimator for one of your own."
            raise HarnessError(where, f"'{asked}'", f"one of {', '.join(map(repr, names))}, or my.py:MyEstimator", mend)
        name = asked.rpartition("/")[2]
        made = own_code(installed.get(asked, asked), where, wanted)
    if missing := [each for each in ("methods", "add", "result") if not hasattr(made, each)]:
        raise HarnessError(where, f"{name} without {' and '.join(missing)}", wanted, "Add what is missing.")
    if name in ESTIMATORS:
        expected = "a name that none of the harness's own has"
        raise HarnessError(where, f"a class of your own named {name}", expected, "Rename the class.")
    weighted = [each for each in METHODS if each != "shells"]
    methods = made.methods if isinstance(made.methods, list | tuple | set) else ()
    if not methods or not all(each in weighted for each in methods):
        expected = f"those of {listed(weighted)} whose tests it can use; shells have no weights"
        mend = 'Write methods = ("forced",), say. Weights have mean 1 only where a method can draw every test.'
        raise HarnessError(where, f"{name} with methods {made.methods!r}", expected, mend)
    return OwnEstimator(name, made if isinstance(made, type) else partial(deepcopy, made), tuple(methods))


def headline_of(campaign: Campaign) -> AnyEstimator:
    """Whose estimate answers a campaign's question and stops it: its own, or its method's.

    Raises `HarnessError`: there is no such estimator, or it cannot use such tests.
    """
    where, method, headline = "testing.estimator", campaign.testing.method, campaign.sampling.headline
    (estimator,) = asked_for([campaign.testing.estimator or headline], where)
    if not _can_use(estimator, method):
        mend = f"Choose such a method, or delete the key for {headline}."
        raise CampaignError(where, f"{estimator}, with testing.method {method}", "an estimator for such tests", mend)
    return estimator


def _can_use(estimator: AnyEstimator, method: Method) -> bool:
    if isinstance(estimator, OwnEstimator):
        return method in estimator.methods
    return estimator in SAMPLING[method].estimators


def refusal(block: Block, estimator: AnyEstimator) -> Note | None:
    """Why records like this block do not allow an estimator; None if they do."""
    method = block.drawn.method
    if not _can_use(estimator, method):
        if isinstance(estimator, OwnEstimator):
            return note("needs_own", methods=", ".join(estimator.methods), method=method)
        return note(f"needs_{estimator}", method=method)
    return note("needs_moments") if estimator == "scv" and "first_ratios" not in block.columns else None


def accumulator(estimator: AnyEstimator) -> Accumulator:
    """Empty state of an estimator, for those who feed it themselves (the runner does, for stopping)."""
    state = OwnState(estimator) if isinstance(estimator, OwnEstimator) else ACCUMULATORS[estimator]()
    return state if isinstance(state, SeenShells) else FailureBounds(state)  # which bounds them itself


@dataclass(frozen=True)
class PassResult:
    """What one pass over a campaign's blocks gives.

    ``estimates`` begin with the ``headline``, the campaign's own, asked for or not; ``convergence`` is that on growing
    prefixes, for plots: block boundaries at least 1 % apart; ``severity`` is how hard its crashes are, ``cut_off`` the
    rate of tests that ended with the AV about to crash, the first of which is ``cut_off_test``.
    """

    estimates: dict[str, Estimate | Unavailable]
    headline: str
    headline_estimate: Estimate
    diagnostics: Diagnostics
    convergence: list[Point]
    severity: Severity | None
    cut_off: float
    cut_off_test: int | None


def even(blocks: Iterable[Block]) -> Iterator[Block]:
    """The same tests in blocks whose sizes follow from the tests before them alone, not from how they were run."""
    waiting: list[Block] = []
    n, size = 0, FEWEST_TOGETHER
    for block in blocks:
        waiting.append(block)
        while sum(map(len, waiting)) >= size:
            together = joined(waiting)
            waiting = [together.take(slice(size, len(together)))] if len(together) > size else []
            yield together.take(slice(0, size))
            n += size
            size = min(max(FEWEST_TOGETHER, round(n * (SPACING - 1.0))), MOST_TOGETHER)
    if waiting:
        yield joined(waiting)


def one_pass(
    blocks: Iterable[Block],
    names: Collection[AnyEstimator] = ESTIMATORS,
    best: AnyEstimator | None = None,
    confidence: float = 0.9,
    onset: int | None = None,
) -> PassResult:
    """Feed every block to every estimator that can use it; the ``best``, the headline, is by default the method's own.

    Blocks are contiguous and in index order, from episode 0; a gap, or no episode at all, is a `ValueError`. Too few
    tests for the headline are a `CampaignError`. ``onset`` is the step before which no event begins, if known.
    """
    blocks = iter(blocks)
    if (first := next(blocks, None)) is None:
        raise ValueError("an estimate needs at least one episode")
    best = best or first.drawn.sampling.headline
    estimators = {str(each): each for each in (*names, best)}
    own = str(best)
    refusals = {name: refusal(first, estimators[name]) for name in (own, *estimators)}
    states = {name: accumulator(estimators[name]) for name, why in refusals.items() if why is None}
    empty = partial(accumulator, best)
    impacts = Impacts(empty, first.drawn.counts_above_mps) if "impact_mps" in first.columns else None
    diagnostics = Diagnostics(onset)
    convergence = list[Point]()
    n = 0
    for block in chain((first,), blocks):
        if block.first_episode != n:
            raise ValueError(f"expected a block from episode {n} on, got one from {block.first_episode}")
        n += len(block)
        diagnostics.add(block)
        for state in states.values():
            state.add(block)
        if impacts is not None:
            impacts.add(block)
        if not convergence or n >= convergence[-1].n * SPACING:
            convergence.append(_point(states[own].result(confidence)))
    results = {name: state.result(confidence) for name, state in states.items()}
    too_few = {name: note("needs_tests", n=n, least=least) for name, least in LEAST_TESTS.items() if n < least}
    if own in too_few:  # a run that was interrupted: others are refused before a test
        expected = f"{LEAST_TESTS[own]:,}: below, its intervals miss too often"
        mend = "Go on with --resume, or let another answer: --resume --set testing.estimator=nade."
        raise CampaignError("testing.estimator", f"{own}, with {n:,} tests", expected, mend)
    refusals = {name: too_few.get(name) if why is None else why for name, why in refusals.items()}
    if convergence[-1].n != n:
        convergence.append(_point(results[own]))
    estimates = {name: results[name] if why is None else Unavailable(why) for name, why in refusals.items()}
    passed = estimates, own, results[own], diagnostics, convergence
    if impacts is None:
        return PassResult(*passed, None, 0.0, None)
    return PassResult(*passed, impacts.result(confidence), impacts.cut_off(), impacts.cut_off_test)


def _point(best: Estimate) -> Point:
    return Point(best.n_episodes, best.crash_rate, best.ci_low, best.ci_high, best.precision, best.n_crashes)
