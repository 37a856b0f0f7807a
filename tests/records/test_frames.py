"""The tables of a run as pandas frames: units and meanings beside them, and one error for what is not there."""

import math

import pyarrow as pa
import pytest

import harness
from harness.errors import RunFolderError
from harness.records.schemas import moments_schema, traces_schema
from tests.stored_runs import copy_of, edit, manifest


def test_frames_have_all_rows_and_say_what_columns_mean(stored_run):
    run = harness.read(str(stored_run("forced-inattentive")))
    tests = run.episodes()
    assert tests.episode.tolist() == list(range(240))
    assert tests.attrs["unit"]["r1_m"] == "m"
    assert tests.attrs["unit"].keys() == tests.attrs["doc"].keys() == set(tests.columns)
    assert tests.weight.to_numpy() == pytest.approx([math.exp(log_weight) for log_weight in tests.log_weight])
    assert run.moments().attrs["unit"]["q_sampled"] == "1"
    traces = run.traces()
    assert list(traces.columns) == traces_schema().names
    assert set(traces.vehicle) == {"LV", "BV", "AV"}
    assert len(traces) == 3 * (tests.n_steps + 1).sum()
    some = run.episodes(["outcome"])
    assert list(some.columns) == list(some.attrs["unit"]) == ["outcome", "weight"]
    assert list(run.moments(["p", "episode"]).columns) == ["p", "episode"]
    assert list(run.traces(["v_mps"]).columns) == ["v_mps"]
    with pytest.raises(RunFolderError, match="no column 'weight' in moments"):
        run.moments(["weight"])
    assert list(harness.read(stored_run("mixture-twin")).moments().columns) == moments_schema(3).names


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
    run, shards = harness.read(folder), manifest(folder)["shards"]
    edit(folder, shards=[{**shard, "files": {"episodes": shard["files"]["episodes"]}} for shard in shards])
    for table in (run.moments, run.traces):
        with pytest.raises(RunFolderError, match=f"no {table.__name__}.*records.{table.__name__}=all"):
            table()
    with pytest.raises(RunFolderError, match="no column 'nothing' in episodes"):
        run.episodes(["nothing"])
    (folder / "episodes" / "shard-000001.parquet").unlink()
    with pytest.raises(RunFolderError, match="no such file"):
        run.episodes()
    edit(folder, n_episodes=0, shards=[])
    with pytest.raises(RunFolderError, match="not finished an episode"):
        run.episodes()
    with pytest.raises(RunFolderError, match="no run folder"):
        harness.read(folder / "episodes").episodes()
