"""An estimator of one's own: ``my.py:Class``, an entry point of the group ``harness.estimators``, or an object.

It is a class that names the ``methods`` whose tests it can use, is fed blocks of them (``add``), and says
(``result``, at a confidence) a rate and its standard error, or a whole `Estimate`. What a block is drawn by, with the
campaign's epsilon, mixture weights and names, is ``block.drawn``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points
from typing import Any, TypeAlias

import numpy as np

from harness.campaign.campaign import Campaign
from harness.controllers.find import own_code
from harness.controllers.hosts import cause_of
from harness.errors import CampaignError, HarnessError
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, note
from harness.estimators.weighted import Nade
from harness.problems import did_you_mean, listed
from harness.vocabulary import ESTIMATORS, METHODS, SAMPLING, EstimatorName


@dataclass(frozen=True)
class OwnEstimator:
    """What ``make`` makes, once for each pass over the tests; ``name`` is its key in ``estimates.json``."""

    name: str
    make: Callable[[], Any]
    methods: tuple[str, ...]

    def __str__(self) -> str:
        return self.name


Asked: TypeAlias = EstimatorName | OwnEstimator


class OwnState(Nade):
    """An estimator of one's own, beside the moments of weighted crashes that say whether a mean can be trusted."""

    def __init__(self, of: OwnEstimator) -> None:
        super().__init__()
        self._name = of.name
        self._own = self._call(deepcopy, self._call(of.make))  # as it will be once a test has failed

    def add(self, block: Block) -> None:
        """Add the episodes of one block."""
        super().add(block)
        self._call(self._own.add, block)

    def result(self, confidence: float) -> Estimate:
        """Its own estimate, or one with a normal interval, our cautions and our upper bound."""
        found = self._call(self._own.result, confidence)
        if not isinstance(found, Estimate):
            rate, std_error = found if isinstance(found, tuple) and len(found) == 2 else (np.nan, np.nan)
            if not (np.isfinite(rate) and std_error >= 0.0):
                expected = "a rate and its standard error, or an Estimate"
                raise HarnessError(f"{self._name}, result", repr(found), expected, "Fix what it returns.")
            found = self.estimate(float(rate), float(std_error), None, confidence)
        return replace(found, warnings=(*found.warnings, note("own")))

    def _call(self, work: Callable[..., Any], *given: Any) -> Any:
        try:
            return work(*given)
        except (Exception, SystemExit) as error:
            mend = "Fix the class; it has to bear being copied, too."
            raise HarnessError(self._name, cause_of(error), "an estimator that raises nothing", mend) from error


def asked_for(estimators: Iterable[Any], where: str) -> list[Asked]:
    """The estimators that a user asks for: by name, by ``my.py:Class``, as a class, or as an object.

    Raises `HarnessError`: there is no such estimator, or it says not whose tests it can use.
    """
    return [each if isinstance(each, str) and each in ESTIMATORS else _own(each, where) for each in estimators]


def _own(of: Any, where: str) -> OwnEstimator:
    if isinstance(of, OwnEstimator):
        return of
    what, name, found = (
        "a class with methods, add and result (see docs/estimators.md)",
        getattr(of, "__name__", type(of).__name__),
        of,
    )
    if isinstance(of, str):
        installed = {each.name: each.value for each in entry_points(group="harness.estimators")}
        if of not in installed and ":" not in of:
            known = [*ESTIMATORS, *installed]
            mend = did_you_mean(of, known) or "Write my.py:MyEstimator for one of your own."
            raise HarnessError(where, f"'{of}'", f"one of {', '.join(map(repr, known))}, or my.py:MyEstimator", mend)
        name, found = of.rpartition("/")[2], own_code(installed.get(of, of), where, what)
    if missing := [each for each in ("methods", "add", "result") if not hasattr(found, each)]:
        raise HarnessError(where, f"{name} without {' and '.join(missing)}", what, "Add what is missing.")
    if isinstance(found.methods, str) or not {*found.methods} <= {*METHODS} - {"shells"}:
        weighted = listed(each for each in METHODS if each != "shells")
        expected = f"those of {weighted} whose tests it can use; shells have no weights"
        mend = 'Write methods = ("forced",), say. Weights have mean 1 only where a method can draw every test.'
        raise HarnessError(where, f"{name} with methods {found.methods!r}", expected, mend)
    return OwnEstimator(name, found if isinstance(found, type) else partial(deepcopy, found), tuple(found.methods))


def headline_of(campaign: Campaign) -> Asked:
    """Whose estimate answers a campaign's question and stops it: its own, or its method's.

    Raises `HarnessError`: there is no such estimator, or it cannot use such tests.
    """
    where, method, headline = "testing.estimator", campaign.testing.method, campaign.sampling.headline
    (found,) = asked_for([campaign.testing.estimator or headline], where)
    if method not in found.methods if isinstance(found, OwnEstimator) else found not in SAMPLING[method].estimators:
        mend = f"Choose such a method, or delete the key for {headline}."
        raise CampaignError(where, f"{found}, with testing.method {method}", "an estimator for such tests", mend)
    return found
