"""The three tables: units, null for what there is none of; which episodes leave a trace, and what it tells."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import pytest

import harness
from harness.errors import RunFolderError
from harness.families.cut_in.family import CUT_IN, STATE_FACTS
from harness.loop.loop import hash_of_index
from harness.records.reader import by_kind
from harness.records.schemas import episodes_schema, moments_schema, traces_schema
from harness.vocabulary import AV
from tests.in_process import run_here
from tests.stored_runs import copy_of, edit, golden, manifest, stored_table

UNITS = {"mps": b"m/s", "m": b"m", "s": b"s", "mps2": b"m/s2"}
"""Of names that end in it."""
LATERAL = ["lead_steps", "onset_step", "onset_gap_m", "onset_rate_mps", "onset_ttc_s", "overlap_ttc_s", "contact"]
"""Columns where cut-ins take time."""


@pytest.mark.parametrize(
    "schema", [episodes_schema(CUT_IN.columns, 4, 3), moments_schema(STATE_FACTS, 3), traces_schema()]
)
def test_every_column_says_its_unit_and_what_it_is(schema):
    for field in schema:
        assert set(field.metadata) == {b"unit", b"doc"}
        assert field.metadata[b"doc"]
        if (unit := UNITS.get(field.name.rpartition("_")[2])) and "_" in field.name:
            assert field.metadata[b"unit"] == unit, field.name


@pytest.mark.parametrize("name", ["mixture-twin", "nde-twin", "forced-inattentive", "forced-failing-twin"])
def test_null_stands_for_what_there_is_none_of(name, stored_run):
    for row in stored_table(stored_run(name), "episodes").to_pylist():
        cut_in, crash = row["event_step"] is not None, row["outcome"] == "crash"
        there = {"event_gap_m": cut_in, "event_rate_mps": cut_in, "crash_time_s": crash, "impact_speed_mps": crash}
        assert {column: row[column] is not None for column in there} == there
        assert (row["failure"] is not None) == (row["outcome"] == "failed")
        assert row["min_ttc_s"] is None or (cut_in and row["min_ttc_s"] >= 0.0)
        assert not crash or row["crash_time_s"] == pytest.approx(0.1 * row["n_steps"])


def test_records_kept_change_nothing_else(stored_run, tmp_path):
    """And of moments the first few are the first of all."""
    name = "step-recursive-twin"
    kept = {"bare": "{moments: none, traces: none}", "few": "{moments: first_9, traces: none}"}
    bare, few = (run_here(golden(name, f"records={of}"), tmp_path / each).folder for each, of in kept.items())
    assert {path.name for path in bare.iterdir() if path.is_dir()} == {"episodes"}
    for folder in (bare, few):
        assert stored_table(folder, "episodes").equals(stored_table(stored_run(name), "episodes"))
    everything, first = (stored_table(folder, "moments").to_pandas() for folder in (stored_run(name), few))
    expected = everything.groupby("episode", sort=False).head(9)
    columns = ["episode", "step", "p"]
    assert len(first) < len(everything)
    assert first[columns].to_numpy().tolist() == expected[columns].to_numpy().tolist()


def test_where_a_test_ends_is_told_how_near_a_collision_was(stored_run):
    """By the motion that was kept: the AV goes on as it did in the last step, the one ahead at its speed."""
    folder, near = stored_run("shells-twin"), 0
    traces = dict(list(stored_table(folder, "traces").to_pandas().groupby("episode")))
    for row in stored_table(folder, "episodes").to_pandas().itertuples():
        end = traces[row.episode][lambda rows: rows.step >= rows.step.max() - 1].set_index(["step", "vehicle"])
        last = end.loc[end.index.levels[0].max()]
        av, ahead = last.loc["AV"], last[(last.lane == last.lane["AV"]) & (last.x_m > last.x_m["AV"])]
        times = np.linspace(0.0, 60.0, 60_001)
        acceleration, hit = end.a_mps2[end.index.levels[0].max() - 1, "AV"], np.zeros(1)
        if row.outcome == "timeout" and len(ahead) and av.v_mps > (lead := ahead.loc[ahead.x_m.idxmin()]).v_mps:
            apart = lead.x_m - 5.0 - av.x_m - (av.v_mps - lead.v_mps) * times - acceleration * times**2 / 2.0
            hit = times[apart <= 0.0]
        if np.isnan(row.end_ttc_s):
            assert hit.size == 0 or row.outcome != "timeout" or hit[0] == 0.0 or hit[0] > 59.0
        elif row.end_ttc_s < 59.0:
            near += 1
            assert hit[0] == pytest.approx(row.end_ttc_s, abs=2e-3)
    assert near > 10


TRACED = {"shells-twin": "all", "mixture-twin": "share", "step-seldom": "critical"}


@pytest.mark.parametrize(("name", "policy"), TRACED.items())
def test_the_policy_says_which_are_traced(name, policy, stored_run):
    rows = stored_table(stored_run(name), "episodes").to_pandas()
    wanted = (rows.outcome == "crash") | (policy == "all")
    if policy == "critical":
        wanted |= rows.n_control_steps > 0
    elif policy == "share":
        wanted |= hash_of_index(golden(name).seed, rows.episode.to_numpy()) < golden(name).records.trace_share
    assert set(stored_table(stored_run(name), "traces")["episode"].to_pylist()) == set(rows.episode[wanted])
    assert wanted.all() == (policy == "all")


def test_a_trace_tells_the_same_story_as_its_row(stored_run):
    folder = stored_run("forced-inattentive")
    episodes, traces = stored_table(folder, "episodes"), stored_table(folder, "traces")
    assert traces["a_mps2"].null_count == 3 * episodes.num_rows  # the last step commands nothing
    lengths = episodes["n_steps"].to_pylist()
    assert traces["step"].to_pylist() == [step for n in lengths for step in range(n + 1) for _ in range(3)]
    assert traces["vehicle"].to_pylist() == ["LV", "BV", "AV"] * (traces.num_rows // 3)
    table = {name: traces[name].to_numpy(zero_copy_only=False) for name in ("episode", "step", "x_m", "v_mps", "lane")}
    for row in episodes.to_pylist():
        mine = table["episode"] == row["episode"]
        x, v, lane = (table[name][mine].reshape(-1, 3) for name in ("x_m", "v_mps", "lane"))
        assert x[-1, AV] - x[0, AV] == row["av_distance_m"]
        assert v[0, 1] == row["v_bv_mps"]
        np.testing.assert_allclose(x[0, :2] - 5.0 - x[0, 1:], (row["r1_m"], row["r2_m"]), atol=1e-9)
        if row["outcome"] == "crash":
            assert x[-1, 1] - 5.0 - x[-1, 2] < -0.001 <= x[-2, 1] - 5.0 - x[-2, 2]
            assert v[-1, 2] - v[-1, 1] == row["impact_speed_mps"]
        cut = row["event_step"]
        assert x[cut, 1] - 5.0 - x[cut, 2] == row["event_gap_m"]
        assert lane.tolist() == [[1, 1, 0]] * (cut + 1) + [[1, 0, 0]] * (row["n_steps"] - cut)


def test_records_say_when_it_began_and_how_it_ended(stored_run):
    folder = stored_run("shells-lateral-twin")
    episodes = stored_table(folder, "episodes")
    assert episodes.column_names[-8:-1] == LATERAL
    rows = episodes.to_pylist()
    assert len({row["lead_steps"] for row in rows}) > 1
    assert all(row["onset_step"] == max(row["event_step"] - row["lead_steps"], 0) for row in rows)
    for row in rows:
        side = row["outcome"] == "crash" and row["n_steps"] == row["event_step"] + 1
        assert row["contact"] == ("side" if side else "rear" if row["outcome"] == "crash" else None)
    traces = stored_table(folder, "traces").to_pandas()
    bv = traces[traces.vehicle == "BV"]
    assert bv.lateral_m.between(0.0, 1.7).all()
    assert (bv[bv.lane == 0].lateral_m == 1.7).all()
    assert (bv[bv.lane == 1].lateral_m < 1.7).all()
    assert (traces[traces.vehicle != "BV"].lateral_m == 0.0).all()


def test_frames_have_all_rows_and_say_what_columns_mean(stored_run):
    run = harness.read(str(stored_run("forced-inattentive")))
    tests = run.episodes()
    assert tests.episode.tolist() == list(range(240))
    assert tests.attrs["unit"]["r1_m"] == "m"
    assert tests.attrs["unit"].keys() == tests.attrs["doc"].keys() == set(tests.columns)
    assert tests.weight.to_numpy() == pytest.approx([math.exp(log_weight) for log_weight in tests.log_weight])
    traces = run.traces()
    assert list(traces.columns) == traces_schema().names
    assert set(traces.vehicle) == {"LV", "BV", "AV"}
    assert len(traces) == 3 * (tests.n_steps + 1).sum()
    some = run.episodes(["outcome"])
    assert list(some.columns) == list(some.attrs["unit"]) == ["outcome", "weight"]
    assert list(run.traces(["v_mps"]).columns) == ["v_mps"]


@pytest.mark.parametrize("name", ["mixture-twin", "shells-twin"])
def test_arrow_tables_and_batches_are_what_the_frames_are(name, stored_run):
    run = harness.read(stored_run(name))
    table, pieces = run.table("episodes", ["outcome"]), list(run.batches("episodes", ["outcome"]))
    assert len(pieces) > 1
    assert pa.concat_tables(pieces).to_pydict() == table.to_pydict()
    assert table["weight"].to_pylist() == run.episodes()["weight"].tolist()
    assert table.schema.field("weight").metadata[b"unit"] == b"1"


def test_what_is_not_there_is_one_error(stored_run, tmp_path):
    folder = copy_of(stored_run("mixture-twin"), tmp_path / "run")
    run, parts = harness.read(folder), manifest(folder)["parts"]
    edit(folder, parts=[{**part, "files": {"episodes": part["files"]["episodes"]}} for part in parts])
    with pytest.raises(RunFolderError, match=r"no moments.*records\.moments=all"):
        run.moments()
    with pytest.raises(RunFolderError, match="no column 'nothing' in episodes"):
        run.episodes(["nothing"])
    with pytest.raises(RunFolderError, match="no run folder"):
        harness.read(folder / "episodes").episodes()


def test_causes_of_failures_that_differ_in_numbers_alone_are_one_but_not_those_of_other_lines():
    asked = "step: asked for {} m/s2, outside of av.limits (-15 to 10)"
    causes = {asked.format("-99"): 1, asked.format("1e+30"): 2, "step: no (a.py:12)": 1, "step: no (a.py:40)": 1}
    assert by_kind(causes) == {asked.format("1e+30"): 3, "step: no (a.py:12)": 1, "step: no (a.py:40)": 1}
