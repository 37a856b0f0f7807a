"""`harness fit` from end to end: what it writes, and what it refuses before it reads."""

import json
import os
import re
import shutil

import numpy as np
import pytest

from harness.campaign.sections import EnvironmentSettings
from harness.cli import main
from harness.errors import HarnessError, TrajectoryError
from harness.families.cut_in.fitting.hazard import FREE_TTC_S, fit_hazard
from harness.families.cut_in.fitting.laws import LAWS, FittedLaw, ObservedTraffic
from harness.families.cut_in.fitting.maximum import Maximum
from harness.families.cut_in.fitting.observations import observe
from harness.families.cut_in.loading import load_parameters
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.fitting.files import fit_files
from harness.fitting.table import load_mapping, recordings
from harness.records.reader import read_replicates
from tests.fitting.trajectories import overtaking


def test_a_fit_is_read_whatever_it_is_called_and_the_same_seed_gives_the_same_bytes(tmp_path, monkeypatch, capsys):
    """Also where all vehicles keep one distance from their leaders' speed: plots have a width nevertheless."""
    monkeypatch.chdir(tmp_path)
    overtaking(2.0).to_parquet("rows.parquet", index=False)
    assert main(["fit", "rows.parquet", "--out", "a #1: b.yaml", "--replicates", "5", "--quiet", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["recordings"] == told["lane_changes"] == 24
    parameters = load_parameters(EnvironmentSettings(parameters="./a #1: b.yaml"))
    assert len(read_replicates("./a #1: b.yaml", parameters, SHIPPED_FOLDER)) == 5
    page = (tmp_path / "a #1: b.html").read_text()
    assert "R1dot" in page
    assert (
        0 < page.index("No lane change was seen at TTC &lt; 1 s") < page.index("How to use it")
    )  # the chief finding first
    grey = re.findall(r'<tr class="open"><th scope="row"><code>(.*?)<', page)
    numbers = [parameters.numbers()[name.replace(".", "__")] for name in grey]
    assert numbers
    assert all(each.se > abs(each.value) for each in numbers)
    assert len(grey) < len(re.findall(r'<tr><th scope="row"><code>', page))
    assert main(["fit", "rows.parquet", "--out", "again/a #1: b.yaml", "--replicates", "5", "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "! only 5 replicates (a 90 % interval needs at least 20)" in out
    assert "cut_in: exposure is not fitted: kept is 0.048 per hour" in out
    assert "noise of" not in out
    mine = "harness run my_av.py:MyAV{} --set 'environment.parameters=again/a #1: b.yaml'"
    for name in ("lead_brakes", "cut_out"):
        mine += f" --set 'environments.{name}=again/a #1: b.{name}.yaml'"
    alone, _, _ = mine.format("").partition(" --set 'environments.")
    assert out.endswith(f"next: {alone}\nor: {mine.format(' --scenario all')}\n")
    again = list((tmp_path / "again").iterdir())
    assert len(again) >= 3
    for file in again:
        assert file.read_bytes() == (tmp_path / file.name).read_bytes()


def test_a_hazard_above_what_a_second_allows_is_fitted(tmp_path):
    """Where BV nearly always cuts in within a second, the likelihood once had a bend, at which no maximum was found."""
    overtaking(2.0).assign(length_m=4.5).to_parquet(tmp_path / "rows.parquet", index=False)
    traffic = ObservedTraffic.of(map(observe, recordings([tmp_path / "rows.parquet"], load_mapping())))
    risk = traffic.at_risk[traffic.at_risk["ttc_s"] > FREE_TTC_S]
    wished = float(fit_hazard(traffic).rate(risk) @ risk["duration_s"])
    assert wished == pytest.approx(risk["changes"].sum(), rel=0.1)


def test_a_law_with_a_number_that_no_environment_allows_is_named(tmp_path, monkeypatch):
    found = Maximum(np.array([1e-4]), np.full((24, 1), 1e-5), np.zeros((1, 1)))
    law = FittedLaw(("initial_state__v_scale_mps",), lambda theta: theta, found)
    monkeypatch.setitem(LAWS, "speed", (lambda *_: law, "speeds of BV"))
    overtaking(2.0).to_parquet(tmp_path / "rows.parquet", index=False)
    with pytest.raises(TrajectoryError, match=r"initial_state\.v_scale_mps.* 0\.0001"):
        fit_files([tmp_path / "rows.parquet"], tmp_path / "mine.yaml")
    names = (*law.names, "initial_state__r1dot_df")
    two = FittedLaw(names, lambda theta: np.repeat(theta, 2, axis=-1), found)
    monkeypatch.setitem(LAWS, "speed", (lambda *_: two, "speeds of BV"))
    with pytest.raises(TrajectoryError, match="2 problems") as caught:
        fit_files([tmp_path / "rows.parquet"], tmp_path / "mine.yaml")
    assert [each.found for each in caught.value.problems] == 2 * ["0.0001"]


@pytest.mark.parametrize(
    ("files", "out", "found"),
    [
        (["mine.replicates.parquet"], "mine.yaml", "mine.replicates.parquet, which is also an input"),
        (["rows.csv"], "\udcff.yaml", "in UTF-8"),
        (["rows.csv"], "map.yaml", "map.yaml, which is also an input"),
    ],
)
def test_what_is_read_is_neither_counted_twice_nor_written_over(files, out, found, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.yaml").write_text("mirror: true\n")
    with pytest.raises(HarnessError, match=found):
        fit_files(files, out, mapping="map.yaml")
    assert [file.name for file in tmp_path.iterdir()] == ["map.yaml"]


@pytest.mark.parametrize("copied", [os.symlink, pytest.param(shutil.copy, marks=pytest.mark.slow)])
def test_a_file_that_comes_twice_is_refused(copied, tmp_path):
    rows = tmp_path / "rows.parquet"
    overtaking(2.0).to_parquet(rows, index=False)
    copied(rows, tmp_path / "b.parquet")
    with pytest.raises(
        TrajectoryError, match=r"b\.parquet, recording 0: found 100% of its rows also in .*rows\.parquet, rec"
    ):
        fit_files([rows, tmp_path / "b.parquet"], tmp_path / "mine.yaml")


def test_what_no_fit_has_written_stays_unless_forced(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    overtaking(2.0).to_parquet("rows.parquet", index=False)
    command = ["fit", "rows.parquet", "--out", "my.yaml", "--replicates", "2", "--quiet"]
    for name in ("my.yaml", "my.html", "my.replicates.parquet"):
        (tmp_path / name).write_text("of my own")
        assert main(command) == 2
        assert f"{name}, which harness fit has not written" in capsys.readouterr().err
        assert (tmp_path / name).read_text() == "of my own"
        (tmp_path / name).unlink()
    (tmp_path / "my.yaml").write_text("of my own")
    assert main([*command, "--force"]) == 0
    assert "of my own" not in (tmp_path / "my.yaml").read_text()
    assert main(command) == 0


def test_replicates_belong_to_one_environment(tmp_path):
    """Neither those of another fit, nor those of other numbers."""
    overtaking(2.0).to_parquet(tmp_path / "rows.parquet", index=False)
    for i in (1, 2):
        fit_files([tmp_path / "rows.parquet"], tmp_path / f"{i}.yaml", n_replicates=2, seed=i)
    mine, replicated, other = (
        tmp_path / f"{name}" for name in ("1.yaml", "1.replicates.parquet", "2.replicates.parquet")
    )
    text, own = mine.read_text(), replicated.read_bytes()

    def read() -> int:
        name = str(mine)
        return len(read_replicates(name, load_parameters(EnvironmentSettings(parameters=name)), SHIPPED_FOLDER))

    assert read() == 2
    replicated.write_bytes(other.read_bytes())
    with pytest.raises(HarnessError, match=r"1\.replicates\.parquet: found replicates of another fit, or changed ones"):
        read()
    replicated.write_bytes(own)
    mine.write_text(re.sub(r"v_location_mps: {value: [\d.]+", r"\g<0>1", text))
    with pytest.raises(HarnessError, match=r"replicates of other numbers than those of 1\.yaml"):
        read()
    for wrong in (r"\ud800", r"a\0"):
        mine.write_text(text.replace("1.replicates.parquet", wrong))
        with pytest.raises(HarnessError, match=r"replicates\.file"):
            read()


@pytest.mark.slow
def test_a_mirror_is_given_and_taken_back(tmp_path, capsys):
    """highD's mapping has one."""
    overtaking(2.0).to_parquet(tmp_path / "rows.parquet", index=False)
    (tmp_path / "own.yaml").write_text("mirror: true\n")
    mapped = ["fit", str(tmp_path / "rows.parquet"), "--mapping", str(tmp_path / "own.yaml"), "--replicates", "2"]
    assert main([*mapped, "--out", str(tmp_path / "mine.yaml")]) == 2
    assert "Give --no-mirror" in capsys.readouterr().err
    assert main([*mapped, "--no-mirror", "--out", str(tmp_path / "mine.yaml")]) == 0
    assert "mirrored" not in (tmp_path / "mine.yaml").read_text()
