"""The three tables: committed schemas with units, one row per episode, null for what there is none of."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from harness.records.folder import encoded, read_table, write_shard
from harness.records.schemas import episodes_schema, moments_schema, traces_schema
from harness.vocabulary import OUTCOMES

METHODS = {"nde": (0, 0), "forced": (1, 0), "step_mixture": (3, 3), "episode_mixture": (4, 3)}
"""Method → numbers of importance functions and of surrogates."""


@pytest.fixture(scope="module")
def mixture(record):
    return record("records.traces=all", "records.moments=all", first=1000)


@pytest.mark.parametrize("method", METHODS)
def test_written_files_have_the_committed_schemas_with_units(method, record, tmp_path):
    recorded = record(f"testing.method={method}", "records.traces=all", n=40)
    files = write_shard(tmp_path, 3, encoded(recorded.tables))
    n_importance, n_surrogates = METHODS[method]
    expected = {
        "episodes": episodes_schema(n_importance, n_surrogates),
        "moments": moments_schema(n_surrogates),
        "traces": traces_schema(),
    }
    assert files == {name: f"{name}/shard-000003.parquet" for name in expected}
    for name, schema in expected.items():
        stored = pq.read_table(tmp_path / files[name], partitioning=None)
        # Parquet calls the entries of a list "element", Arrow "item": metadata are compared field by field.
        assert stored.schema.equals(schema)
        for field in stored.schema:
            assert field.metadata == schema.field(field.name).metadata
            assert set(field.metadata) == {b"unit", b"doc"}
            assert field.metadata[b"doc"]
        assert pq.ParquetFile(tmp_path / files[name]).metadata.row_group(0).column(0).compression == "ZSTD"
        stored.validate(full=True)


@pytest.mark.parametrize("schema", [episodes_schema(4, 3), moments_schema(3), traces_schema()])
def test_names_with_a_unit_carry_that_unit(schema):
    units = {"_mps": b"m/s", "_m": b"m", "_s": b"s", "_mps2": b"m/s2"}
    for field in schema:
        suffix = "_" + field.name.rsplit("_", 1)[-1] if "_" in field.name else ""
        if suffix in units:
            assert field.metadata[b"unit"] == units[suffix], field.name


def test_one_row_per_episode_in_order(mixture):
    episodes = mixture.tables.episodes
    assert episodes["episode"].to_pylist() == list(range(1000, 1300))
    assert set(episodes["seed"].to_pylist()) == {mixture.campaign.seed}
    assert set(episodes["outcome"].to_pylist()) <= set(OUTCOMES)


def test_there_is_no_nan_and_no_infinity_but_the_logarithm_of_a_probability_of_zero(mixture):
    """A path without cut-in has probability 0 under the forced cut-in."""
    for table in mixture.tables:
        for name in table.column_names:
            column = table[name].combine_chunks()
            if pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
                column = column.flatten()
            if pa.types.is_floating(column.type):
                values = column.drop_null().to_numpy()
                allowed = np.isfinite(values) | ((name == "log_q") & (values == -np.inf))
                assert allowed.all(), name


def test_null_stands_for_what_there_is_none_of(mixture):
    rows = mixture.tables.episodes.to_pylist()
    crashed = [row["outcome"] == "crash" for row in rows]
    assert any(crashed)
    assert not all(crashed)
    for row in rows:
        cut_in, crash = row["cut_in_step"] is not None, row["outcome"] == "crash"
        assert (row["cut_in_r2_m"] is not None) == cut_in
        assert (row["cut_in_r2dot_mps"] is not None) == cut_in
        assert (row["crash_time_s"] is not None) == crash
        assert (row["impact_speed_mps"] is not None) == crash
        assert (row["failure"] is not None) == (row["outcome"] == "failed")
        if row["min_ttc_s"] is not None:
            assert cut_in
            assert row["min_ttc_s"] >= 0.0
        if crash:
            assert math.isclose(row["crash_time_s"], 0.1 * row["n_steps"])


def test_log_p_cut_in_is_null_where_the_path_is_not_drawn_ahead(record):
    tables = record("testing.method=step_mixture", n=20).tables
    assert tables.episodes["log_p_cut_in"].null_count == 20


def test_no_control_means_a_weight_of_exactly_one(record):
    rows = record(
        "testing.method=step_mixture", "testing.criticality_threshold=0.999", n=50
    ).tables.episodes.to_pylist()
    assert all(row["n_control_steps"] == 0 for row in rows)
    assert all(row["log_weight"] == 0.0 and row["log_q"] == [0.0, 0.0, 0.0] for row in rows)


def test_weights_follow_from_the_stored_parts(mixture):
    """Episode mixture: weight = 1 / sum of alpha_j exp(log_q_j)."""
    rows = mixture.tables.episodes.to_pylist()
    share = mixture.campaign.testing.defensive_share
    alpha = np.array([share, *((1.0 - share) * weight for weight in mixture.campaign.alpha())])
    for row in rows:
        mixed = np.dot(alpha, np.exp(row["log_q"]))
        assert math.isclose(row["log_weight"], -math.log(mixed), rel_tol=1e-9, abs_tol=1e-9)
        assert 0 <= row["component"] <= 3


# -- moments --


def test_first_nine_moments_are_the_first_nine_of_all(mixture, record):
    nine = record("records.moments=first_9", "records.traces=all", first=1000)
    everything, first = mixture.tables.moments.to_pylist(), nine.tables.moments.to_pylist()
    assert len(first) < len(everything)
    seen: dict[int, int] = {}
    expected = []
    for row in everything:
        seen[row["episode"]] = seen.get(row["episode"], 0) + 1
        if seen[row["episode"]] <= 9:
            expected.append(row)
    assert first == expected
    assert nine.tables.episodes.equals(mixture.tables.episodes)


def test_all_moments_are_as_many_as_control_steps(mixture):
    counted = dict.fromkeys(mixture.tables.episodes["episode"].to_pylist(), 0)
    order = []
    for row in mixture.tables.moments.select(["episode", "step"]).to_pylist():
        counted[row["episode"]] += 1
        order.append((row["episode"], row["step"]))
    assert list(counted.values()) == mixture.tables.episodes["n_control_steps"].to_pylist()
    assert order == sorted(order)


def test_no_moments_leave_no_table(record):
    recorded = record("records.moments=none", "records.traces=none", n=20)
    assert recorded.tables.moments is None
    assert recorded.tables.traces is None


def test_records_kept_change_nothing_else(mixture, record):
    bare = record("records.moments=none", "records.traces=none", first=1000)
    assert bare.tables.episodes.equals(mixture.tables.episodes)


# -- reading back --


def test_what_is_read_is_what_was_written(mixture, tmp_path):
    files = write_shard(tmp_path, 0, encoded(mixture.tables))
    for name, table in mixture.tables._asdict().items():
        assert read_table(tmp_path / files[name]).equals(table)
    assert read_table(tmp_path / files["episodes"], ["log_weight"]).column_names == ["log_weight"]
