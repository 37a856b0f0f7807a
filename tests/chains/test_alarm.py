"""The alarm on exact worlds: false no more often than stated, and raised where rates or weights are wrong.

Seeds are fixed. Where outcomes are few they are all counted, so that probabilities are exact.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import binom, norm

from harness.estimators.block import Block
from harness.vocabulary import BoolArray
from studies.alarm import LEVEL, Alarm, KnownRates
from studies.chains.sampler import SingleChoice
from tests.chains.seed import SEED
from tests.estimators.small_blocks import block

N = 2_000

WORLD = SingleChoice(
    p=np.array([0.6, 0.37, 0.01, 0.01, 0.005, 0.005]),
    crash=np.array([False, False, False, True, True, True]),
    q=np.array([[0.2, 0.2, 0.1, 0.2, 0.1, 0.2], [0.1, 0.1, 0.4, 0.1, 0.2, 0.1]]),
    alpha=np.array([0.5, 0.5]),
)
SURROGATES = np.array([[0, 0, 0, 1, 1, 0], [0, 0, 1, 1, 1, 1], [0, 1, 1, 0, 0, 0]], np.bool_)
"""More careful than the vehicle, more careless, another kind of vehicle."""
MEAN_WEIGHT = SURROGATES @ (WORLD.p**2 / (WORLD.alpha @ WORLD.q)) / (SURROGATES @ WORLD.p)
"""Mean squares of weighted crashes over their means, exactly."""
ERROR = 0.01


def replayed(rng: np.random.Generator, *, corrupt: float = 1.0, n: int = N) -> tuple[Block, BoolArray, KnownRates]:
    """Tests with surrogates whose rates come from a pool of its own in every replication."""
    maneuver = WORLD.maneuvers(n, rng)
    truth = SURROGATES @ WORLD.p
    pool = truth * (1.0 + ERROR * rng.normal(size=3)) * [corrupt, 1.0, 1.0]
    at_crash = MEAN_WEIGHT * WORLD.alpha[0]  # as if the first were forced cut-ins
    known = KnownRates(("careful", "careless", "other"), pool, ERROR * truth, at_crash)
    return WORLD.block("episode_mixture", maneuver), SURROGATES[:, maneuver].T, known


def told(tests: Block, crashes: BoolArray, known: KnownRates) -> dict[str, Any]:
    """What the alarm says of some tests."""
    alarm = Alarm(known)
    alarm.add(tests, crashes)
    return alarm.result()


@pytest.mark.parametrize(("corrupt", "raised"), [(1.0, False), (1.3, True), (0.8, True)])
def test_a_corrupted_rate_raises_the_alarm(corrupt, raised):
    assert told(*replayed(np.random.default_rng(SEED), corrupt=corrupt, n=20_000))["raised"] == raised


def weighted(
    h: list[float], mu: float, *, cap: float | None = None, p_cut_in: float | None = None, error: float = 0.0
) -> dict[str, Any]:
    """What the alarm says where one surrogate, of a rate known with an error, crashes with weights ``h``, 0 for none.

    They are bounded by a ``cap``, or are those of forced cut-ins with a mean ``p_cut_in`` where it crashes.
    """
    crashes, one = np.array(h) > 0.0, {"log_q": np.zeros((len(h), 1)), "alpha": np.zeros(1), "weight_cap": cap}
    method = "episode_mixture" if p_cut_in is None else "forced"
    tests = block([False] * len(h), np.log(np.where(crashes, h, 1.0)), method=method, **one)
    rates = np.array([mu]), np.array([error]), np.array([1.0 if p_cut_in is None else p_cut_in])
    return told(tests, crashes[:, None], KnownRates(("one",), *rates))


def by_sample_variance(h: list[float], mu: float, cap: float) -> float:
    """Normal p-value with the sample's own variance, where it has 100 effective crashes."""
    x = np.array(h)
    if (x**2).sum() * 100.0 > x.sum() ** 2:
        return 1.0
    return float(2.0 * ndtr(-abs(x.mean() - mu) / (x.std() / math.sqrt(x.size))))


