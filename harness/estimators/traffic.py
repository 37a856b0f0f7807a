"""What is not known about the traffic, beside the sampling error: by how much a rate differs between replicates of it.

Replicates are environments that the same trajectories might as well have given. A rate is found in each by the same
tests and the same paths (`harness.runner.other_traffic`); of the factors by which it moves, ``times`` are the quantiles
that leave out as much on either side as the interval of the sampling error does. Both errors are independent: on a
logarithmic scale their distances from the rate add as squares on either side (MOVER: Donner and Zou, Stat. Methods Med.
Res. 21, 2012, 347). What a reference driver's rate comes out wrong by in a replicate, the vehicle's may, too: it widens
the factor to both sides. A replicate that could not be answered counts as whatever makes the interval wider.

`Bar` and `Sensitivity` say by how much it moves with one number, or a block of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.estimators.estimate import Number
from harness.vocabulary import FloatArray

ONE_LAW = 0.07
"""By how much a ratio of two vehicles may be wrong besides, as one law is fitted to drivers who differ [measured where
they do in a simulation, and nearly alike vehicles came out 4 to 7 % off: `python -m studies roundtrip`]."""

LEAST_SHARE = 0.5
"""Mean share of a shell's events on which the vehicle crashes, from which on shares are taken to stay the same. Where
events take time, rates of drivers with 0.58 or more came out wrong by at most 6 %, with 0.33 by 16 %, with 0.1 by 28 %,
with 0.02 by more than a factor of 3 (`python -m benchmarks.other_traffic`)."""

Ends = tuple[float, Number]


def mean_share(p: FloatArray, share: FloatArray) -> float:
    """``share`` of tests that crash (S,), averaged over what strata add to the rate; 1 where none has crashed."""
    return float(p @ share**2 / (p @ share)) if share.any() else 1.0


@dataclass(frozen=True)
class Uncertain:
    """A rate, or its ratio to another: interval of the sampling error, of the ``environment``, and of both.

    ``times`` are the ends of the environment's interval over the value; an end above without a limit is infinite.
    """

    value: float
    times: Ends
    sampling: Ends
    environment: Ends
    both: Ends


@dataclass(frozen=True)
class Unseen:
    """Where no lane change was seen: times to collision, share of the rate there, and ``steps`` of the acceptance."""

    where: str
    share: float
    steps: tuple[int, ...]


@dataclass(frozen=True)
class TrafficError:
    """What replicates of an ``environment`` say of a rate, and of its ratios to others, by name.

    ``n_refused`` of them have no answer; the others may be ``off`` in the mean. ``unseen`` leaves upper limits alone.
    """

    environment: str
    confidence: float
    n_replicates: int
    n_refused: int
    off: float
    rate: Uncertain
    ratios: Mapping[str, Uncertain]
    unseen: Unseen | None = None

    @property
    def is_open(self) -> bool:
        """Whether so many replicates could not be answered that nothing is said."""
        return not math.isfinite(self.rate.times[1])


def uncertain(
    value: float,
    sampling: Ends,
    factors: FloatArray,
    off: FloatArray,
    n_refused: int,
    confidence: float,
    *,
    from_below: bool = True,
    held: bool = True,
) -> Uncertain:
    """What replicates leave open of a value: ``factors`` (B,) by which it moves, each ``off`` (B,) by so much at most.

    Unless ``from_below`` there is an upper limit alone; unless ``held`` the factors are of the upper limit.
    """
    tail = round((1.0 - confidence) / 2.0, 12)  # so that it falls on one of them where it should
    lower = np.append(factors / (1.0 + off), np.zeros(n_refused))
    upper = np.append(factors * (1.0 + off), np.full(n_refused, np.inf))
    low = float(np.quantile(lower, tail, method="lower")) if from_below else 0.0
    high = float(np.quantile(upper, 1.0 - tail, method="higher"))
    if value <= 0.0 or not held:
        return Uncertain(value, (low, high), sampling, (0.0, 0.0), (0.0, sampling[1] * high))
    environment = value * low, value * high
    below, above = (
        math.hypot(*(max(side * _log(end / value), 0.0) for end in ends))
        for side, ends in zip((-1.0, 1.0), zip(sampling, environment, strict=True), strict=True)
    )
    both = value * math.exp(-below), value * math.exp(min(above, 700.0)) if above < math.inf else math.inf
    return Uncertain(value, (low, high), sampling, environment, both)


def _log(value: float) -> float:
    return math.log(value) if 0.0 < value < math.inf else math.copysign(math.inf, value - 1.0)


LEAST_MOVE = 0.01
"""Change of rate or ratio from which a number of the traffic is shown."""


@dataclass(frozen=True)
class Bar:
    """A number, or a block of them, by how it is ``known``, and the factors of rate and ratio at its two ends.

    ``values`` are the ends, None for a block; ``off`` is by how much a reference driver's rate comes out wrong at most.
    A factor is NaN if no test tells it: of ``n`` environments ``no_laws`` have no laws, ``unlike`` were not tested.
    """

    what: str
    known: Literal["fitted", "assumed", "counted"]
    values: tuple[float, float] | None
    rate: tuple[Number, Number]
    ratio: tuple[Number, Number]
    off: tuple[Number, Number]
    n: int = 2
    no_laws: int = 0
    unlike: int = 0

    @property
    def span(self) -> float:
        """How far rate or ratio moves, on a logarithmic scale; below 0 where the tests do not say it."""
        return max((abs(math.log(end)) for end in (*self.rate, *self.ratio) if end > 0.0), default=-1.0)


def tests_of_sum(content: Mapping[str, Any]) -> str:
    """What the sum of several scenarios is known by, in the place of a campaign's hash: its tests and exposures."""
    exposures = (f"{family['exposure']['per_hour']:g}" for family in content["families"].values())
    return "-".join([f"{content.get('campaign_crc32')}", f"{content['n_episodes']}", *exposures])


@dataclass(frozen=True)
class NotMoved:
    """A scenario of several whose numbers were not moved, or not all: ``share`` is its part of the rate.

    ``found`` and ``needed`` say why; both are empty where none of its tests crashed.
    """

    scenario: str
    share: float
    found: str = ""
    needed: str = ""


@dataclass(frozen=True)
class Sensitivity:
    """Content of ``sensitivity.json``: bars, the longest first, and the driver whose ratio they are about."""

    campaign_hash: str
    environment: str
    driver: str
    bars: tuple[Bar, ...] = ()
    not_moved: tuple[NotMoved, ...] = ()

    @property
    def shown(self) -> list[Bar]:
        """Bars that these tests tell, and that move something."""
        return [bar for bar in self.bars if bar.span >= LEAST_MOVE]
