"""The report of a shells run: both statements, every shell, and weighted figures that add up to the estimate."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from harness.report.estimate_table import run_notes
from harness.report.shells_result import shells_result
from synthetic_run import RECIPES
from synthetic_shells import DESIGN, P
from test_report_page import estimates_of, page_of

from harness.errors import RunFolderError
from harness.estimators.shells import combined, pool_variance
from harness.records.schemas import OUTCOMES
from harness.report import write_report
from harness.report.answer_plot import answer_plot
from harness.report.run_folder import read_run_folder
from harness.report.shells_plot import POOL, shells_plot
from harness.report.summary import RunSummary, summarise

SHELLS = [name for name, recipe in RECIPES.items() if recipe.method == "shells"]


def result_of(folder):
    return shells_result(estimates_of(folder))


def words(page) -> str:
    return " ".join(page.text.split())


@pytest.mark.parametrize("name", SHELLS)
def test_both_statements_lead_the_page_and_every_shell_is_named(reports, name):
    page, estimates = page_of(reports[name]), estimates_of(reports[name])
    text = words(page)
    places = [
        text.index(part)
        for part in ("Assumption-free", estimates["statement"], "Conditional on the library",
                     estimates["conditional_statement"], "sampling error in this environment")
    ]  # fmt: skip
    assert places == sorted(places)
    for shell in DESIGN.strata:
        assert f"{shell} {'outside' if shell == 'outside' else 'inside'}" in text
    assert DESIGN.pool in text
    assert "2.87 × 10⁻⁶: not even full throttle" in text
    assert "3.30 × 10⁻⁵" in text


@pytest.mark.parametrize("name", SHELLS)
def test_nothing_is_said_about_weights_or_control_steps(reports, name):
    page = page_of(reports[name])
    assert "weights" not in page.ids
    for absent in ("How often each weight occurs", "mean_weight", "By stratum", "control step", "likelihood ratio"):
        assert absent not in page.text.split("All settings of the campaign")[0]


def test_a_refuted_assumption_is_said_so_and_its_interval_is_gone(reports):
    text = words(page_of(reports["shells_refuted"]))
    found = result_of(reports["shells_refuted"])
    outside = found.shells[-1]
    assert found.conditional.refuted
    assert "Conditional on the library: refuted by these tests" in text
    assert f"crashed in {outside.n_crashes:,} of {outside.n_tests:,} tests there" in text
    assert "Conditional half-width" not in text
    assert rows_of_answer(reports["shells_refuted"]) == ["shells"]


def test_a_safe_outside_gives_its_bound_and_the_conditional_interval(reports):
    text = words(page_of(reports["shells"]))
    assert "refuted by these tests" not in text
    assert "None of" in text.split("Outside the boundary")[1]
    assert rows_of_answer(reports["shells"]) == ["shells", "if none outside"]


def rows_of_answer(folder) -> list[str]:
    axes = answer_plot(estimates_of(folder)).figure.axes[0]
    return [label.get_text() for label in axes.get_yticklabels()]


def test_an_outside_without_tests_is_said_and_runs_out_of_the_plot(reports):
    folder = reports["shells_inside_only"]
    assert "Conditional on the library: not put to the test" in words(page_of(folder))
    rates, widths = shells_plot(result_of(folder)).figure.axes
    assert [text.get_text() for text in rates.texts if "not tested" in text.get_text()] == [
        "not tested: up to 3.00 × 10⁻⁵"
    ]
    assert rates.get_xlim()[1] < 1e-6
    assert widths.get_xlim()[1] < 1e-6


def test_the_half_width_that_was_asked_for_is_that_of_the_statement_it_was_asked_of(reports):
    """Inside alone the assumption-free half-width stays wide: only the conditional one may be held against the run."""
    run = read_run_folder(reports["shells_inside_only"])
    assert run.headline["rhw"] > 10.0
    rhw = run.headline["details"]["conditional"]["rhw"]
    notes = run_notes(run, summarise(run))
    assert any("not reached" in note for note in notes) == (rhw > 0.1)
    assert not any("it is 1" in note for note in notes)
    assert "Conditional half-width (asked: 0.1)" in words(page_of(reports["shells_inside_only"]))


@pytest.fixture(scope="module", params=["shells", "shells_refuted"])
def counted(request, reports):
    folder = reports[request.param]
    return folder, summarise(read_run_folder(folder))


def test_weighted_sums_are_the_estimated_rate(counted):
    """Of each figure; and the sums of recorded weights alone, which ignore how often shells were tested, are not."""
    folder, summary = counted
    rate = estimates_of(folder)["estimates"]["shells"]["crash_rate"]
    sums = [summary.weight[0], summary.cut_in_crash.weight.sum()] + [
        getattr(summary, name).weight.sum() for name in ("impact_speed_mps", "crash_time_s", "response_time_s")
    ]
    assert [summary.per_test(float(total)) for total in sums] == pytest.approx([rate] * len(sums), rel=1e-12)
    wrong = RunSummary()
    for batch in pq.read_table(folder / "episodes").to_batches():
        wrong.add(batch, np.array([OUTCOMES.index(str(name)) for name in batch.column("outcome").to_pylist()]))
    assert wrong.per_test(float(wrong.weight[0])) != pytest.approx(rate, rel=0.3)


def test_all_tests_together_stand_for_all_shells(reports):
    summary = summarise(read_run_folder(reports["shells_refuted"]))
    assert summary.per_test(float(summary.weight.sum())) == pytest.approx(P.sum(), rel=1e-12)


def test_outermost_crashes_and_what_each_adds(reports):
    folder = reports["shells_refuted"]
    summary = summarise(read_run_folder(folder))
    outside = result_of(folder).shells[-1]
    worst = summary.outermost.crashes[0]
    assert worst.component == 2
    assert worst.weight == pytest.approx(outside.p / outside.n_tests, rel=1e-12)
    text = words(page_of(folder))
    assert "outermost no. 1" in text
    assert "in the shell outside, adding" in text


def test_shares_of_uncertainty_add_up_and_the_rest_is_the_pool(reports):
    found = result_of(reports["shells_refuted"])
    shells = found.shells
    tests, crashes = (np.array([getattr(s, name) for s in shells]) for name in ("n_tests", "n_crashes"))
    limits = combined(P, crashes, tests, DESIGN.moments, DESIGN.n_paths, 0.05)
    variance = pool_variance(crashes / tests, DESIGN.moments, limits.rate, DESIGN.n_paths)
    assert found.pool_half_width == pytest.approx(1.6448536 * variance**0.5, rel=1e-6)
    widths = [*(s.half_width for s in shells), found.pool_half_width]
    assert sum(map(found.share_of_uncertainty, widths)) == pytest.approx(1.0)


def test_the_plot_shows_contributions_and_half_widths(reports):
    found = result_of(reports["shells"])
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
def test_the_caption_names_the_colours_that_are_there(reports, name, blue, orange):
    found = result_of(reports[name])
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


def test_a_half_width_that_says_nothing_is_not_written_out(reports):
    text = words(page_of(reports["shells_inside_only"]))
    assert "Relative half-width> 10" in text
    assert "still open upwards" in text


def test_estimates_without_part_of_the_shells_are_named(reports):
    content = estimates_of(reports["shells"])
    del content["estimates"]["shells"]["details"]["shells"][0]["p"]
    with pytest.raises(RunFolderError, match=r"estimates\.json"):
        shells_result(content)


def test_tests_without_shell_are_refused(reports, tmp_path):
    """A run whose campaign says shells over records that were drawn otherwise."""
    folder = tmp_path / "run"
    shutil.copytree(reports["nde"], folder)
    campaign = json.loads((folder / "campaign.yaml").read_text())
    campaign["testing"]["method"] = "shells"
    (folder / "campaign.yaml").write_text(json.dumps(campaign))
    with pytest.raises(RunFolderError, match="without shell"):
        write_report(folder)
