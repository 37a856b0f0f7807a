"""Arrow tables into blocks: the same numbers come back, and damaged tables name the place."""

import numpy as np
import pyarrow as pa
import pytest

from harness.errors import RunFolderError
from harness.estimators.block import block_from_tables
from harness.vocabulary import FAILED
from studies.chains.chain import overtaking
from studies.chains.sampler import draw
from tests.chains.seed import SEED

from .run_folder import episodes_table, moments_table

CHAIN = overtaking("ten steps", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=11)


def drawn(method: str):
    return draw(CHAIN, method, 400, np.random.default_rng(SEED), first_episode=1_000)


def read(block, *, episodes=None, moments=None):
    episodes = episodes_table(block) if episodes is None else episodes
    return block_from_tables(episodes, moments, method=block.drawn.method, alpha=block.drawn.alpha)


@pytest.mark.parametrize("method", ["nde", "forced", "step_mixture", "episode_mixture"])
def test_a_block_survives_the_records(method):
    block = drawn(method)
    moments = moments_table(block) if method == "step_mixture" else None
    back = read(block, moments=moments)
    assert back.first_episode == 1_000
    assert back.columns.keys() == block.columns.keys()
    for name in ("outcome", "log_weight", "cut_in", "log_q", "n_control_steps"):
        np.testing.assert_array_equal(getattr(back, name), getattr(block, name))
    for name in {"first_ratios", "log_p_cut_in"} & back.columns.keys():
        np.testing.assert_allclose(back.columns[name], block.columns[name], rtol=1e-15)
    np.testing.assert_array_equal(back.drawn.alpha, block.drawn.alpha)
    assert back.drawn.weight_cap == (1.0 if method == "nde" else None)


def test_all_control_steps_on_record_are_cut_to_the_first_nine():
    block = drawn("step_mixture")
    at = int(np.argmax(block.n_control_steps > 9))
    moments = moments_table(block)
    end = int(np.searchsorted(moments["episode"].to_numpy(), 1_000 + at, side="right"))
    tenth = moments.slice(end - 1, 1)
    back = read(block, moments=pa.concat_tables([moments.slice(0, end), tenth, tenth, moments.slice(end)]))
    np.testing.assert_allclose(back.first_ratios, block.first_ratios, rtol=1e-15)


def test_a_failed_episode_may_lack_its_weight_and_its_moments():
    block = drawn("step_mixture")
    failed = np.zeros(400, dtype=bool)
    failed[np.argmax(~block.crash)] = True
    at = int(np.argmax(failed))
    table = episodes_table(block.ending(failed, FAILED))
    weights = block.log_weight.copy()
    weights[at] = np.nan
    column = table.schema.get_field_index("log_weight")
    table = table.set_column(column, table.schema.field(column), pa.array(weights))
    moments = moments_table(block)
    moments = moments.filter(pa.array(moments["episode"].to_numpy() != 1_000 + at))
    back = read(block, episodes=table, moments=moments)
    assert back.failed[at]
    assert back.log_weight[at] == 0.0
    assert np.all(back.first_ratios[at] == 1.0)


def damaged(change: str):
    block = drawn("step_mixture")
    episodes, moments = episodes_table(block), moments_table(block)
    if change == "gap":
        episodes = pa.concat_tables([episodes.slice(0, 10), episodes.slice(11)])
    elif change == "empty":
        episodes = episodes.slice(0, 0)
    elif change == "weight":
        nan = pa.array(np.where(np.arange(400) == 5, np.nan, block.log_weight))
        column = episodes.schema.get_field_index("log_weight")
        episodes = episodes.set_column(column, episodes.schema.field(column), nan)
    elif change == "moments":
        moments = moments.slice(0, moments.num_rows - 1)
    elif change == "order":
        moments = moments.take(pa.array(np.arange(moments.num_rows)[::-1]))
    return episodes, moments, block


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("gap", "row 10: found episode 1011 after episode 1009"),
        ("empty", "no rows"),
        ("weight", "episode 1005: found log_weight nan"),
        ("moments", "moments, episode 1399: found"),
        ("order", "in order"),
    ],
)
def test_damaged_tables_name_the_place(change, text):
    episodes, moments, block = damaged(change)
    with pytest.raises(RunFolderError, match=text):
        read(block, episodes=episodes, moments=moments)


def test_records_of_another_campaign_are_refused():
    block = drawn("step_mixture")
    with pytest.raises(RunFolderError, match="column log_q"):
        block_from_tables(episodes_table(block), None, method="step_mixture", alpha=[0.2, 0.3, 0.5])
