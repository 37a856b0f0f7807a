"""Episodes for other tools: what they hold is the trace, and a checker of the format has no complaint."""

import csv
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from qc_baselib import Configuration, Result
from qc_openscenario.main import run_checks

import harness
from harness.cli import main
from harness.report.player import LANE_M
from harness.vocabulary import VEHICLES
from tests.stored_runs import copy_of, part_files, truncate


def complaints(file):
    """Of ASAM's own checker: schema, references, names."""
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
