"""Surrogates in the place of the AV crash, weighted, as the pool says: weights, traffic, twin and pool belong together.

Stored maneuvers determine LV's and BV's motion; where the AV's crash ended a test early, BV goes on under p with the
test's own random numbers: weighted, crashes have the surrogate's rate, whatever tests were drawn from. Four standard
errors miss with a probability of 6e-5 per surrogate and method.
"""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.compiled import unboxed
from harness.estimators.block import Block, block_from_tables
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_in.path import empty_trajectory
from harness.families.cut_in.replay import StoredPaths, drive_others
from harness.families.cut_in.script import maneuvers_of, states_of
from harness.families.protocol import Driven
from harness.pool.build import campaign_pool
from harness.pool.shells import Pool
from harness.records.schemas import chosen_from, episodes_table
from harness.resolved import Resolved, resolve
from harness.sampling import prepare
from harness.vocabulary import BoolArray
from harness.worlds.twin import TwinWorld
from tests.chains import SEED
from tests.pool.conftest import SMALL_POOL
from tests.stored_runs import MIXTURE_FILE

pytestmark = pytest.mark.slow


N = 10_000
LATE = "av={model: idm, parameters: {min_acceleration_mps2: -3}, reaction: {delay_s: 0.7}}"


def campaign(method: str, *more: str) -> Campaign:
    return load_campaign(MIXTURE_FILE, [f"testing.method={method}", f"seed={SEED}", *SMALL_POOL, *more])


def drive(campaign: Campaign, n: int = N) -> pa.Table:
    ready = prepare(resolve(campaign))
    return episodes_table(ready.loop(TwinWorld(256)).run(0, ready.tests(0, n)), campaign.seed)


def drivers_crash(episodes: pa.Table, resolved: Resolved) -> BoolArray:
    """Which drivers of the library would have crashed in the place of the AV, shape (n, D)."""
    touched = np.asarray(pc.equal(episodes.column("outcome").cast(pa.string()), "bv_lv_contact"))
    happened = (chosen_from(episodes, CUT_IN).at >= 0) & ~touched
    rows = episodes.filter(pa.array(happened))
    chosen, drivers = (
        chosen_from(rows, CUT_IN),
        resolved.library.followers(resolved.environment.lateral.present).drivers,
    )
    index, n_steps = (np.asarray(rows.column(name)).astype(np.int64) for name in ("episode", "n_steps"))
    facts = states_of(chosen.facts), n_steps, chosen.at, maneuvers_of(chosen)
    out = Driven(np.zeros((len(index), len(drivers)), np.int64), np.zeros((0, 0, 0)), np.zeros((0, 0)))
    room, nowhere = empty_trajectory(resolved.environment), np.full((len(index), 2), np.nan)
    paths = unboxed(StoredPaths(resolved.campaign.seed, index, *facts))
    drive_others(paths, nowhere, unboxed(resolved.environment), drivers, unboxed(room), unboxed(out))
    crashes = np.zeros((len(happened), len(drivers)), bool)
    crashes[happened] = out.end >= 0
    return crashes


def replayed(campaign: Campaign, table: pa.Table, pool: Pool) -> tuple[Block, BoolArray]:
    """The episodes, and which surrogates would have crashed in them."""
    names = list(pool.library.surrogates)
    crashes = drivers_crash(table, resolve(campaign))[:, [names.index(name) for name in pool.names]]
    return block_from_tables(campaign, table), crashes


@pytest.fixture(scope="module")
def forced() -> tuple[Campaign, pa.Table, Pool]:
    one = campaign("forced", LATE)
    return one, drive(one), campaign_pool(resolve(one))


@pytest.mark.parametrize("hold_s", [1.0, 0.1])
def test_other_draws_after_the_end_do_not_change_what_was_driven(hold_s):
    """The AV never brakes: its crashes cut the paths short, and careful surrogates need what comes after."""
    one, other = (
        campaign("forced", f"environment.acceleration_hold_s={hold_s}", av)
        for av in ("av.model=constant", "av.model=idm")
    )
    tables = [drive(each, 400) for each in (one, other)]
    short, long = (drivers_crash(paths, resolve(one)) for paths in tables)
    assert tables[0].column("outcome").to_pylist().count("crash") > 100
    np.testing.assert_array_equal(short, long)


@pytest.mark.parametrize(
    ("method", "level", "n"), [("nde", 1e5, 4 * N), ("forced", 1.0, 2 * N), ("episode_mixture", 1.0, 2 * N)]
)
def test_weighted_crashes_of_surrogates_have_the_rates_of_the_pool(method, level, n):
    one = campaign(method, f"environment.lane_change_level={level}")
    pool = campaign_pool(resolve(one))
    assert furthest(*replayed(one, drive(one, n), pool), pool) < 4.0


def furthest(block: Block, crashes: BoolArray, pool: Pool) -> float:
    """Distance of a weighted rate from the pool's, in standard errors, of surrogates that crash often enough."""
    h = crashes * block.weights()[:, None]
    error = np.sqrt(h.var(axis=0) / len(block) + np.diag(pool.mu_covariance))
    many = h.sum(axis=0) ** 2 >= 100.0 * (h * h).sum(axis=0)
    assert np.count_nonzero(many) >= 4
    return float(np.max(np.abs(h.mean(axis=0) - pool.mu)[many] / error[many]))


@pytest.mark.parametrize("wrong", [0.5, 2.0])
def test_weights_that_are_all_wrong_are_found_out(forced, wrong):
    block, crashes = replayed(*forced)
    assert furthest(replace(block, log_weight=block.log_weight + np.log(wrong)), crashes, forced[2]) > 4.0
    assert furthest(block, crashes, forced[2]) < 4.0
