"""A stored run: `harness estimate` gives its answer again, replay its bits; what a run writes, and reads."""

from __future__ import annotations

import gc
import json
import os
import re
import shutil
import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import harness
from harness import cache
from harness.cli import main
from harness.estimators.block import joined
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.records.folder import TABLES
from harness.records.schemas import chosen_from
from harness.resolved import resolve
from harness.runner.stored import estimate_run, even, replay_episode, stored_blocks, write_report
from harness.vehicles import library
from tests.golden.campaigns import BASE, RUNS
from tests.golden.record import column_hash
from tests.in_process import controllers_here, one_process, run_here, run_with_workers
from tests.stored_runs import (
    ROOT,
    copy_of,
    edit,
    estimates,
    golden,
    manifest,
    part_files,
    stored_table,
    unlike_columns,
    unnoted,
)

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


# -- what a run writes --


opened: dict[Path, Counter[str]] = {}
hooked: list[bool] = []


def note(event, arguments):
    if event == "open" and opened and isinstance(arguments[0], str | os.PathLike):
        path, mode, flags = str(arguments[0]), arguments[1], arguments[2]
        [folder] = opened
        reads = mode.startswith("r") if mode else not flags & (os.O_WRONLY | os.O_RDWR)
        if reads and Path(path).is_relative_to(folder) and not path.endswith(".part") and not Path(path).is_dir():
            opened[folder][str(Path(path).relative_to(folder))] += 1


@contextmanager
def opens_below(folder):
    """How often each file below a folder is opened for reading."""
    if not hooked:  # it stays
        sys.addaudithook(note)
        hooked.append(True)
    opened[folder] = Counter()
    try:
        yield opened[folder]
    finally:
        opened.clear()


def inputs_in(folder, name):
    """Files of one's own that a golden campaign may be run from, and its overrides."""
    campaign = golden(name)
    drivers = campaign.pool.library or library.DEFAULT
    shutil.copy(BASE, folder / "campaign.yaml")
    shutil.copy(SHIPPED_FOLDER / f"{campaign.environment.parameters}.yaml", folder / "traffic.yaml")
    shutil.copy(library.SHIPPED_FOLDER / f"{drivers}.yaml", folder / "drivers.yaml")
    return [*RUNS[name], "environment.parameters=traffic.yaml", "pool.library=drivers.yaml"]


@pytest.mark.parametrize("name", ["shells-twin", pytest.param("shells-acting-twin", marks=pytest.mark.slow)])
def test_the_answer_and_the_page_come_from_what_is_in_hand(name, tmp_path):
    """But for traces, which the page plays; made from the folder it is the same page. Each input is read once."""
    overrides = inputs_in(tmp_path, name)
    inputs = ["campaign.yaml", "traffic.yaml", *(["drivers.yaml"] if golden(name).sampling.strata else [])]
    with opens_below(tmp_path) as reads, one_process(), controllers_here():
        harness.run(harness.load_campaign(tmp_path / "campaign.yaml", overrides), tmp_path / "run", workers=1)
        read = {path: n for path, n in reads.items() if not path.startswith("run/traces/")}
    assert read == dict.fromkeys(inputs, 1)
    page = (tmp_path / "run" / "report.html").read_bytes()
    assert write_report(tmp_path / "run").read_bytes() == page


def test_a_pool_is_read_once_in_a_process(stored_run, tmp_path):
    stored_run("shells-twin")  # has built it
    gc.collect()  # one that another test has left would be used
    with opens_below(cache.own_folder()) as reads:
        run_here(golden("shells-twin"), tmp_path / "run")  # its one worker is this process, too
        pools = {path: n for path, n in reads.items() if path.startswith("pools/")}
    assert list(pools.values()) == [1]


@pytest.mark.slow
def test_what_an_earlier_run_has_left_is_read_once(tmp_path):
    name = "shells-acting-twin"
    run_here(golden(name, "stop.episodes=200"), tmp_path / "run")
    with opens_below(tmp_path / "run") as reads, one_process(), controllers_here():
        harness.run(golden(name), tmp_path / "run", workers=1, resume=True)
    assert set(reads) >= {"manifest.json", "shells.json"}
    assert {path: n for path, n in reads.items() if n > 1 and not path.startswith("traces/")} == {}


def test_there_is_one_file_per_table_and_none_without_rows(stored_run, tmp_path):
    run_with_workers(golden("nde-twin"), tmp_path / "run", workers=2)
    n = manifest(tmp_path / "run")["n_episodes"]
    for table in TABLES:
        files = part_files(tmp_path / "run", table)
        assert all(pq.read_metadata(path).num_rows for path in files)
        assert [path.name for path in files] in ([], [f"{0:09d}-{n:09d}.parquet"])
    assert unlike_columns(stored_run("nde-twin"), tmp_path / "run") == []
