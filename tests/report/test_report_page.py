"""The page of each kind of run: what it says, that it is self-contained, and that it comes out the same again."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import pytest
from report_page import edit, page_of
from synthetic_run import RECIPES, write_run

from harness.report import write_report
from harness.report.run_folder import read_run_folder, typed_folder
from harness.report.summary import summarise
from harness.report.tables import run_notes

ALWAYS = {"answer", "convergence"}
OF_WEIGHTS = {"weights"}
OF_CRASHES = {"cut_ins", "impact_speed", "crash_time"}
EXPECTED = {
    "full": ALWAYS | OF_WEIGHTS | OF_CRASHES | {"strata", "contrast"},
    "no_crashes": ALWAYS | OF_WEIGHTS | {"cut_ins"},
    "bare": ALWAYS | OF_WEIGHTS | OF_CRASHES | {"strata", "contrast"},
    "nde": ALWAYS | OF_CRASHES | {"contrast"},
    "nde_no_crashes": ALWAYS,
    "failed": ALWAYS | OF_WEIGHTS | OF_CRASHES | {"strata", "contrast"},
    "shells": ALWAYS | OF_CRASHES | {"shells"},
    "shells_refuted": ALWAYS | OF_CRASHES | {"shells", "contrast"},
    "shells_no_crashes": ALWAYS | {"cut_ins", "shells"},
    "shells_inside_only": ALWAYS | OF_CRASHES | {"shells"},
}


@pytest.fixture(params=RECIPES)
def report(request, reports):
    return reports[request.param]


def test_page_has_statement_estimators_and_level(report):
    page, estimates = page_of(report), json.loads((report / "estimates.json").read_text())
    assert estimates["statement"] in page.text
    for estimator, content in estimates["estimates"].items():
        assert estimator in page.text
        for text in [*content.get("warnings", []), *([content["reason"]] if "reason" in content else [])]:
            assert text[1:] in page.text
    assert "sampling error in this environment" in page.text
    assert f"lane-change level {estimates['lane_change_level']:g}" in page.text


def test_page_is_self_contained_with_unique_ids_and_no_dead_links(report):
    html, page = (report / "report.html").read_text(encoding="utf-8"), page_of(report)
    assert "://" not in html
    assert len(page.ids) == len(set(page.ids))
    for tag, attribute, value in page.attributes:
        assert tag not in {"script", "link", "iframe"}
        assert not attribute.startswith("on")
        if attribute in {"href", "xlink:href", "src"}:
            assert value.startswith("#")
            assert value[1:] in page.ids
    references = re.findall(r"url\(([^)]*)\)", html)
    assert {reference[1:] for reference in references} <= set(page.ids)


@pytest.mark.parametrize("name", RECIPES)
def test_exactly_the_plots_that_make_sense_exist_as_png_and_svg(reports, name):
    folder = reports[name] / "plots"
    stems = {path.stem for path in folder.iterdir()}
    assert {stem for stem in stems if not stem.startswith("crash-")} == EXPECTED[name]
    for stem in stems:
        assert (folder / f"{stem}.png").read_bytes().startswith(b"\x89PNG")
        ElementTree.parse(folder / f"{stem}.svg")
        assert f"plot-{stem}" in page_of(reports[name]).ids
    assert {path.suffix for path in folder.iterdir()} == {".png", ".svg"}


def test_every_plot_has_alt_text_and_caption(report):
    html = (report / "report.html").read_text(encoding="utf-8")
    figures = re.findall(r"<figure.*?</figure>", html, flags=re.DOTALL)
    assert figures
    for figure in figures:
        assert len(re.search(r'aria-label="([^"]*)"', figure).group(1)) > 40
        assert len(re.search(r"<figcaption>(.*?)<span", figure, re.DOTALL).group(1)) > 40


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


def test_estimators_without_a_value_take_one_line(reports):
    text = page_of(reports["shells"]).words
    assert "No value" not in text
    assert "4 more need other records than these: nde, nade, mixture_cv, scv" in text


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


@pytest.fixture(scope="module")
def rerun(reports, tmp_path_factory) -> dict:
    """The full run's report made again, by a caller with other plot settings, over left-over files."""
    folder = tmp_path_factory.mktemp("rerun") / "run"
    shutil.copytree(reports["full"], folder)
    before = contents(folder)
    for name in ("crash-999999999.svg", "my-notes.svg"):
        (folder / "plots" / name).write_text("left over")
    figures = plt.get_fignums()
    with plt.rc_context({"font.size": 30.0, "lines.linewidth": 9.0}):
        returned = write_report(folder)
        font_size = plt.rcParams["font.size"]
    return {
        "folder": folder, "before": before, "after": contents(folder), "returned": returned, "font_size": font_size,
        "new_figures": set(plt.get_fignums()) - set(figures),
    }  # fmt: skip


def test_same_folder_gives_same_bytes_whatever_the_plot_settings(rerun):
    assert {name: rerun["after"].get(name) for name in rerun["before"]} == rerun["before"]
    assert rerun["font_size"] == 30.0


def test_plots_of_an_earlier_report_go_but_other_files_stay(rerun):
    assert set(rerun["after"]) - set(rerun["before"]) == {"plots/my-notes.svg"}
    assert rerun["after"]["plots/my-notes.svg"] == b"left over"


def test_no_figure_leaks_and_the_page_is_returned(rerun):
    assert rerun["new_figures"] == set()
    assert rerun["returned"] == rerun["folder"] / "report.html"


def test_a_folder_below_the_working_directory_is_named_by_its_path(reports, tmp_path, monkeypatch):
    shutil.copytree(reports["bare"], tmp_path / "runs/my run")
    monkeypatch.chdir(tmp_path)
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
