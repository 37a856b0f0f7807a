"""The three tables: committed schemas with units, null for what there is none of; which episodes leave a trace."""

from __future__ import annotations

import math

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.episode.loop import traced_by_index
from harness.records.folder import encoded, read_table, write_shard
from harness.records.schemas import episodes_schema, moments_schema, traces_schema
from harness.vocabulary import AV

METHODS = {"nde": (0, 0), "forced": (1, 0), "step_mixture": (3, 3), "episode_mixture": (4, 3)}
"""Method → numbers of importance functions and of surrogates."""

UNITS = {"mps": b"m/s", "m": b"m", "s": b"s", "mps2": b"m/s2"}
"""Of names that end in it."""


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
            if (unit := UNITS.get(field.name.rpartition("_")[2])) and "_" in field.name:
                assert field.metadata[b"unit"] == unit, field.name
        assert pq.ParquetFile(tmp_path / files[name]).metadata.row_group(0).column(0).compression == "ZSTD"
        stored.validate(full=True)
        assert read_table(tmp_path / files[name]).equals(getattr(recorded.tables, name))


def test_null_stands_for_what_there_is_none_of(mixture):
    rows = mixture.tables.episodes.to_pylist()
    crashed = [row["outcome"] == "crash" for row in rows]
    assert any(crashed)
    assert not all(crashed)
    for row in rows:
        cut_in, crash = row["cut_in_step"] is not None, row["outcome"] == "crash"
        for names, there in (
            (("cut_in_r2_m", "cut_in_r2dot_mps"), cut_in),
            (("crash_time_s", "impact_speed_mps"), crash),
        ):
            assert [row[name] is not None for name in names] == [there] * 2
        assert (row["failure"] is not None) == (row["outcome"] == "failed")
        if row["min_ttc_s"] is not None:
            assert cut_in
            assert row["min_ttc_s"] >= 0.0
        if crash:
            assert math.isclose(row["crash_time_s"], 0.1 * row["n_steps"])


def test_all_moments_are_as_many_as_control_steps(mixture):
    counted = dict.fromkeys(mixture.tables.episodes["episode"].to_pylist(), 0)
    order = []
    for row in mixture.tables.moments.select(["episode", "step"]).to_pylist():
        counted[row["episode"]] += 1
        order.append((row["episode"], row["step"]))
    assert list(counted.values()) == mixture.tables.episodes["n_control_steps"].to_pylist()
    assert order == sorted(order)


def test_records_kept_change_nothing_else(mixture, record):
    """And of moments the first few are the first of all."""
    bare, nine = (record(f"records.moments={kept}", "records.traces=none", first=1000) for kept in ("none", "first_9"))
    assert bare.tables[1:] == (None, None)
    assert bare.tables.episodes.equals(nine.tables.episodes)
    assert bare.tables.episodes.equals(mixture.tables.episodes)
    everything = mixture.tables.moments.to_pandas()
    expected = everything.groupby("episode", sort=False).head(9)
    first = nine.tables.moments.to_pandas()
    assert len(first) < len(everything)
    assert first[["episode", "step", "p"]].to_numpy().tolist() == expected[["episode", "step", "p"]].to_numpy().tolist()


def traced(recorded) -> list[int]:
    return sorted(set(recorded.tables.traces["episode"].to_pylist()))


@pytest.mark.parametrize(
    ("policy", "wanted"),
    [
        ("all", lambda row: True),
        ("crash", lambda row: row["outcome"] == "crash"),
        ("critical", lambda row: row["outcome"] == "crash" or row["n_control_steps"] > 0),
    ],
)
def test_the_policy_says_which(policy, wanted, record):
    sometimes_critical = ("testing.method=step_mixture", "testing.criticality_threshold=3e-7")
    recorded = record(f"records.traces={policy}", *sometimes_critical, n=400)
    assert traced(recorded) == [row["episode"] for row in recorded.tables.episodes.to_pylist() if wanted(row)]
    if policy != "all":
        assert 0 < len(traced(recorded)) < 400


def test_a_share_is_chosen_by_index_whatever_the_outcome(record):
    share = ("records.traces=none", "records.trace_share=0.2")
    mixture = record(*share, n=400)
    natural = record(*share, "testing.method=nde", n=400)
    brave = record(*share, "av.parameters.min_acceleration_mps2=-8", n=400)
    assert traced(mixture) == traced(natural) == traced(brave)
    assert 40 < len(traced(mixture)) < 120
    outcomes = set(mixture.tables.episodes.take(traced(mixture))["outcome"].to_pylist())
    assert outcomes >= {"crash", "timeout"}


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
def test_the_share_is_the_share_and_another_seed_chooses_others(share):
    index = np.arange(200_000)
    chosen = traced_by_index(1, index, share)
    assert abs(chosen.mean() - share) < 5 * np.sqrt(share * (1 - share) / index.size) + 1e-12
    if 0.0 < share < 1.0:
        other = traced_by_index(2, index, share)
        assert abs((chosen & other).mean() - share**2) < 0.005


def test_a_trace_tells_the_same_story_as_its_row(record):
    recorded = record("records.traces=all", n=200)
    traces, lengths = recorded.tables.traces, recorded.tables.episodes["n_steps"].to_pylist()
    assert traces["a_mps2"].null_count == 3 * 200  # the last step commands nothing
    assert traces["step"].to_pylist() == [step for n in lengths for step in range(n + 1) for _ in range(3)]
    assert traces["vehicle"].to_pylist() == ["LV", "BV", "AV"] * (traces.num_rows // 3)
    table = {name: traces[name].to_numpy(zero_copy_only=False) for name in ("episode", "step", "x_m", "v_mps", "lane")}
    for row in recorded.tables.episodes.to_pylist():
        mine = table["episode"] == row["episode"]
        x, v, lane = (table[name][mine].reshape(-1, 3) for name in ("x_m", "v_mps", "lane"))
        assert x[-1, AV] - x[0, AV] == row["av_distance_m"]
        assert v[0, 1] == row["v_bv_mps"]
        np.testing.assert_allclose(x[0, 0] - 5.0 - x[0, 1], row["r1_m"], atol=1e-9)
        np.testing.assert_allclose(x[0, 1] - 5.0 - x[0, 2], row["r2_m"], atol=1e-9)
        if row["outcome"] == "crash":
            assert x[-1, 1] - 5.0 - x[-1, 2] < -0.001 <= x[-2, 1] - 5.0 - x[-2, 2]
            assert v[-1, 2] - v[-1, 1] == row["impact_speed_mps"]
        if row["cut_in_step"] is not None:
            cut = row["cut_in_step"]
            assert (lane[: cut + 1, 1] == 1).all()
            assert (lane[cut + 1 :, 1] == 0).all()
            assert x[cut, 1] - 5.0 - x[cut, 2] == row["cut_in_r2_m"]
        assert (lane[:, 0] == 1).all()
        assert (lane[:, 2] == 0).all()
