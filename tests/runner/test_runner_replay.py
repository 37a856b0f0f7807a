"""`harness replay` reproduces stored rows and traces bit for bit, and says so when they have been tampered with."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from harness.cli import main
from harness.runner.stored import replay_episode
from tests.golden.record import column_hash
from tests.stored_runs import copy_of, of_before, shard_files, stored_table


def rows_of(table: pa.Table, episode: int) -> pa.Table:
    return table.filter(pc.equal(table["episode"], episode))


def episodes_worth_a_look(folder) -> list[int]:
    """A crash, a cut-in that ended well, one without cut-in if there is one, a traced one, the first and the last."""
    episodes = stored_table(folder, "episodes")
    outcome, cut_in = episodes["outcome"].to_pylist(), episodes["cut_in_step"].to_pylist()
    chosen = {0, len(outcome) - 1, outcome.index("crash"), outcome.index("timeout")}
    chosen |= {next((i for i, step in enumerate(cut_in) if step is None), 0)}
    traced = set(stored_table(folder, "traces")["episode"].to_pylist())
    chosen |= {min(i for i in traced if outcome[i] != "crash")}
    return sorted(chosen)


@pytest.mark.parametrize("engine", ["sumo", "twin"])
def test_stored_rows_and_traces_come_out_again(engine, request):
    folder = request.getfixturevalue(f"{engine}_run")
    rows, traces = stored_table(folder, "episodes"), stored_table(folder, "traces")
    compared = set()
    for episode in episodes_worth_a_look(folder):
        result = replay_episode(folder, episode)
        assert result.bit_equal is True
        compared.add(result.compared)
        row = rows_of(rows, episode)
        assert result.outcome == result.row["outcome"] == row["outcome"].to_pylist()[0]
        assert result.row["log_weight"].hex() == row["log_weight"].to_pylist()[0].hex()
        stored = rows_of(traces, episode)
        if stored.num_rows:
            assert "traces" in result.compared
            assert all(column_hash(result.trace[name]) == column_hash(stored[name]) for name in stored.column_names)
    assert compared == {("episodes",), ("episodes", "traces")}


def tampered(folder, table: str, column: str) -> int:
    """Change one value of the column by one unit in the last place; returns its episode."""
    path = shard_files(folder, table)[1]
    rows = pq.read_table(path, partitioning=None)
    values = rows[column].to_numpy().copy()
    values[30] = np.nextafter(values[30], -1e9)
    index = rows.column_names.index(column)
    pq.write_table(rows.set_column(index, rows.schema.field(column), [values]), path)
    return rows["episode"].to_pylist()[30]


@pytest.mark.parametrize(("table", "column"), [("traces", "x_m"), ("traces", "v_mps"), ("episodes", "log_weight")])
def test_a_record_that_was_tampered_with_is_noticed(table, column, twin_run, tmp_path, capsys):
    folder = of_before(copy_of(twin_run, tmp_path / "run"))
    episode = tampered(folder, table, column)
    assert replay_episode(folder, episode).bit_equal is False
    assert main(["replay", str(folder), str(episode)]) == 3
    out, err = capsys.readouterr()
    assert "NOT as stored" in out
    assert f"episode {episode}" in err


@pytest.mark.parametrize("engine", ["sumo", "twin"])
def test_floating_car_data_hold_the_episodes_motion(engine, request, tmp_path):
    folder = request.getfixturevalue(f"{engine}_run")
    episode = stored_table(folder, "episodes")["outcome"].to_pylist().index("crash")
    fcd = tmp_path / "fcd.xml"
    result = replay_episode(folder, episode, fcd=fcd)
    assert result.bit_equal is True
    frames = ET.parse(fcd).getroot().findall("timestep")
    n_steps = result.row["n_steps"]
    seen = [
        {v.get("id").rstrip("0"): (float(v.get("pos")), float(v.get("speed")), v.get("lane")) for v in frame}
        for frame in frames[-n_steps:]
    ]
    steps = result.trace["step"].to_pylist()
    expected: list[dict] = [{} for _ in range(n_steps + 1)]
    columns = (result.trace[name].to_pylist() for name in ("vehicle", "x_m", "v_mps", "lane"))
    for step, vehicle, x, v, lane in zip(steps, *columns, strict=True):
        expected[step][vehicle] = (x, v, f"cell0_{lane}")
    for frame, motion in zip(seen, expected[1:], strict=True):
        for vehicle, (x, v, lane) in motion.items():
            assert frame[vehicle] == (pytest.approx(x, abs=1e-8), pytest.approx(v, abs=1e-8), lane)
