"""Blocks, and Arrow tables into them: the same numbers come back, and damaged tables name the place."""

import numpy as np
import pyarrow as pa
import pytest

from harness.errors import RunFolderError
from harness.estimators.block import Block, block_from_tables
from harness.records.schemas import episodes_schema, moments_schema
from harness.vocabulary import FAILED, OUTCOMES
from studies.chains.chain import overtaking
from studies.chains.sampler import draw
from tests.chains.seed import SEED
from tests.estimators.small_blocks import block as made

CHAIN = overtaking("ten steps", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=11)


def episodes_table(block: Block) -> pa.Table:
    """The rows of an ``episodes`` shard; columns that estimates do not read are left out."""
    n, m = block.log_q.shape
    index = block.first_episode + np.arange(n)
    columns = {
        "episode": pa.array(index),
        "outcome": pa.DictionaryArray.from_arrays(pa.array(block.outcome), pa.array(OUTCOMES)),
        "cut_in_step": pa.array(np.full(n, 7, dtype=np.int16), mask=~block.cut_in),
        "n_control_steps": pa.array(block.n_control_steps.astype(np.int16)),
        "log_weight": pa.array(block.log_weight),
        "log_p_cut_in": pa.array(block.log_p_cut_in) if "log_p_cut_in" in block.columns else pa.nulls(n, pa.float64()),
        "log_q": pa.array(block.log_q.tolist(), pa.list_(pa.float64(), m)),
    }
    schema = episodes_schema(m, 2)
    return pa.table(columns, schema=pa.schema([schema.field(name) for name in columns]))


def moments_table(block: Block) -> pa.Table:
    """Control steps of a ``moments`` shard under the policy ``first_9``, with q_sampled = 1/2 throughout."""
    ratios, steps = block.first_ratios, np.minimum(block.n_control_steps, 9)
    used = np.arange(9) < steps[:, None]
    q = 0.5 * ratios[used]
    columns = {
        "episode": pa.array(np.repeat(block.first_episode + np.arange(len(block)), steps)),
        "q_sampled": pa.array(np.full(len(q), 0.5)),
        "q": pa.FixedSizeListArray.from_arrays(pa.array(q.ravel()), q.shape[1]),
    }
    schema = moments_schema(q.shape[1])
    return pa.table(columns, schema=pa.schema([schema.field(name) for name in columns]))


def drawn(method: str):
    return draw(CHAIN, method, 400, np.random.default_rng(SEED), first_episode=1_000)


def read(block, *, episodes=None, moments=None):
    episodes = episodes_table(block) if episodes is None else episodes
    return block_from_tables(episodes, moments, method=block.drawn.method, alpha=block.drawn.alpha)


def without(table: pa.Table, row: int) -> pa.Table:
    return pa.concat_tables([table.slice(0, row), table.slice(row + 1)])


def without_weight(episodes: pa.Table, row: int) -> pa.Table:
    weights = episodes["log_weight"].to_numpy().copy()
    weights[row] = np.nan
    column = episodes.schema.get_field_index("log_weight")
    return episodes.set_column(column, episodes.schema.field(column), pa.array(weights))


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
    moments = moments_table(block)
    moments = moments.filter(pa.array(moments["episode"].to_numpy() != 1_000 + at))
    back = read(block, episodes=without_weight(episodes_table(block.ending(failed, FAILED)), at), moments=moments)
    assert back.failed[at]
    assert back.log_weight[at] == 0.0
    assert np.all(back.first_ratios[at] == 1.0)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (lambda episodes, moments: (without(episodes, 10), moments), "row 10: found episode 1011 after episode 1009"),
        (lambda episodes, moments: (episodes.slice(0, 0), moments), "no rows"),
        (lambda episodes, moments: (without_weight(episodes, 5), moments), "episode 1005: found log_weight nan"),
        (lambda episodes, moments: (episodes, moments.slice(0, len(moments) - 1)), "moments, episode 1399: found"),
        (lambda episodes, moments: (episodes, moments.take(pa.array(range(len(moments))[::-1]))), "in order"),
    ],
)
def test_damaged_tables_name_the_place(damage, text):
    block = drawn("step_mixture")
    episodes, moments = damage(episodes_table(block), moments_table(block))
    with pytest.raises(RunFolderError, match=text):
        read(block, episodes=episodes, moments=moments)


def test_weighted_crashes_and_ratios():
    some = made([True, False], [-1.0, -2.0], log_q=np.array([[1.0, -np.inf], [2.0, 0.0]]))
    np.testing.assert_allclose(some.weighted_crashes(), [np.exp(-1.0), 0.0])
    np.testing.assert_allclose(some.mixture_ratios(), [[1.0, 0.0], [1.0, np.exp(-2.0)]])


def test_take_keeps_indices_right():
    some = made([True, False, True], first_episode=40, first_ratios=np.ones((3, 9, 2)))
    part = some.take(slice(1, 3))
    assert (part.first_episode, part.crash.tolist(), part.first_ratios.shape) == (41, [False, True], (2, 9, 2))


@pytest.mark.parametrize(
    ("change", "text"), [({"log_q": np.zeros((2, 5))}, "log_q has shape"), ({"log_weight": [0.0, np.nan]}, "NaN")]
)
def test_contradictions_are_refused(change, text):
    with pytest.raises(ValueError, match=text):
        made([True, False], **change)
