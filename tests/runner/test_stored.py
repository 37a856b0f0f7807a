"""`harness estimate` on a stored run is `estimates.json`, exactly, and the rate is the mean of stored weights."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import harness
from harness.cli import main
from harness.estimators.block import joined
from harness.records.schemas import chosen_from
from harness.resolved import resolve
from harness.runner.stored import estimate_run, even, replay_episode, stored_blocks
from tests.golden.record import column_hash
from tests.in_process import run_here
from tests.stored_runs import ROOT, copy_of, edit, estimates, golden, part_files, stored_table, unnoted

ESTIMATOR = {"shells-twin": "shells", "nde-twin": "nde"}
RECORDS = (ROOT / "docs/records.md").read_text()
LINES = "\n".join(re.findall(r"^```python\n(.*?)^```$", RECORDS, re.MULTILINE | re.DOTALL))


def test_estimating_again_gives_the_same_content_and_another_confidence_the_same_rate(sumo_run, twin_run, capsys):
    assert estimate_run(sumo_run) == estimates(sumo_run)
    assert main(["estimate", str(twin_run), "--json"]) == 0
    stored, wider = estimates(twin_run), estimate_run(twin_run, confidence=0.99)
    assert json.loads(capsys.readouterr().out) == stored
    headline = stored["headline"]
    assert wider["estimates"][headline]["crash_rate"] == stored["estimates"][headline]["crash_rate"]
    assert wider["estimates"][headline]["ci_high"] > stored["estimates"][headline]["ci_high"]


def test_of_the_prefix_that_counts_what_is_asked_and_the_headline_are_estimated(tmp_path):
    folder = run_here(golden("step-recursive-twin", "records.moments=none"), tmp_path / "run").folder
    edit(folder, n_episodes=200)
    content, asked = estimate_run(folder), estimate_run(folder, estimators=["scv"])
    assert content["n_episodes"] == content["convergence"][-1]["n"] == 200
    assert asked["estimates"] == {name: content["estimates"][name] for name in ("nade", "scv")}
    assert content["estimates"]["scv"]["crash_rate"] is None
    assert content["estimates"]["scv"]["why"]["key"] == "needs_moments"


@pytest.mark.parametrize("size", [1, 79])
def test_blocks_that_are_estimated_follow_from_tests_alone(size, twin_run):
    blocks = list(stored_blocks(twin_run, moments=False))
    whole = joined(blocks)
    cut = [whole.take(slice(first, first + size)) for first in range(0, len(whole), size)]
    evened = list(even(cut))
    assert [len(block) for block in evened] == [len(block) for block in even(blocks)] == [64] * 6 + [16]
    again = joined(evened)
    assert all(column.tobytes() == again.columns[name].tobytes() for name, column in whole.columns.items())
    np.testing.assert_array_equal(whole.log_weight, again.log_weight)


@pytest.mark.parametrize("name", ["shells-twin", "nde-twin", "mixture-twin"])
def test_the_weights_give_the_rate_of_every_method_as_docs_have_it(name, stored_run, capsys):
    folder = stored_run(name)
    rate = estimates(folder)["estimates"][ESTIMATOR.get(name, "nade")]["crash_rate"]
    assert rate > 0.0
    tests = harness.read(folder).episodes(["outcome", "log_weight"])
    crash = tests.outcome == "crash"
    assert (tests.weight * crash).mean() == pytest.approx(rate, rel=1e-9)
    plain = (np.exp(tests.log_weight) * crash).mean()
    assert (plain == pytest.approx(rate, rel=1e-9)) == (name != "shells-twin")
    exec(LINES.replace("runs/late", str(folder)), {})
    assert float(capsys.readouterr().out.split()[-1]) == pytest.approx(rate, rel=1e-9)


# -- replay gives stored rows and traces bit for bit, and says so where they have been tampered with --


REPLAYED = (
    *("mixture-seven", "nde-twin", "shells-lateral-sumo", "forced-krauss"),
    pytest.param("shells-acting-sumo", marks=pytest.mark.slow),
)


def rows_of(table: pa.Table, episode: int) -> pa.Table:
    return table.filter(pc.equal(table["episode"], episode))


@pytest.mark.parametrize("name", REPLAYED)
def test_stored_rows_and_traces_come_out_again(name, stored_run):
    """The first and the last test, a crash, one that ended well, one without cut-in if there is one, a traced one."""
    rows, traces = (stored_table(stored_run(name), table) for table in ("episodes", "traces"))
    outcome, cut_in = rows["outcome"].to_pylist(), rows["event_step"].to_pylist()
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


@pytest.mark.parametrize(("table", "column"), [("traces", "x_m"), ("episodes", "log_weight")])
def test_a_record_that_was_tampered_with_is_noticed(table, column, twin_run, tmp_path, capsys):
    """By one unit in the last place."""
    folder = unnoted(copy_of(twin_run, tmp_path / "run"))
    path = part_files(folder, table)[1]
    rows = pq.read_table(path, partitioning=None)
    values, at = rows[column].to_pylist(), rows.column_names.index(column)
    values[30] = float(np.nextafter(values[30], np.inf))
    pq.write_table(rows.set_column(at, rows.schema.field(at), pa.array(values)), path)
    episode = rows["episode"][30].as_py()
    assert replay_episode(folder, episode).bit_equal is False
    assert main(["replay", str(folder), str(episode)]) == 3
    out, err = capsys.readouterr()
    assert "NOT as stored" in out
    assert f"test {episode} of" in err


def test_floating_car_data_hold_the_episodes_motion(sumo_run, tmp_path):
    folder = sumo_run
    episode = stored_table(folder, "episodes")["outcome"].to_pylist().index("crash")
    fcd = tmp_path / "a, b" / "c${HOME}.xml"
    result = replay_episode(folder, episode)
    harness.write_motion(result, fcd)
    assert result.bit_equal is True
    frames = ET.parse(fcd).getroot().findall("timestep")
    n_steps = result.row["n_steps"]
    seen = [
        {v.get("id"): (float(v.get("pos")), float(v.get("speed")), v.get("lane")) for v in frame}
        for frame in frames[-n_steps:]
    ]
    expected: list[dict] = [{} for _ in range(n_steps + 1)]
    columns = (result.trace[name].to_pylist() for name in ("step", "vehicle", "x_m", "v_mps", "lane"))
    for step, vehicle, x, v, lane in zip(*columns, strict=True):
        expected[step][vehicle] = (x, v, f"cell0_{lane}")
    for frame, motion in zip(seen, expected[1:], strict=True):
        for vehicle, (x, v, lane) in motion.items():
            assert frame[vehicle] == (x, v, lane)


# -- what is stored of a test determines how it ends: without a world, by what replays and pages drive others with --


DRIVEN = (
    *("nde-sumo", "forced-sumo", "step-recursive-sumo", "shells-lateral-sumo", "shells-refuted"),
    *("forced-reference", "nde-lateral", "shells-stops"),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVEN)
def test_a_vehicle_driven_along_stored_maneuvers_crashes_where_it_did(name, stored_run):
    """And where one of BV's maneuvers is another, elsewhere."""
    resolved, rows = resolve(golden(name)), stored_table(stored_run(name), "episodes")
    outcome = pc.field("outcome").cast(pa.string())
    rows = rows.filter(pc.field("event_step").is_valid() & (outcome != "bv_lv_contact"))
    crashed = np.asarray(pc.equal(rows["outcome"].cast(pa.string()), "crash"))

    def ends(chosen):
        drive = resolved.family.drive
        return drive(resolved.environment, chosen, np.full((len(crashed), 2), np.nan), resolved.av).end[:, 0]

    chosen, n_steps = chosen_from(rows, resolved.family), rows["n_steps"].to_numpy()
    assert 3 < crashed.sum() < len(crashed)
    assert np.array_equal(ends(chosen) >= 0, crashed)
    assert np.array_equal(ends(chosen)[crashed], n_steps[crashed])
    chosen.facts["bv_maneuvers"][:, 0] = 30 - chosen.facts["bv_maneuvers"][:, 0]
    assert not np.array_equal(ends(chosen)[crashed], n_steps[crashed])
