"""What the player plays is what was simulated, and what the twin says of others; which crashes come first."""

import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

import harness
from harness.campaign.files import load_campaign
from harness.cli import main
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_in.words import STAND_INS
from harness.records.reader import traffic_of
from harness.report import crashes, player
from harness.report.player import UNKNOWN, Scenes
from harness.report.summary import read_run_folder, summarise
from harness.resolved import resolve
from harness.runner.stored import write_report
from harness.vehicles.kinematics import VEHICLE_LENGTH_M
from tests.stored_runs import copy_of, stored_table

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
        touched = [fact for name, fact in scene["facts"] if name == "AV" and "BV strikes its side" in fact]
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
    rows, _ = crashes.crash_gallery(
        run := read_run_folder(folder), summarise(run), traffic_of(run.campaign, run.manifest)
    )
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


@pytest.mark.parametrize(
    ("speed", "ahead", "onset", "said"),
    [
        (21.0, 7.0, 0, "no crash until the test ends, 1.5 m behind BV and still 1.0 m/s faster"),
        (20.0, 7.0, 0, "avoids it, 2.0 m at the closest"),
        (20.0, 7.0, -1, "avoids it, 2.0 m at the closest since BV entered the lane"),
        (20.0, 5.02, 0, "avoids it, < 0.1 m at the closest"),
    ],
)
def test_a_test_that_ends_while_the_vehicle_closes_in_has_avoided_nothing(speed, ahead, onset, said):
    time_s = np.arange(6) / 10
    bv = {"name": "BV", "x": ahead + 20.0 * time_s, "v": np.full(6, 20.0)}
    av = {"x": speed * time_s, "v": np.full(6, speed), "crash": None}
    assert player._ending(av, bv, {"first": 0, "event": 0, "onset": onset}, CUT_IN) == said


@pytest.mark.parametrize("scenario", ["lead_brakes", "cut_out"])
def test_others_who_follow_are_told_with_their_headway(scenario, crashing, tmp_path):
    page = write_report(copy_of(crashing[scenario], tmp_path / "run"))
    scene = scenes_in(page.read_text(encoding="utf-8"))[0]
    at, lead = scene["onset"] - scene["first"], scene["tracks"][0]
    for ghost in scene["ghosts"]:
        headway_s = (lead["x"][at] - VEHICLE_LENGTH_M - ghost["x"][at]) / ghost["v"][at]
        assert f", {headway_s:.1f} s behind at the onset: " in dict(scene["facts"])[ghost["name"]]
