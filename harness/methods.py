"""The methods of drawing tests and the estimators, by name: what each method draws, needs and is answered by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Method = Literal["nde", "forced", "step_mixture", "episode_mixture", "shells"]
EstimatorName = Literal["nde", "nade", "mixture_cv", "scv", "shells"]

METHODS: tuple[Method, ...] = get_args(Method)
ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)


@dataclass(frozen=True)
class Sampling:
    """One method of drawing tests.

    Attributes
    ----------
    estimators : tuple of str
        Those that its records allow, the first being the method's own, which answers the campaign's question; `scv`
        needs control steps on record besides.
    mixes : bool
        Whether it mixes importance functions of the surrogates, and so needs some, and their challenge tables.
    forces : bool
        Whether forced cut-ins are among what it draws from.
    holds_speed : bool
        Whether the AV must hold its speed until the cut-in, because what is drawn before the episode depends on it.
    shadows : bool
        Whether an AV that does not is driven along each path without a cut-in first.
    bounded : bool
        Whether something bounds the weights; else no precision can be promised.
    """

    estimators: tuple[EstimatorName, ...]
    mixes: bool = False
    forces: bool = False
    holds_speed: bool = False
    shadows: bool = False
    bounded: bool = True

    @property
    def headline(self) -> EstimatorName:
        """The method's own estimator."""
        return self.estimators[0]


SAMPLING: dict[Method, Sampling] = {
    "nde": Sampling(("nde", "nade")),
    "forced": Sampling(("nade",), forces=True, shadows=True),
    "step_mixture": Sampling(("nade", "scv"), mixes=True, bounded=False),
    "episode_mixture": Sampling(("mixture_cv", "nade"), mixes=True, forces=True, holds_speed=True),
    "shells": Sampling(("shells",), shadows=True),
}
