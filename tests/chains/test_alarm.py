"""The alarm on an exact world: rarely false, and raised where a surrogate's rate is wrong. Seeds are fixed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from harness.estimators.alarm import Alarm
from harness.estimators.block import Block
from harness.strata import KnownRates
from harness.studies.chains.single_choice import SingleChoice

from .seed import SEED

REPLICATIONS = 400
N = 2_000

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


def replayed(rng: np.random.Generator, *, corrupt: float = 1.0, n: int = N) -> Block:
    """Tests with surrogates whose rates come from a pool of its own in every replication."""
    maneuver = WORLD.maneuvers(n, rng)
    truth = SURROGATES @ WORLD.p
    pool = truth * (1.0 + ERROR * rng.normal(size=3)) * [corrupt, 1.0, 1.0]
    known = KnownRates("pool", ("careful", "careless", "other"), pool, np.diag((ERROR * truth) ** 2))
    block = WORLD.block("episode_mixture", maneuver)
    return replace(block, surrogates_crash=SURROGATES[:, maneuver].T, known_rates=known)


def test_a_corrupted_rate_raises_the_alarm():
    for corrupt, raised in ((1.0, False), (1.3, True)):
        alarm = Alarm()
        alarm.add(replayed(np.random.default_rng(SEED), corrupt=corrupt, n=20_000))
        assert alarm.result()["raised"] == raised


def test_the_alarm_is_rarely_false():
    """At a level of 1e-4 each of two tests, 400 campaigns raise it twice with a probability of 0.3 %."""
    raised = 0
    for k in range(REPLICATIONS):
        alarm = Alarm()
        alarm.add(replayed(np.random.default_rng([SEED, k])))
        raised += alarm.result()["raised"]
    assert raised < 2
