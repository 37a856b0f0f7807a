"""What the player plays, and what other tools are given, is what was simulated; which crashes come first."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pytest

import harness
from harness.campaign.files import load_campaign
from harness.cli import main
from harness.errors import CampaignError
from harness.families.cut_in.words import STAND_INS
from harness.report import crashes, player
from harness.report.motion import gui_program, write_sumo
from harness.report.player import LANE_M, UNKNOWN, Scenes
from harness.report.summary import read_run_folder, summarise
from harness.resolved import resolve
from harness.runner.stored import write_report
from harness.vehicles.kinematics import VEHICLE_LENGTH_M
from harness.vocabulary import VEHICLES
from harness.worlds.sumo import sumo_program
from tests.in_process import controllers_here, run_here
from tests.stored_runs import copy_of, golden, part_files, stored_table, truncate

KINDS = ("shells-twin", "shells-lateral-sumo", "forced-lateral-twin", "shells-acting-twin", "forced-krauss", "nde-twin")


def scenes_in(page: str) -> list[dict]:
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)[1])


def crashed(folder, most: int = 5) -> list[int]:
    episodes = stored_table(folder, "episodes")
    return episodes.filter(pc.equal(episodes["outcome"].cast(pa.string()), "crash"))["episode"].to_pylist()[:most]


def motion(trace: pa.Table, vehicle: str, key: str) -> list[float]:
    return trace.filter(pc.equal(trace["vehicle"].cast(pa.string()), vehicle))[key].to_pylist()


@pytest.mark.parametrize("name", KINDS)
def test_a_page_holds_the_motion_to_the_last_bit(name, stored_run, tmp_path):
    """And that of those who end without a crash, or without a cut-in."""
    folder, file = stored_run(name), tmp_path / "crash.html"
    for episode in sorted({*crashed(folder, 2), 0, 1}):
        with controllers_here():
            result = harness.replay(folder, episode)
        harness.write_motion(result, file)
        [scene] = scenes_in(file.read_text(encoding="utf-8"))
        first, n = scene["first"], result.row["n_steps"] + 1
        for track in scene["tracks"]:
            for ours, theirs in (("x", "x_m"), ("v", "v_mps")):
                assert track[ours][: n - first] == motion(result.trace, track["name"], theirs)[first:]
        assert [track["name"] for track in scene["tracks"] if len(track["x"]) > n - first] in ([], ["BV"])
        crash = n - 1 if result.outcome == "crash" else None
        assert [track["crash"] for track in scene["tracks"]] == [None, None, crash]
        cut_in = result.row["event_step"]
        assert scene["event"] == cut_in
        assert scene["onset"] == result.row.get("onset_step", cut_in)
        assert len(scene["ghosts"]) == (0 if cut_in is None else 2)
        touched = [fact for name, fact in scene["facts"] if name == "AV" and "BV moves sideways into it" in fact]
        assert bool(touched) == (result.row.get("contact") == "side" and scene["onset"] < cut_in)


@pytest.mark.parametrize("name", ["shells-twin", "shells-acting-twin", "shells-lateral-sumo"])
def test_who_crashes_is_what_the_records_say(name, stored_run):
    """The pool knows how BV goes on after the AV's crash, the records of the test do not: up to there all are equal."""
    folder = stored_run(name)
    design = json.loads((folder / "shells.json").read_text())
    bit = [each["name"] for each in design["references"]].index("r157-cc")
    episodes = stored_table(folder, "episodes")
    rows = episodes.filter(pc.equal(episodes["outcome"].cast(pa.string()), "crash"))
    on_record = (np.array(design["cell_references"])[rows["cell"].to_numpy()] >> bit) & 1 == 1
    campaign = load_campaign(folder / "campaign.yaml")
    traces = stored_table(folder, "traces").filter(pc.field("episode").isin(rows["episode"]))
    ends = Scenes(campaign, resolve(campaign).environment).ends(rows, traces)[:, 0]
    known = (ends >= 0) & (ends <= rows["n_steps"].to_numpy())
    assert known.sum() >= 10
    assert on_record[known].all()
    assert (on_record != (ends >= 0)).mean() < 0.03


