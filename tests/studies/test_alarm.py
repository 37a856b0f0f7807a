"""The alarm: surrogates in the place of the AV crash as the pool says, and no p-value is too small.

Four standard errors miss with a probability of 6e-5 per surrogate and method. Where outcomes are few they are all
counted, so that probabilities are exact.
"""

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.special import ndtr
from scipy.stats import binom, norm

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.estimators.block import Block, block_from_tables
from harness.pool.build import campaign_pool
from harness.pool.kept import Pool
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import BoolArray
from harness.worlds.twin import TwinWorld
from studies.alarm import LEVEL, Alarm, KnownRates, drivers_crash, surrogates_crash
from tests.chains.seed import SEED
from tests.estimators.small_blocks import block as block_of
from tests.pool.conftest import SMALL_POOL
from tests.stored_runs import MIXTURE_FILE

pytestmark = pytest.mark.slow


def told(known: KnownRates, tests: Block, crashes: BoolArray) -> dict[str, Any]:
    """What the alarm says of some tests."""
    alarm = Alarm(known)
    alarm.add(tests, crashes)
    return alarm.result()


N = 10_000
LATE = "av={model: idm, parameters: {min_acceleration_mps2: -3}, reaction: {delay_s: 0.7}}"


def campaign(method: str, *more: str) -> Campaign:
    return load_campaign(MIXTURE_FILE, [f"testing.method={method}", f"seed={SEED}", *SMALL_POOL, *more])


def drive(campaign: Campaign, n: int = N) -> pa.Table:
    ready = prepare(resolve(campaign))
    return episodes_table(ready.loop(TwinWorld(256)).run(0, ready.tests(0, n)), campaign.seed)


def replayed(campaign: Campaign, table: pa.Table, pool: Pool) -> tuple[Block, BoolArray]:
    """The episodes, and which surrogates would have crashed in them."""
    return block_from_tables(campaign, table), surrogates_crash(table, resolve(campaign), pool)


@pytest.fixture(scope="module")
def forced() -> tuple[Campaign, pa.Table, Pool]:
    one = campaign("forced", LATE)
    return one, drive(one), campaign_pool(resolve(one))


def test_a_surrogate_that_is_the_av_crashes_where_the_av_did(forced):
    one, table, pool = forced
    block, crashes = replayed(one, table, pool)
    own = crashes[:, pool.names.index("brakes-3-late-700ms")]
    assert block.crash.sum() > 30
    np.testing.assert_array_equal(own, block.crash)
    assert not np.array_equal(crashes[:, pool.names.index("brakes-3")], block.crash)


@pytest.mark.parametrize("hold_s", [1.0, 0.1])
def test_other_draws_after_the_end_do_not_change_what_was_driven(hold_s):
    """The AV never brakes: its crashes cut the paths short, and careful surrogates need what comes after."""
    one, other = (
        campaign("forced", f"environment.acceleration_hold_s={hold_s}", av)
        for av in ("av.model=constant", "av.model=idm")
    )
    environment, tables = resolve(one).environment, [drive(each, 400) for each in (one, other)]
    followers = resolve(one).library.followers(environment.lateral.present)
    short, long = (drivers_crash(paths, one.seed, environment, followers) for paths in tables)
    assert tables[0].column("outcome").to_pylist().count("crash") > 100
    np.testing.assert_array_equal(short, long)


@pytest.mark.parametrize(
    ("method", "level", "n"), [("nde", 1e5, 4 * N), ("forced", 1.0, 2 * N), ("episode_mixture", 1.0, 2 * N)]
)
def test_weighted_crashes_of_surrogates_have_the_rates_of_the_pool(method, level, n):
    one = campaign(method, f"environment.lane_change_level={level}")
    pool = campaign_pool(resolve(one))
    block, crashes = replayed(one, drive(one, n), pool)
    found, h = told(KnownRates.of(pool), block, crashes), crashes * block.weights()[:, None]
    error = np.sqrt(h.var(axis=0) / n + np.diag(pool.mu_covariance))
    many = np.array([entry["n_effective"] for entry in found["surrogates"]]) >= 100.0
    assert np.count_nonzero(many) >= 5
    assert np.max(np.abs(h.mean(axis=0) - pool.mu)[many] / error[many]) < 4.0
    assert not found["raised"]


@pytest.mark.parametrize("wrong", [0.7, 1.25])
def test_weights_that_are_all_wrong_raise_the_alarm_and_so_does_one_wrong_rate(forced, wrong):
    known, (block, crashes) = KnownRates.of(forced[2]), replayed(*forced)
    weighted = replace(block, log_weight=block.log_weight + np.log(wrong))
    assert told(known, weighted, crashes)["raised"]
    one = np.where(np.arange(known.mu.size) == 3, wrong**4, 1.0)
    assert told(known._replace(mu=known.mu * one), block, crashes)["raised"]
    assert not told(known, block, crashes)["raised"]


# -- exactly, on worlds with few outcomes --


def weighted(
    h: list[float], mu: float, *, cap: float | None = None, p_event: float | None = None, error: float = 0.0
) -> dict[str, Any]:
    """What the alarm says where one surrogate, of a rate known with an error, crashes with weights ``h``, 0 for none.

    They are bounded by a ``cap``, or are those of forced cut-ins with a mean ``p_event`` where it crashes.
    """
    crashes, one = np.array(h) > 0.0, {"log_q": np.zeros((len(h), 1)), "alpha": np.zeros(1), "weight_cap": cap}
    method = "episode_mixture" if p_event is None else "forced"
    tests = block_of([False] * len(h), np.log(np.where(crashes, h, 1.0)), method=method, **one)
    rates = np.array([mu]), np.array([error]), np.array([1.0 if p_event is None else p_event])
    return told(KnownRates(("one",), *rates), tests, crashes[:, None])


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
        probability * weighted([heavy] * n_rare + [light] * (n - n_rare), mu, p_event=at_crash)["raised"]
        for n_rare, probability in enumerate(binom.pmf(np.arange(n + 1), n, rare))
    )


@pytest.mark.parametrize("rare", [0.003, 0.02, 0.5])
@pytest.mark.parametrize("times", [2.0, 1_000.0])
def test_forced_cut_ins_hold_the_level_where_heavy_paths_were_not_driven(rare, times):
    assert paths_missed(rare, times) <= LEVEL


def test_a_pool_that_tells_too_light_paths_would_break_it():
    assert paths_missed(0.02, 1_000.0, told_share=0.05) > 0.1
