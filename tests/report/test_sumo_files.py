"""An episode for SUMO itself: plain sumo repeats the motion and the collision, and sumo-gui shows them."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

import harness
from harness.cli import main
from harness.errors import CampaignError
from harness.report.sumo_files import gui_program, write_sumo
from harness.worlds.sumo import sumo_program
from tests.report.test_player import crashed

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
    [("shells-twin", "cut_in"), ("", "cut_in"), ("", "lead_brakes"), ("", "cut_out")],
    ids=["at once", "comes over", "lead brakes", "cut-out"],
)
def test_plain_sumo_repeats_the_motion_and_the_crash(name, scenario, crashing, stored_run, tmp_path, capsys):
    folder = stored_run(name) if name else crashing[scenario]
    for episode in crashed(folder, 4):
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
        own = tmp_path / "sumo-gui"
        own.write_text("#!/bin/sh\nexit 3\n")
        own.chmod(0o755)
        patch.setenv("DISPLAY", ":none")
        assert gui_program() == own
        assert main(["replay", str(stored_run("shells-twin")), "3", "--gui"]) == 2
        assert "a sumo-gui that ends with 3" in capsys.readouterr().err
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(CampaignError, match="DISPLAY is not set"):
        gui_program()
