"""Surrogates in the place of the AV crash, weighted, as the pool says: weights, traffic, twin and pool belong together.

Stored maneuvers determine LV's and BV's motion: weighted, crashes have the surrogate's rate, whatever tests were drawn
from, if no crash of the AV has cut them short. Four standard errors miss with a probability of 6e-5 per surrogate and
method.
"""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.estimators.block import Block, block_from_tables
from harness.families.cut_in.family import CUT_IN
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
    nowhere = np.full((len(rows), 2), np.nan)
    crashes = np.zeros((len(happened), len(drivers)), bool)
    crashes[happened] = CUT_IN.drive(resolved.environment, chosen, nowhere, drivers).end >= 0
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


@pytest.mark.parametrize(
    ("method", "level", "n"), [("nde", 1e5, 4 * N), ("forced", 1.0, 2 * N), ("episode_mixture", 1.0, 2 * N)]
)
def test_weighted_crashes_of_surrogates_have_the_rates_of_the_pool(method, level, n):
    hardly = "av={model: idm, parameters: {min_acceleration_mps2: -9}}"  # it hardly crashes
    one = campaign(method, f"environment.lane_change_level={level}", hardly)
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
