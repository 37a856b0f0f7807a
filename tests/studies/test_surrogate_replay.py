"""Surrogates in the place of the AV: the same crashes where they are the AV, and the pool's rates where they are not.

Four standard errors miss with a probability of 6e-5 per surrogate and method.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import IDMParameters, Reaction
from harness.campaign.sections import PoolSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.episode.loop import Shard
from harness.estimators.block import Block, block_from_tables
from harness.importance.functions import mixture_weights
from harness.pool.build import campaign_pool
from harness.pool.cut_ins import Pool
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import CRASH, BoolArray
from harness.worlds.twin import TwinWorld
from studies.alarm import Alarm, KnownRates, drivers_crash, surrogates_crash
from tests.chains.seed import SEED

SMALL = PoolSettings(relative_error=0.03, cut_ins_per_shell=1500)
N = 10_000
LATE = AutomatedVehicle(parameters=IDMParameters(min_acceleration_mps2=-3.0), reaction=Reaction(delay_s=0.7))


def campaign(method: str, **settings) -> Campaign:
    plain = Campaign(name="replayed", seed=SEED, pool=SMALL, av=settings.pop("av", AutomatedVehicle()))
    environment = plain.environment.model_copy(update=settings)
    testing = plain.testing.model_copy(update={"method": method})
    return plain.model_copy(update={"environment": environment, "testing": testing})


def drive(campaign: Campaign, n: int = N) -> tuple[Shard, pa.Table]:
    ready = prepare(resolve(campaign))
    shard = ready.loop(TwinWorld(256)).run(0, ready.states(0, n))
    return shard, episodes_table(shard, campaign.seed)


def replayed(campaign: Campaign, table: pa.Table, pool: Pool) -> tuple[Block, BoolArray]:
    """The episodes, and which surrogates would have crashed in them."""
    method = campaign.testing.method
    block = block_from_tables(table, None, method=method, alpha=mixture_weights(campaign))
    return block, surrogates_crash(table, resolve(campaign), pool)


def alarmed(campaign: Campaign, table: pa.Table, pool: Pool, wrong: float = 1.0) -> dict[str, Any]:
    """What the alarm says of episodes whose weights are all wrong by a factor."""
    block, crashes = replayed(campaign, table, pool)
    alarm = Alarm(KnownRates.of(pool))
    alarm.add(replace(block, log_weight=block.log_weight + np.log(wrong)), crashes)
    return alarm.result()


@pytest.fixture(scope="module")
def forced() -> tuple[Campaign, pa.Table, Pool]:
    one = campaign("forced", av=LATE)
    return one, drive(one)[1], campaign_pool(resolve(one))


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
    never = AutomatedVehicle(model="constant")
    one = campaign("forced", av=never, acceleration_hold_s=hold_s)
    shard, table = drive(one, 400)
    other = campaign("forced", av=AutomatedVehicle(), acceleration_hold_s=hold_s)
    _, longer = drive(other, 400)
    environment = resolve(one).environment
    followers = resolve(one).library.followers(environment.lateral.present)
    short, long = (drivers_crash(paths, one.seed, environment, followers) for paths in (table, longer))
    assert np.count_nonzero(shard.results.episode["outcome"] == CRASH) > 100
    np.testing.assert_array_equal(short, long)


@pytest.mark.parametrize(
    ("method", "settings", "n"),
    [("nde", {"lane_change_level": 1e5}, 4 * N), ("forced", {}, 2 * N), ("episode_mixture", {}, 2 * N)],
)
def test_weighted_crashes_of_surrogates_have_the_rates_of_the_pool(method, settings, n):
    one = campaign(method, **settings)
    pool = campaign_pool(resolve(one))
    asked = one, drive(one, n)[1], pool
    (block, crashes), found = replayed(*asked), alarmed(*asked)
    h = crashes * block.weights()[:, None]
    error = np.sqrt(h.var(axis=0) / n + np.diag(pool.mu_covariance))
    many = np.array([entry["n_effective"] for entry in found["surrogates"]]) >= 100.0
    assert np.count_nonzero(many) >= 5
    assert np.max(np.abs(h.mean(axis=0) - pool.mu)[many] / error[many]) < 4.0
    assert not found["raised"]


@pytest.mark.parametrize("wrong", [0.7, 1.25])
def test_weights_that_are_all_wrong_raise_the_alarm(forced, wrong):
    assert alarmed(*forced, wrong)["raised"]
