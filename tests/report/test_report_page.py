from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import pytest
from synthetic_run import RECIPES, write_run

from harness.report import write_report
from harness.report.estimate_table import run_notes
from harness.report.run_folder import read_run_folder
from harness.report.summary import summarise

VOID = {"meta", "br", "link", "img", "hr", "input"}
ALWAYS = {"answer", "convergence"}
OF_WEIGHTS = {"weights"}
OF_CRASHES = {"cut_ins", "impact_speed", "crash_time"}
EXPECTED = {
    "full": ALWAYS | OF_WEIGHTS | OF_CRASHES | {"strata", "contrast"},
    "no_crashes": ALWAYS | OF_WEIGHTS | {"cut_ins"},
    "no_traces": ALWAYS | OF_WEIGHTS | OF_CRASHES | {"strata", "contrast"},
    "no_moments": ALWAYS | OF_WEIGHTS | OF_CRASHES | {"strata", "contrast"},
    "nde": ALWAYS | OF_CRASHES | {"contrast"},
    "nde_no_crashes": ALWAYS,
    "failed": ALWAYS | OF_WEIGHTS | OF_CRASHES | {"strata", "contrast"},
    "shells": ALWAYS | OF_CRASHES | {"shells"},
    "shells_refuted": ALWAYS | OF_CRASHES | {"shells", "contrast"},
    "shells_no_crashes": ALWAYS | {"cut_ins", "shells"},
    "shells_inside_only": ALWAYS | OF_CRASHES | {"shells"},
}


class Page(HTMLParser):
    """Checks nesting while it reads, and collects text, ids, links and attributes."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def page_of(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def estimates_of(folder: Path) -> dict:
    return json.loads((folder / "estimates.json").read_text())


@pytest.mark.parametrize("name", RECIPES)
def test_page_has_statement_estimators_and_level(reports, name):
    page, estimates = page_of(reports[name]), estimates_of(reports[name])
    assert estimates["statement"] in page.text
    for estimator, content in estimates["estimates"].items():
        assert estimator in page.text
        for text in [*content.get("warnings", []), *([content["reason"]] if "reason" in content else [])]:
            assert text[1:] in page.text
    assert "sampling error in this environment" in page.text
    assert f"lane-change level {estimates['lane_change_level']:g}" in page.text


@pytest.mark.parametrize("name", RECIPES)
def test_page_is_self_contained_with_unique_ids_and_no_dead_links(reports, name):
    html = (reports[name] / "report.html").read_text(encoding="utf-8")
    page = Page(html)
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


@pytest.mark.parametrize("name", RECIPES)
def test_every_plot_has_alt_text_and_caption(reports, name):
    html = (reports[name] / "report.html").read_text(encoding="utf-8")
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
    page = page_of(reports["no_traces"])
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
    estimates = estimates_of(run_folder) | {"n_episodes": 2_000}
    estimates["estimates"][estimates["headline"]]["rhw"] = 0.7
    (run_folder / "estimates.json").write_text(json.dumps(estimates))
    run = read_run_folder(run_folder)
    notes = run_notes(run, summarise(run))
    assert any(
        note.startswith(
            "The asked relative half-width of 0.1 was not reached: it is 0.700 (stop.episodes was spent; raise"
        )
        for note in notes
    )
    assert any("cover 2,000 tests but the records hold 3,000" in note for note in notes)


def test_all_settings_are_listed_with_their_meaning(reports):
    page = page_of(reports["full"])
    assert "hardest braking a_min [assumed]" in page.text
    assert "lane_change_level" in page.text
    assert "SM-III.parameters.min_acceleration_mps2" in page.text


def test_hostile_texts_are_escaped_and_no_formula(tmp_path):
    hostile = "<script>alert('x')</script>$\\frac{&"
    folder = write_run(tmp_path / "run", replace(RECIPES["no_crashes"], n_episodes=300))
    campaign = json.loads((folder / "campaign.yaml").read_text())
    (folder / "campaign.yaml").write_text(json.dumps(campaign | {"description": hostile}))
    estimates = estimates_of(folder) | {"campaign": hostile}
    estimates["estimates"][hostile] = {**estimates["estimates"]["nade"], "warnings": [hostile]}
    estimates |= {"statement": hostile, "headline": hostile}
    (folder / "estimates.json").write_text(json.dumps(estimates))
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
