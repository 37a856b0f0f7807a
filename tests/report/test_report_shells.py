"""The report of a shells run: both statements, every shell, and weighted figures that add up to the estimate."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from made_run import DESIGN, PATH_MASS, SHELLS, P
from report_page import edit, page_of, require_sound_page

from harness.errors import RunFolderError
from harness.estimators.tally import Tally, pool_variance
from harness.report import write_report
from harness.report.answer_plot import answer_plot
from harness.report.run_folder import read_run_folder, typed_folder
from harness.report.shells_plot import POOL, shells_plot
from harness.report.summary import RunSummary, summarise
from harness.report.tables import run_notes, verdict
from harness.vocabulary import OUTCOMES

PLOTS = {
    "shells": {"cut_ins", "impact_speed", "crash_time"},
    "shells_refuted": {"cut_ins", "impact_speed", "crash_time"},
    "shells_no_crashes": {"cut_ins"},
    "shells_inside_only": {"cut_ins", "impact_speed", "crash_time"},
}


@pytest.mark.parametrize("name", SHELLS)
def test_both_statements_lead_the_page_and_every_shell_is_named(reports, runs, name):
    require_sound_page(reports[name], {"answer", "convergence", "shells"} | PLOTS[name])
    page, estimates = page_of(reports[name]), runs[name].estimates
    text, (told,) = page.words, estimates.boundary_statements.values()
    told = told.replace("FOLDER", typed_folder(runs[name].path))
    places = [
        text.index(part)
        for part in ("Assumption-free", estimates.statement, "Statement library", told,
                     "sampling error in this environment")
    ]  # fmt: skip
    assert places == sorted(places)
    for shell in DESIGN.strata:
        assert f"{shell} {'outside' if shell == 'outside' else 'inside library'}" in text
    assert DESIGN.pool in text
    assert "2.87 × 10⁻⁶: not even full throttle" in text
    assert "3.30 × 10⁻⁵" in text
    assert "weights" not in page.ids
    for absent in ("How often each weight occurs", "mean_weight", "By stratum", "control step", "likelihood ratio"):
        assert absent not in page.text.split("All settings of the campaign")[0]


def rows_of_answer(run) -> list[str]:
    axes = answer_plot(run.estimates, run.shells).figure.axes[0]
    return [label.get_text() for label in axes.get_yticklabels()]


def test_a_refuted_assumption_is_said_so_and_its_interval_is_gone(reports, runs):
    run = runs["shells_refuted"]
    text, found = page_of(reports["shells_refuted"]).words, run.shells
    outside = found.shells[-1]
    assert found.widest.refuted
    assert "Statement library: refuted by these tests" in text
    assert f"by episode {found.widest.refuted_by[0]}," in text
    assert f"crashed in {outside.n_crashes:,} of {outside.n_episodes:,} tests there" in text
    assert "Of statement library" not in text
    assert rows_of_answer(run) == ["shells"]


def test_a_safe_outside_gives_its_bound_and_the_conditional_interval(reports, runs):
    text = page_of(reports["shells"]).words
    assert "4 more need other records than these: nde, nade, mixture_cv, scv" in text
    assert "No value" not in text
    assert "refuted by these tests" not in text
    assert "None of" in text.split("Outside every boundary")[1]
    assert rows_of_answer(runs["shells"]) == ["shells", "given library"]


def test_an_outside_without_tests_is_said_and_runs_out_of_the_plot(reports, runs):
    run = runs["shells_inside_only"]
    assert "Statement library: not put to the test" in page_of(reports["shells_inside_only"]).words
    rates, widths = shells_plot(run.shells).figure.axes
    assert [text.get_text() for text in rates.texts if "not tested" in text.get_text()] == [
        "not tested: up to 3.00 × 10⁻⁵"
    ]
    assert rates.get_xlim()[1] < 1e-6
    assert widths.get_xlim()[1] < 1e-6


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"n_checked": 0, "n_episodes_outside": 0}, "not put to the test"),
        ({"n_checked": 0, "n_episodes_outside": 5}, "no crash seen outside"),
        ({"n_checked": 9, "n_episodes_outside": 5}, "kept to in every test"),
        ({"n_checked": 9, "n_episodes_outside": 0}, "kept to in every test, none of them outside"),
        ({"n_checked": 9, "n_ahead": 1}, "no longer justified: this vehicle does not keep to it"),
        ({"n_checked": 9, "n_ahead": 1, "refuted": True}, "refuted by these tests"),
    ],
)
def test_the_label_says_what_tests_have_shown(runs, changed, said):
    assert verdict(replace(runs["shells"].shells.widest, **changed)) == said


def test_the_half_width_that_was_asked_for_is_that_of_the_statement_it_was_asked_of(reports, runs):
    """Inside alone the assumption-free half-width stays wide: only the conditional one may be held against the run."""
    run = runs["shells_inside_only"]
    assert run.headline.rhw > 10.0
    rhw = run.shells.widest.rhw
    notes = run_notes(run, summarise(run))
    assert any("not reached" in note for note in notes) == (rhw > 0.1)
    assert not any("it is 1" in note for note in notes)
    text = page_of(reports["shells_inside_only"]).words
    assert "Of statement library (asked: 0.1)" in text
    assert "Relative half-width> 10" in text
    assert "still open upwards" in text


@pytest.fixture(scope="module", params=["shells", "shells_refuted"])
def counted(request, runs):
    return runs[request.param], summarise(runs[request.param])


def test_weighted_sums_are_the_estimated_rate(counted):
    """Of each figure; and the sums of recorded weights alone, which ignore how often shells were tested, are not."""
    run, summary = counted
    rate = run.headline.crash_rate
    sums = [summary.weight[0], summary.cut_in_crash.weight.sum()] + [
        getattr(summary, name).weight.sum() for name in ("impact_speed_mps", "crash_time_s", "response_time_s")
    ]
    assert [summary.per_test(float(total)) for total in sums] == pytest.approx([rate] * len(sums), rel=1e-12)
    wrong = RunSummary()
    for batch in pq.read_table(run.path / "episodes").to_batches():
        wrong.add(batch, np.array([OUTCOMES.index(str(name)) for name in batch.column("outcome").to_pylist()]))
    assert wrong.per_test(float(wrong.weight[0])) != pytest.approx(rate, rel=0.3)


def test_all_tests_together_stand_for_all_shells(runs):
    summary = summarise(runs["shells_refuted"])
    assert summary.per_test(float(summary.weight.sum())) == pytest.approx(P.sum(), rel=1e-12)


def test_outermost_crashes_and_what_each_adds(reports, runs):
    run = runs["shells_refuted"]
    outside = run.shells.shells[-1]
    worst = summarise(run).outermost.crashes[0]
    assert worst.component == 2
    assert worst.weight == pytest.approx(outside.p / outside.n_episodes, rel=1e-12)
    text = page_of(reports["shells_refuted"]).words
    assert "outermost no. 1" in text
    assert "in the shell outside, adding" in text


def test_shares_of_uncertainty_add_up_and_the_rest_is_the_pool(runs):
    found = runs["shells_refuted"].shells
    shells = found.shells
    tests, crashes = (np.array([getattr(s, name) for s in shells]) for name in ("n_episodes", "n_crashes"))
    tally = Tally(tests, crashes, 0 * crashes, np.outer(crashes, PATH_MASS), np.zeros((3, 3)))
    variance = pool_variance(P, tally, DESIGN.n_paths)
    assert found.pool_half_width == pytest.approx(1.6448536 * variance**0.5, rel=1e-6)
    widths = [*(s.half_width for s in shells), found.pool_half_width]
    assert sum(map(found.share_of_uncertainty, widths)) == pytest.approx(1.0)


def test_the_plot_shows_contributions_and_half_widths(runs):
    found = runs["shells"].shells
    rates, widths = shells_plot(found).figure.axes
    assert [label.get_text() for label in rates.get_yticklabels()] == [*DESIGN.strata, POOL]
    assert [bar.get_width() for bar in rates.patches] == [s.contribution for s in found.shells]
    assert [bar.get_width() for bar in widths.patches] == [
        *(s.half_width for s in found.shells), found.pool_half_width
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "blue", "orange"),
    [("shells", True, False), ("shells_refuted", None, True), ("shells_no_crashes", False, False)],
)
def test_the_caption_names_the_colours_that_are_there(runs, name, blue, orange):
    found = runs[name].shells
    plot = shells_plot(found)
    axes = plot.figure.axes[0]
    seen = {
        shell.inside
        for bar, shell in zip(axes.patches, found.shells, strict=True)
        if bar.get_width() > 0.005 * axes.get_xlim()[1]
    }
    assert ("blue" in plot.caption) == (True in seen)
    assert ("orange" in plot.caption) == (False in seen) == orange
    assert blue is None or blue == (True in seen)


def test_estimates_without_part_of_the_shells_are_named(folders, tmp_path):
    folder = shutil.copytree(folders["shells"], tmp_path / "run")
    estimates = edit(folder / "estimates.json")["estimates"]
    del estimates["shells"]["details"]["shells"][0]["p"]
    edit(folder / "estimates.json", estimates=estimates)
    with pytest.raises(RunFolderError, match=r"estimates\.json.*shells\.0\.p"):
        read_run_folder(folder)


def test_tests_without_shell_are_refused(folders, tmp_path):
    """A run whose campaign says shells over records that were drawn otherwise."""
    folder = shutil.copytree(folders["nde"], tmp_path / "run")
    edit(folder / "campaign.yaml", testing={"method": "shells"})
    with pytest.raises(RunFolderError, match="without shell"):
        write_report(folder)