def test_of_a_vehicle_that_acts_nobody_knows_without_its_motion(stored_run):
    folder = stored_run("shells-acting-twin")
    campaign = load_campaign(folder / "campaign.yaml")
    rows = stored_table(folder, "episodes").slice(0, 3)
    scenes = Scenes(campaign, resolve(campaign).environment)
    assert (scenes.ends(rows, None) == UNKNOWN).all()
    assert (Scenes(campaign, None).ends(rows, stored_table(folder, "traces")) == UNKNOWN).all()


def test_a_report_shows_crashes_with_those_who_avoid_them(stored_run, tmp_path):
    folder = copy_of(stored_run("shells-twin"), tmp_path / "run")
    scenes = scenes_in(write_report(folder).read_text(encoding="utf-8"))
    rows, _ = crashes.crash_gallery(run := read_run_folder(folder), summarise(run))
    assert [row.episode for row in rows if row.scene is not None] == [scene["episode"] for scene in scenes]
    for row, scene in zip(rows, scenes, strict=True):
        avoids = [ghost["name"] for ghost in scene["ghosts"] if ghost["crash"] is None]
        assert row.avoided_by == (", ".join(avoids) or "nobody")
        again = harness.replay(folder, row.episode).scene | {"title": scene["title"]}
        assert scene == json.loads(json.dumps(again, default=np.ndarray.tolist))


def test_replay_says_what_happens_and_writes_the_page(stored_run, tmp_path, capsys):
    folder, file = stored_run("forced-lateral-sumo"), tmp_path / "crash.html"
    episode = crashed(folder)[0]
    assert main(["replay", str(folder), str(episode), "--out", str(file)]) == 0
    first, *lines, last = capsys.readouterr().out.splitlines()
    assert first == f"test {episode}: crash; bit for bit as stored"
    assert last == str(file)
    told = {line[2:20].strip(): line[21:] for line in lines}
    assert set(told) == {"BV comes over", "BV enters the lane", "AV brakes", "AV", *STAND_INS}
    row = harness.replay(folder, episode).row
    assert f"crashes at {row['crash_time_s']:.1f} s" in told["AV"]
    assert f"impact {row['impact_speed_mps']:.1f} m/s" in told["AV"]
    assert f"{row['event_gap_m']:.1f} m ahead and {-row['event_rate_mps']:.1f} m/s slower" in told["BV enters the lane"]
    assert f"{row['onset_gap_m']:.1f} m ahead" in told["BV comes over"]
    assert scenes_in(file.read_text(encoding="utf-8"))[0]["episode"] == episode


def test_without_a_number_the_hardest_crash_is_replayed(stored_run, tmp_path, capsys):
    folder = stored_run("forced-lateral-sumo")
    rows = stored_table(folder, "episodes").select(["episode", "impact_speed_mps"]).drop_null().to_pylist()
    hardest = max(rows, key=lambda row: (row["impact_speed_mps"], -row["episode"]))
    assert main(["replay", str(folder)]) == 0
    assert capsys.readouterr().out.startswith(f"test {hardest['episode']}: crash; bit for bit as stored\n")
    run_here(golden("nde-twin", "stop.episodes=5"), tmp_path / "run")
    with pytest.raises(harness.HarnessError, match="no crash") as refused:
        harness.replay(tmp_path / "run")
    assert refused.value.mend == f"Name one: harness replay {tmp_path / 'run'} 0."


