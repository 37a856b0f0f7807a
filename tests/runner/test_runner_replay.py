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

REPLAYED = (
    *("mixture-seven", "mixture-twin", "nde-twin", "shells-sumo", "shells-acting-sumo", "forced-acting-twin"),
    *("shells-lateral-sumo", "forced-krauss"),
)


def rows_of(table: pa.Table, episode: int) -> pa.Table:
    return table.filter(pc.equal(table["episode"], episode))


@pytest.mark.parametrize("name", REPLAYED)
def test_stored_rows_and_traces_come_out_again(name, stored_run):
    """The first and the last test, a crash, one that ended well, one without cut-in if there is one, a traced one."""
    rows, traces = (stored_table(stored_run(name), table) for table in ("episodes", "traces"))
    outcome, cut_in = rows["outcome"].to_pylist(), rows["cut_in_step"].to_pylist()
    chosen = {0, len(outcome) - 1, outcome.index("timeout")}
    chosen |= {
        next((i for i, value in enumerate(values) if value == of), 0)
        for values, of in ((outcome, "crash"), (cut_in, None))
    }
    chosen.add(traces["episode"][0].as_py())
    for episode in sorted(chosen):
        result = replay_episode(stored_run(name), episode)
        row, stored = rows_of(rows, episode), rows_of(traces, episode)
        assert (result.bit_equal, result.compared) == (True, ("episodes", "traces")[: 1 + (stored.num_rows > 0)])
        assert result.outcome == result.row["outcome"] == row["outcome"].to_pylist()[0]
        assert result.row["log_weight"].hex() == row["log_weight"].to_pylist()[0].hex()
        if stored.num_rows:
            assert all(column_hash(result.trace[name]) == column_hash(stored[name]) for name in stored.column_names)


@pytest.mark.parametrize(("table", "column"), [("traces", "x_m"), ("traces", "v_mps"), ("episodes", "log_weight")])
def test_a_record_that_was_tampered_with_is_noticed(table, column, twin_run, tmp_path, capsys):
    """By one unit in the last place."""
    folder = of_before(copy_of(twin_run, tmp_path / "run"))
    path = shard_files(folder, table)[1]
    rows = pq.read_table(path, partitioning=None)
    values = rows[column].to_numpy().copy()
    values[30] = np.nextafter(values[30], -1e9)
    index = rows.column_names.index(column)
    pq.write_table(rows.set_column(index, rows.schema.field(column), [values]), path)
    episode = rows["episode"][30].as_py()
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
    expected: list[dict] = [{} for _ in range(n_steps + 1)]
    columns = (result.trace[name].to_pylist() for name in ("step", "vehicle", "x_m", "v_mps", "lane"))
    for step, vehicle, x, v, lane in zip(*columns, strict=True):
        expected[step][vehicle] = (x, v, f"cell0_{lane}")
    for frame, motion in zip(seen, expected[1:], strict=True):
        for vehicle, (x, v, lane) in motion.items():
            assert frame[vehicle] == (pytest.approx(x, abs=1e-8), pytest.approx(v, abs=1e-8), lane)
