"""Martingale terms and replayed surrogates on exact worlds: they cover, they save, and their mutants are caught.

Seeds are fixed. Each `binomtest` would reject a correct 90 % interval with probability 1e-4.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.estimators.alarm import Alarm
from harness.estimators.block import Block
from harness.estimators.martingale import PLAIN, RESIDUALS, Martingale
from harness.estimators.nade import Nade
from harness.estimators.replay import Replay
from harness.pool.surrogate_replay import KnownRates
from harness.validation.chains.named import frequent_decisive, panel
from harness.validation.chains.sampler import draw

from .coverage import replicate
from .seed import SEED
from .single_choice import SingleChoice

REPLICATIONS = 400
N = 2_000
CONFIDENCE = 0.9
FALSE_ALARM = 1e-4
MIXTURES = ["step_mixture", "episode_mixture"]

WORLD = SingleChoice(
    p=np.array([0.6, 0.37, 0.01, 0.01, 0.005, 0.005]),
    crash=np.array([False, False, False, True, True, True]),
    q=np.array([[0.2, 0.2, 0.1, 0.2, 0.1, 0.2], [0.1, 0.1, 0.4, 0.1, 0.2, 0.1]]),
    alpha=np.array([0.5, 0.5]),
)
SURROGATES = np.array(
    [
        [False, False, False, True, True, False],  # more careful than the vehicle
        [False, False, True, True, True, True],  # more careless
        [False, True, True, False, False, False],  # another kind of vehicle
    ]
)
ERROR = 0.01


def covers(covered: int) -> bool:
    return binomtest(covered, REPLICATIONS, CONFIDENCE).pvalue > FALSE_ALARM


def replayed(
    rng: np.random.Generator, *, corrupt: float = 1.0, error: float = ERROR, claimed: float = ERROR, n: int = N
) -> Block:
    """Tests with surrogates whose rates come from a pool of its own in every replication."""
    maneuver = WORLD.maneuvers(n, rng)
    truth = SURROGATES @ WORLD.p
    pool = truth * (1.0 + error * rng.normal(size=3)) * [corrupt, 1.0, 1.0]
    known = KnownRates(
        "pool", ("careful", "careless", "other"), pool, np.diag((claimed * truth) ** 2), np.ones(3, np.bool_)
    )
    block = WORLD.block("episode_mixture", maneuver)
    return replace(block, surrogates_crash=SURROGATES[:, maneuver].T, known_rates=known)


def test_replay_covers_and_saves():
    found = replicate(replayed, REPLICATIONS, 21, {"replay": Replay, "nade": Nade})
    truth = WORLD.crash_rate
    assert covers(found["replay"].covered(truth))
    assert found["replay"].true_relvar(truth, N) < 0.7 * found["nade"].true_relvar(truth, N)
    assert found["replay"].true_relvar(truth, N) == pytest.approx(found["replay"].claimed_relvar(truth, N), rel=0.25)


def test_a_corrupted_rate_does_not_cover_and_raises_the_alarm():
    wrong = replicate(lambda rng: replayed(rng, corrupt=1.3), REPLICATIONS, 22, {"replay": Replay})["replay"]
    assert not covers(wrong.covered(WORLD.crash_rate))
    for corrupt, raised in ((1.0, False), (1.3, True)):
        alarm = Alarm()
        alarm.add(replayed(np.random.default_rng(SEED), corrupt=corrupt, n=20_000))
        assert alarm.result()["raised"] == raised


def test_surrogates_of_rare_traffic_are_left_out():
    block = replayed(np.random.default_rng(SEED))
    assert block.known_rates is not None
    assert block.surrogates_crash is not None
    kept = np.array([True, True, False])
    known = block.known_rates
    fewer = KnownRates("pool", known.names[:2], known.mu[:2], known.covariance[:2, :2], np.ones(2, np.bool_))
    left_out, absent = Replay(), Replay()
    left_out.add(replace(block, known_rates=replace(known, ordinary=kept)))
    absent.add(replace(block, surrogates_crash=block.surrogates_crash[:, :2], known_rates=fewer))
    one, other = left_out.result(CONFIDENCE), absent.result(CONFIDENCE)
    assert (one.crash_rate, one.ci_low, one.ci_high) == (other.crash_rate, other.ci_low, other.ci_high)
    assert one.details["beta"] == {**other.details["beta"], "other": 0.0}


def test_a_pool_said_to_be_exact_covers_too_little():
    """The error of μ must be in the interval, and must keep β small where it is large."""
    make = {"replay": Replay}
    right = replicate(lambda rng: replayed(rng, error=0.1, claimed=0.1), REPLICATIONS, 23, make)["replay"]
    wrong = replicate(lambda rng: replayed(rng, error=0.1, claimed=1e-6), REPLICATIONS, 23, make)["replay"]
    assert covers(right.covered(WORLD.crash_rate))
    assert not covers(wrong.covered(WORLD.crash_rate))


def test_the_alarm_is_rarely_false():
    """At a level of 1e-4 each of two tests, 400 campaigns raise it twice with a probability of 0.3 %."""
    raised = 0
    for k in range(REPLICATIONS):
        alarm = Alarm()
        alarm.add(replayed(np.random.default_rng([SEED, k])))
        raised += alarm.result()["raised"]
    assert raised < 2


@pytest.mark.parametrize("method", MIXTURES)
@pytest.mark.parametrize("chain", [*panel()[:2], frequent_decisive()], ids=lambda c: c.name)
def test_martingale_sums_have_mean_zero(chain, method):
    sums = draw(chain, method, 100_000, np.random.default_rng(SEED)).martingale
    assert np.all(np.abs(sums.mean(0)) < 4.0 * sums.std(0) / np.sqrt(len(sums)))


@pytest.mark.parametrize("chain", [panel()[1], frequent_decisive()], ids=lambda c: c.name)
def test_the_weights_of_the_mixture_instead_of_the_posterior_are_caught(chain):
    sums = draw(chain, "episode_mixture", 100_000, np.random.default_rng(SEED), stale_posterior=True).martingale
    assert np.max(np.abs(sums.mean(0)) / (sums.std(0) / np.sqrt(len(sums)))) > 7.0


@pytest.mark.parametrize("method", MIXTURES)
def test_martingale_covers_on_a_chain(method):
    chain = frequent_decisive()
    found = replicate(lambda rng: draw(chain, method, N, rng), REPLICATIONS, 24, {"terms": Martingale, "nade": Nade})
    assert covers(found["terms"].covered(chain.crash_rate))
    if method == "episode_mixture":
        assert found["terms"].true_relvar(chain.crash_rate, N) < found["nade"].true_relvar(chain.crash_rate, N)


def test_stale_posteriors_do_not_cover():
    """Sums of the wrong mean shift the estimate."""
    chain = frequent_decisive()
    wrong = replicate(
        lambda rng: draw(chain, "episode_mixture", 10 * N, rng, stale_posterior=True), 60, 25, {"terms": Martingale}
    )["terms"]
    assert binomtest(wrong.covered(chain.crash_rate), 60, CONFIDENCE).pvalue < FALSE_ALARM


@pytest.mark.parametrize(("n", "wide"), [(300, True), (20_000, False)])
def test_martingale_terms_claim_nothing_below_three_hundred_effective_crashes(n, wide):
    drawn = draw(frequent_decisive(), "episode_mixture", n, np.random.default_rng(SEED))
    state, plain = Martingale(), Nade()
    state.add(drawn)
    plain.add(drawn)
    found, mean = state.result(CONFIDENCE), plain.result(CONFIDENCE)
    assert found.details["residual_std_error"] < mean.std_error
    assert found.std_error == (mean.std_error if wide else found.details["residual_std_error"])
    assert (mean.n_effective < 300.0) == wide
    assert mean.n_crashes > 50


def test_few_crashes_get_the_interval_of_the_plain_mean():
    few = replayed(np.random.default_rng(SEED), n=60)
    state, plain = Replay(), Nade()
    state.add(few)
    plain.add(few)
    found = state.result(CONFIDENCE)
    assert found.std_error >= plain.result(CONFIDENCE).std_error
    assert PLAIN.format(what="crashes, or disagreements with the surrogates,") in found.warnings
    many = Replay()
    many.add(replayed(np.random.default_rng(SEED)))
    assert RESIDUALS in many.result(CONFIDENCE).warnings