@pytest.mark.parametrize(
    ("speed", "ahead", "onset", "said"),
    [
        (21.0, 7.0, 0, "no crash until the test ends, 1.5 m behind BV and still 1.0 m/s faster"),
        (20.0, 7.0, 0, "avoids it, 2.0 m at the closest"),
        (20.0, 7.0, -1, "avoids it, 2.0 m at the closest since BV entered the lane"),
        (20.0, 5.02, 0, "avoids it, < 0.1 m at the closest"),
        (21.0, 5.2, 0, "touches BV at 1.0 m/s, too softly to count"),
        (21.0, -6.0, 0, "has passed BV"),
    ],
)
def test_a_test_that_ends_while_the_vehicle_closes_in_has_avoided_nothing(speed, ahead, onset, said):
    time_s = np.arange(6) / 10
    bv = {"name": "BV", "x": ahead + 20.0 * time_s, "v": np.full(6, 20.0)}
    av = {"x": speed * time_s, "v": np.full(6, speed), "crash": None}
    scene = {"scenario": "cut_in", "principal": "BV", "tracks": [{}, bv, av], "first": 0, "event": 0, "onset": onset}
    assert player._ending(av, scene) == said
    ends_before = {"x": av["x"][:1], "v": av["v"][:1], "crash": None}  # by an impact too soft to count
    assert player._ending(ends_before, scene) == "does not crash"


@pytest.mark.parametrize("scenario", ["lead_brakes", "cut_out"])
def test_others_who_follow_are_told_with_their_headway(scenario, crashing, tmp_path):
    page = write_report(copy_of(crashing[scenario], tmp_path / "run"))
    scene = scenes_in(page.read_text(encoding="utf-8"))[0]
    at, lead = scene["onset"] - scene["first"], scene["tracks"][0]
    for ghost in scene["ghosts"]:
        headway_s = (lead["x"][at] - VEHICLE_LENGTH_M - ghost["x"][at]) / ghost["v"][at]
        assert f", {headway_s:.1f} s behind at the onset: " in dict(scene["facts"])[ghost["name"]]


@pytest.mark.parametrize("name", ["cut_out", "forced-lateral-sumo"])
def test_words_and_csv_say_the_same_of_when_a_lane_changes(name, crashing, stored_run, tmp_path):
    """And that of a vehicle that has left is clear; times are rounded to their step."""
    folder, file = crashing[name] if name in crashing else stored_run(name), tmp_path / "crash.csv"
    harness.write_motion(result := harness.replay(folder, crashed(folder)[0]), file)
    rows, who = pd.read_csv(file), "LV" if name == "cut_out" else "BV"
    rows = rows[rows.vehicle == who]
    changed = rows[rows.lane != rows.lane.iloc[0]].iloc[0]
    told = dict(result.scene["facts"])[f"{who} {'has left' if who == 'LV' else 'enters'} the lane"]
    assert re.match(rf"{changed.time_s - 0.1:.1f} to {changed.time_s:.1f} s: ", told)
    assert changed.lateral_m >= 1.7
    assert (rows.time_s * 10).round().div(10).equals(rows.time_s)


# -- for other tools --


def complaints(file):
    """Of ASAM's own checker: schema, references, names."""
    from qc_baselib import Configuration, Result  # half a second, for whoever runs this
    from qc_openscenario.main import run_checks

    config, result = Configuration(), Result()
    config.set_config_param("InputFile", str(file))
    result.register_checker_bundle(name="xoscBundle", description="", version="1.0.0")
    result.set_result_version("1.0.0")
    run_checks(config, result)
    assert len(result.get_checker_results("xoscBundle")) == 17
    return [issue.description for each in result.get_checker_results("xoscBundle") for issue in each.issues]


