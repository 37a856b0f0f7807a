"""Blocks, and Arrow tables into them: what the rows say, and damaged tables name the place."""

import numpy as np
import pyarrow as pa
import pytest

from harness.errors import RunFolderError
from harness.estimators.block import block_from_tables
from harness.vocabulary import OUTCOMES
from tests.stored_runs import golden, stored_table

NAME = "step-recursive-twin"


def read(episodes, moments=None, name=NAME):
    return block_from_tables(golden(name), episodes, moments)


@pytest.fixture
def tables(stored_run):
    return stored_table(stored_run(NAME), "episodes"), stored_table(stored_run(NAME), "moments")


def without(table: pa.Table, row: int) -> pa.Table:
    return pa.concat_tables([table.slice(0, row), table.slice(row + 1)])


def of_others(moments: pa.Table, episode: int) -> pa.Table:
    return moments.filter(pa.array(moments["episode"].to_numpy() != episode))


def with_value(episodes: pa.Table, name: str, row: int, value: object) -> pa.Table:
    values, at = episodes[name].to_pylist(), episodes.schema.get_field_index(name)
    column = pa.array([*values[:row], value, *values[row + 1 :]])
    return episodes.set_column(at, name, column.dictionary_encode() if name == "outcome" else column)


@pytest.mark.parametrize("name", ["nde-twin", "forced-twin", NAME, "mixture-twin"])
def test_a_block_holds_what_the_rows_say(name, stored_run):
    episodes = stored_table(stored_run(name), "episodes").slice(40)
    rows, found = episodes.to_pandas(), read(episodes, name=name)
    assert found.first_episode == 40
    assert [OUTCOMES[k] for k in found.outcome] == rows.outcome.tolist()
    np.testing.assert_array_equal(found.happened, rows.event_step.notna())
    if name in (NAME, "mixture-twin"):
        np.testing.assert_array_equal(found.log_q, np.stack(rows.log_q))
    for column in ("log_weight", "n_control_steps"):
        np.testing.assert_array_equal(getattr(found, column), rows[column])
    if "log_p_event" in found.columns:
        np.testing.assert_array_equal(found.columns["log_p_event"], rows.log_p_event.fillna(-np.inf))
    assert found.drawn.weight_cap == (1.0 if name == "nde-twin" else None)


def test_ratios_are_those_of_the_first_nine_control_steps(tables):
    found = read(*tables)
    assert found.n_control_steps.max() > 9
    expected = np.ones_like(found.first_ratios)
    for episode, steps in tables[1].to_pandas().groupby("episode"):
        ratios = np.stack(steps.q)[:9] / steps.q_sampled.to_numpy()[:9, None]
        expected[episode, : len(ratios)] = ratios
    np.testing.assert_allclose(found.first_ratios, expected, rtol=1e-15)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (lambda episodes, moments: (without(episodes, 10), moments), "row 10: found episode 11 after episode 9"),
        (lambda episodes, moments: (with_value(episodes, "log_weight", 5, np.nan), moments), "5: found log_weight nan"),
        (lambda episodes, moments: (episodes, of_others(moments, 100)), "moments, episode 100: found"),
        (lambda episodes, moments: (episodes, moments.take(pa.array(range(len(moments))[::-1]))), "in order"),
    ],
)
def test_damaged_tables_name_the_place(damage, text, tables):
    with pytest.raises(RunFolderError, match=text):
        read(*damage(*tables))


def test_a_failed_episode_may_lack_its_weight_and_its_moments(tables):
    episodes, moments = tables
    failed = with_value(with_value(episodes, "outcome", 7, "failed"), "log_weight", 7, float("nan"))
    found = read(failed, of_others(moments, 7))
    assert (found.failed[7], found.log_weight[7]) == (True, 0.0)
    assert np.all(found.first_ratios[7] == 1.0)
