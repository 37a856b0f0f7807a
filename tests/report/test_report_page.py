"""The page of each kind of run: what it says, that it is self-contained, and that it comes out the same again."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from made_run import RECIPES, SHELLS, write_run
from report_page import edit, page_of, require_sound_page

from harness.report import write_report
from harness.report.run_folder import read_run_folder, typed_folder
from harness.report.summary import summarise
from harness.report.tables import run_notes

ALWAYS, OF_CRASHES = {"answer", "convergence"}, {"cut_ins", "impact_speed", "crash_time"}
OF_WEIGHTED_CRASHES = OF_CRASHES | {"weights", "strata"}
EXPECTED = {
    "full": ALWAYS | OF_WEIGHTED_CRASHES,
    "no_crashes": ALWAYS | {"weights", "cut_ins"},
    "bare": ALWAYS | OF_WEIGHTED_CRASHES,
    "nde": ALWAYS | OF_CRASHES,
    "nde_no_crashes": ALWAYS,
    "failed": ALWAYS | OF_WEIGHTED_CRASHES,
}


@pytest.mark.parametrize("name", [name for name in RECIPES if name not in SHELLS])
def test_the_page_is_sound(reports, name):
    require_sound_page(reports[name], EXPECTED[name])


def test_worst_crashes_have_diagrams_and_replay_commands(reports):
    page = page_of(reports["full"])
    diagrams = [name for name in page.ids if name.startswith("plot-crash-")]
    assert 3 <= len(diagrams) <= 6
    for diagram in diagrams:
        assert f"harness replay run {int(diagram.removeprefix('plot-crash-'))}" in page.text


def test_without_traces_the_page_says_how_to_get_them(reports):
    page = page_of(reports["bare"])
    assert not [name for name in page.ids if name.startswith("plot-crash-")]
    assert "--set records.traces=crash" in page.text
    assert "harness replay run" in page.text


def test_without_crashes_the_page_says_so_and_shows_no_replay(reports):
    page = page_of(reports["no_crashes"])
    assert "No crash was sampled" in page.text
    assert "harness replay" not in page.text
    assert "nan" not in re.sub(r"naturalistic|[a-z]*nan[a-z]+", "", page.text.lower())


def test_plain_naturalistic_driving_has_no_weights_to_show(reports):
    page = page_of(reports["nde"])
    assert "Every weight is exactly 1" in page.text
    assert "weight no." not in page.text
    assert "impact no. 1" in page.text


def test_failed_episodes_are_counted_and_explained(reports):
    page = page_of(reports["failed"])
    assert "25 of 1,500 tests failed" in page.text
    assert "the world lost vehicle AV" in page.text


def test_rhw_that_was_not_reached_and_stale_estimates_are_said(run_folder):
    estimates = edit(run_folder / "estimates.json", n_episodes=2_000)["estimates"]
    estimates["mixture_cv"]["rhw"] = 0.7
    edit(run_folder / "estimates.json", estimates=estimates)
    run = read_run_folder(run_folder)
    notes = "\n".join(run_notes(run, summarise(run)))
    assert "asked relative half-width of 0.1 was not reached: it is 0.700 (stop.episodes was spent; raise" in notes
    assert "cover 2,000 tests but the records hold 3,000" in notes


def test_all_settings_are_listed_with_their_meaning(reports):
    page = page_of(reports["full"])
    assert "hardest braking a_min [assumed]" in page.text
    assert "lane_change_level" in page.text
    assert "SM-III.parameters.min_acceleration_mps2" in page.text


def test_hostile_texts_are_escaped_and_no_formula(tmp_path):
    hostile = "<script>alert('x')</script>$\\frac{&"
    folder = write_run(tmp_path / "run", replace(RECIPES["no_crashes"], n_episodes=300))
    edit(folder / "campaign.yaml", description=hostile)
    path = folder / "estimates.json"
    estimates = edit(path, campaign=hostile, statement=hostile, headline=hostile)["estimates"]
    edit(path, estimates=estimates | {hostile: {**estimates["nade"], "warnings": [hostile]}})
    write_report(folder)
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert "<script" not in html
    assert page_of(folder).text.count(hostile) >= 5


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_report_made_again_has_the_same_bytes_whatever_the_plot_settings(reports, tmp_path):
    """Plots of an earlier report go, other files stay, and no figure leaks."""
    folder = shutil.copytree(reports["full"], tmp_path / "run")
    before, figures = contents(folder), plt.get_fignums()
    for name in ("crash-999999999.svg", "my-notes.svg"):
        (folder / "plots" / name).write_text("left over")
    with plt.rc_context({"font.size": 30.0, "lines.linewidth": 9.0}):
        assert write_report(folder) == folder / "report.html"
        assert plt.rcParams["font.size"] == 30.0
    assert contents(folder) == before | {"plots/my-notes.svg": b"left over"}
    assert plt.get_fignums() == figures


def test_a_folder_below_the_working_directory_is_named_by_its_path(folders, tmp_path, monkeypatch):
    shutil.copytree(folders["bare"], tmp_path / "runs/my run")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("harness.report.page._plots", lambda *_: [])  # they take seconds
    write_report(tmp_path / "runs/my run")
    page = page_of(tmp_path / "runs/my run")
    assert "harness replay 'runs/my run' " in page.text
    assert "harness run 'runs/my run'/campaign.yaml --out again" in page.text
    assert str(tmp_path) not in page.text


def test_any_other_folder_goes_by_its_name_and_the_page_says_what_that_is(reports):
    text = page_of(reports["full"]).words
    assert "harness report run " in text
    assert "run is the folder (DIR) that this page lies in" in text
    assert str(reports["full"].parent) not in text


@pytest.mark.parametrize(("typed", "shown"), [("runs/a", "runs/a"), ("runs/../runs/a/", "runs/a"), ("link", "link")])
def test_typed_folder(typed, shown, tmp_path, monkeypatch):
    (tmp_path / "here/runs/a").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "here/link").symlink_to(tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path / "here")
    assert typed_folder(tmp_path / "here" / typed) == shown
    assert typed_folder(tmp_path / "elsewhere") == "elsewhere"
    assert typed_folder(tmp_path / "here") == "."