@pytest.mark.parametrize("name", ["shells-twin", "forced-lateral-sumo"])
def test_openscenario_moves_everybody_as_the_trace_does(name, stored_run, tmp_path, capsys):
    folder, file = stored_run(name), tmp_path / "out" / "crash.xosc"
    tests = harness.read(folder).episodes(["episode", "outcome", "event_step"])
    crash = tests[tests.outcome == "crash"].iloc[0]
    assert main(["replay", str(folder), str(crash.episode), "--out", str(file)]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [str(file), str(file.with_suffix(".xodr"))]
    assert complaints(file) == []
    trace = harness.replay(folder, int(crash.episode)).trace.to_pandas()
    scenario = ElementTree.parse(file)
    assert scenario.find("RoadNetwork/LogicFile").get("filepath") == "crash.xodr"
    for group in scenario.iterfind(".//ManeuverGroup"):
        vehicle = group.find("Actors/EntityRef").get("entityRef")
        rows = trace[trace.vehicle == vehicle]
        vertices = [(each.get("time"), each.find(".//WorldPosition")) for each in group.iterfind(".//Vertex")]
        time_s, x, y = np.array([(time, at.get("x"), at.get("y")) for time, at in vertices], float).T
        assert time_s.tolist() == [step / 10 for step in rows.step]
        centre = float(scenario.find(f".//Vehicle[@name='{vehicle}']/BoundingBox/Center").get("x"))
        np.testing.assert_allclose(x + centre + 2.5, rows.x_m, rtol=0, atol=1e-9)  # the middle, and half a vehicle
        ends = {"LV": (-0.5, -0.5), "BV": (-0.5, -1.5), "AV": (-1.5, -1.5)}[vehicle]
        steps = -np.diff(y)[np.diff(y) != 0.0]
        if vehicle == "BV" and "lateral_m" in rows:  # as fast after the overlap as before, until it is all over
            assert steps[:-1] == pytest.approx(steps[0])
            assert 0.0 < steps[-1] <= steps[0] + 1e-9
            assert y[rows.lane.to_numpy() == 0][0] == pytest.approx(-0.5 * LANE_M - 1.7)
            ends = ends[0], y[-1] / LANE_M
        assert (y[0], y[-1]) == pytest.approx([LANE_M * end for end in ends])
        assert (steps >= 0.0).all()
    actors = [each.get("entityRef") for each in scenario.iterfind(".//EntityRef") if each.get("entityRef")]
    assert set(actors) == set(VEHICLES)


def test_csv_has_units_in_its_names(stored_run, tmp_path):
    folder, file = stored_run("shells-twin"), tmp_path / "episode_3.csv"
    assert main(["replay", str(folder), "3", "--out", str(file)]) == 0
    with file.open() as content:
        rows = list(csv.DictReader(content))
    trace = harness.replay(folder, 3).trace.to_pylist()
    assert list(rows[0]) == ["time_s", "vehicle", "lane", "x_m", "v_mps", "a_mps2"]
    assert [(round(float(row["time_s"]) * 10), row["vehicle"], float(row["x_m"])) for row in rows] == [
        (row["step"], row["vehicle"], row["x_m"]) for row in trace
    ]


def test_what_cannot_be_written_is_said_and_nothing_is_left(stored_run, tmp_path, monkeypatch, capsys):
    folder = stored_run("shells-twin")
    for name in ("a.txt", "a"):
        assert main(["replay", str(folder), "0", "--out", str(tmp_path / name)]) == 2
        assert "a.html" in capsys.readouterr().err
    damaged = copy_of(folder, tmp_path / "damaged")
    truncate(part_files(damaged)[0])
    assert main(["replay", str(damaged), "0", "--out", str(tmp_path / "a.csv")]) == 2
    monkeypatch.setitem(sys.modules, "scenariogeneration", None)
    monkeypatch.delitem(sys.modules, "harness.report.openscenario", raising=False)
    assert main(["replay", str(folder), "0", "--out", str(tmp_path / "a.xosc")]) == 2
    assert "pip install -c requirements.lock -e '.[export]'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]


FILES = {"test.sumocfg", "test.net.xml", "test.add.xml", "test.fcd.xml", "test.view.xml"}


def simulated(file: Path, tmp_path: Path) -> tuple[dict, list]:
    """What plain sumo says of its configuration: each vehicle's state in each step, and who collides when."""
    written = "--fcd-output", tmp_path / "states.xml", "--collision-output", tmp_path / "hits.xml", "--precision", "15"
    done = subprocess.run([sumo_program("sumo", "test"), "-c", file.name, *written], cwd=file.parent, check=True)
    assert done.returncode == 0
    states = {
        (round(10 * float(frame.get("time"))), each.get("id")): each
        for frame in ElementTree.parse(tmp_path / "states.xml").getroot()
        for each in frame
    }
    hits = ElementTree.parse(tmp_path / "hits.xml").getroot()
    return states, [(round(10 * float(hit.get("time"))), hit.get("collider"), hit.get("victim")) for hit in hits]


@pytest.mark.parametrize(
    ("name", "scenario"),
    [
        pytest.param("shells-twin", "cut_in", id="at once", marks=pytest.mark.slow),
        pytest.param("shells-lateral-twin", "cut_in", id="comes over"),
        pytest.param("", "lead_brakes", id="lead brakes", marks=pytest.mark.slow),
        pytest.param("", "cut_out", id="cut-out"),
    ],
)
def test_plain_sumo_repeats_the_motion_and_the_crash(name, scenario, crashing, stored_run, tmp_path, capsys):
    folder = stored_run(name) if name else crashing[scenario]
    for episode in crashed(folder, 2):
        place = tmp_path / "a, b" / f"{episode}"
        assert main(["replay", str(folder), str(episode), "--sumo", str(place)]) == 0
        assert {file.name for file in place.iterdir()} == FILES
        assert str(place / "test.sumocfg") in capsys.readouterr().out
        states, hits = simulated(place / "test.sumocfg", tmp_path)
        result = harness.replay(folder, episode)
        first, n_steps = result.scene["first"], result.row["n_steps"]
        assert hits == [(n_steps, "AV", result.scene["principal"])]
        for row in result.trace.to_pylist():
            if row["step"] < first:
                continue
            state = states[row["step"], row["vehicle"]]
            assert float(state.get("pos")) == pytest.approx(row["x_m"], rel=0, abs=1e-12)
            if row["step"] > first:  # at first SUMO lets them in as fast as it finds safe
                assert float(state.get("speed")) == pytest.approx(row["v_mps"], rel=0, abs=1e-12)
            assert state.get("lane") == f"cell0_{row['lane']}"


def test_a_test_without_a_crash_ends_without_a_collision(stored_run, tmp_path):
    folder = stored_run("nde-twin")
    table = harness.read(folder).episodes(["episode", "outcome", "event_step"])
    for of in (table[(table.outcome != "crash") & table.event_step.notna()], table[table.event_step.isna()]):
        result = harness.replay(folder, int(of.iloc[0].episode))
        states, hits = simulated(write_sumo(result, tmp_path / "a&b.sumocfg")[0], tmp_path)
        assert hits == []
        assert max(step for step, _ in states) == result.row["n_steps"] + 1


def test_without_its_extra_or_a_screen_the_gui_is_refused_in_words(stored_run, monkeypatch, capsys, tmp_path):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "sumo", None)
        patch.setenv("PATH", str(tmp_path))
        with pytest.raises(
            CampaignError, match=r"found no sumo-gui; .* the extra .* -c requirements.lock -e '\.\[sumo\]'"
        ):
            gui_program()
        folder = str(stored_run("shells-twin"))
        assert main(["replay", folder, "3", "--sumo", str(tmp_path / "sumo")]) == 0
        own = tmp_path / "sumo-gui"
        own.write_text("#!/bin/sh\nexit 3\n")
        own.chmod(0o755)
        patch.setenv("DISPLAY", ":none")
        assert gui_program() == own
        assert main(["replay", folder, "3", "--gui"]) == 2
        assert "a sumo-gui that ends with 3" in capsys.readouterr().err
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(CampaignError, match="DISPLAY is not set"):
        gui_program()


def test_another_driver_is_shown_until_it_no_longer_closes_in_however_long_that_takes():
    """Its ending is told by what is shown: one that brakes gently behind a standing vehicle has not stopped in 4 s."""
    v, standing = np.maximum(30.0 - 0.25 * np.arange(200), 0.0), np.zeros(200)
    assert player._last_shown(10, -1, v, standing) == 120 + player.LEFT
    assert player._last_shown(10, 60, v, standing) == 60 + player.LEFT
    assert player._last_shown(10, -1, v[:100], standing[:100]) == 99