def false_alarms(
    rule: Callable[[list[float], float, float], float], n: int, light: float, heavy: float, weight: float
) -> dict[float, float]:
    """Exact probability of a p-value that small, by p-value, where light crashes weigh 1, of n tests.

    What is left out, numbers of light and heavy crashes that are hardly ever seen, has a probability of 1e-6 at most.
    """
    mu, found = light + heavy * weight, dict.fromkeys((0.3, 0.1, 0.01, 1e-3, LEVEL), 0.0)
    p_heavy = binom.pmf(np.arange(n + 1), n, heavy)
    for n_heavy in np.flatnonzero(p_heavy > 1e-9).tolist():
        p_light = binom.pmf(np.arange(n - n_heavy + 1), n - n_heavy, light / (1.0 - heavy))
        for n_light in np.flatnonzero(p_light > 1e-9).tolist():
            h = [weight] * n_heavy + [1.0] * n_light + [0.0] * (n - n_heavy - n_light)
            p_value = rule(h, mu, max(weight, 1.0))
            for level in found:
                found[level] += float(p_heavy[n_heavy] * p_light[n_light]) * (p_value <= level)
    return found


HEAVY = (220, 0.6, 1e-3, 1e3)
"""The heavy crashes make up more than half of the rate, and four in five campaigns see none."""


@pytest.mark.parametrize(
    ("n", "light", "heavy", "weight"),
    [HEAVY, (80, 0.6, 0.02, 50.0), (60, 0.3, 0.0, 1.0), (40, 0.01, 0.0, 1.0), (25, 0.5, 0.2, 3.0), (5, 0.3, 0.2, 9.0)],
)
def test_every_p_value_holds_also_where_heavy_weights_have_not_occurred(n, light, heavy, weight):
    found = false_alarms(lambda h, mu, cap: weighted(h, mu, cap=cap)["p_value"], n, light, heavy, weight)
    for level, probability in found.items():
        assert probability <= level + 1e-6


def test_a_p_value_from_the_sample_variance_does_not_hold():
    assert false_alarms(by_sample_variance, *HEAVY)[LEVEL] > 0.7


@pytest.mark.parametrize(("told_error", "holds"), [(0.04, True), (0.0, False)])
def test_the_level_holds_where_the_pool_errs_if_its_error_is_told(told_error, holds):
    """Probability of a false alarm in 1,000 plain tests where the pool's rate of 0.5 has a normal error of 0.04.

    The counts that raise it lie beyond two limits. The normal error is summed in steps of a quarter of it.
    """
    found, n, p = 0.0, 1_000, 0.5
    for z in np.arange(-6.0, 6.1, 0.25):

        def raised(count: int, mu: float = p + 0.04 * z) -> bool:
            return bool(weighted([1.0] * count + [0.0] * (n - count), mu, cap=1.0, error=told_error)["raised"])

        centre = round(n * (p + 0.04 * z))
        low = bisect_left(range(centre), True, key=lambda count: not raised(count))
        high = bisect_left(range(centre, n + 1), True, key=raised) + centre
        found += 0.25 * float(norm.pdf(z) * (binom.cdf(low - 1, n, p) + binom.sf(high - 1, n, p)))
    assert found <= LEVEL if holds else found > 0.01


def paths_missed(rare: float, times: float, told_share: float = 1.0) -> float:
    """Exact probability of a false alarm in 100 tests where a ``rare`` share of paths has ``times`` P(cut-in | path).

    The surrogate crashes at every cut-in. The pool tells ``told_share`` of the mean of that at its crashes.
    """
    light, heavy, n = 1e-5, 1e-5 * times, 100
    mu = (1.0 - rare) * light + rare * heavy
    at_crash = told_share * ((1.0 - rare) * light**2 + rare * heavy**2) / mu
    return sum(
        probability * weighted([heavy] * n_rare + [light] * (n - n_rare), mu, p_cut_in=at_crash)["raised"]
        for n_rare, probability in enumerate(binom.pmf(np.arange(n + 1), n, rare))
    )


@pytest.mark.parametrize("rare", [0.003, 0.02, 0.5])
@pytest.mark.parametrize("times", [2.0, 1_000.0])
def test_forced_cut_ins_hold_the_level_where_heavy_paths_were_not_driven(rare, times):
    assert paths_missed(rare, times) <= LEVEL


def test_a_pool_that_tells_too_light_paths_would_break_it():
    assert paths_missed(0.02, 1_000.0, told_share=0.05) > 0.1
