"""Put pages together, of a run, of several scenarios, of a comparison: draw, tell in rows, fill the template."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from harness.campaign.files import dump_campaign
from harness.estimators.traffic import Sensitivity, tests_of_sum
from harness.numbers import count, leaves
from harness.records.folder import SENSITIVITY, read_as, write_bytes
from harness.report import several
from harness.report.crashes import Replay, crash_gallery, crashing_pairs, scenes_of, shown_of
from harness.report.drawing import Plot, style_of_plots
from harness.report.plots import convergence_plot, sensitivity_plot, severity_plot, shells_plot, where_plot
from harness.report.summary import RunFolder, RunSummary, summarise, typed
from harness.report.templates import write_page
from harness.report.words import short_answer
from harness.vocabulary import FAILED, OUTCOMES

PLOT_NAMES = re.compile(r"(severity|where|shells|sensitivity|convergence)\.svg")


def write_page_of(run: RunFolder) -> Path:
    """Write the page of a run in hand: none of its files is read but traces of crashes."""
    folder, summary, family = run.path, summarise(run), run.family
    plots = _plots(run, summary)
    gallery, scenes = crash_gallery(run, summary)
    answer = short_answer(run.campaign, run.manifest, run.estimates)
    _write_plots(folder / "plots", plots)
    return write_page(
        folder / "report.html", "report.html.j2",
        run=run, answer=answer, summary=summary, gallery=gallery, scenes=scenes,
        shows=run.manifest["events_show"],
        figures={plot.name: plot for plot in plots}, family=family, words=family.words, shown=shown_of(family),
        outcomes=list(zip(OUTCOMES, summary.count, summary.weight, strict=True)),
        estimators=sorted(run.estimates.estimates.items(), key=lambda item: item[0] != run.estimates.headline),
        warnings=[*answer.warnings, *uncovered(run, summary)],
        diagnostics=[
            (name, value) for name, value in leaves(run.estimates.diagnostics)
            if run.shells is None or value not in (None, {})
        ],
        settings=dump_campaign(run.campaign), folder=typed(run.path),
    )  # fmt: skip


def write_hours(folder: Path, content: dict[str, Any]) -> Path:
    """Write the page of several scenarios: the sum, each one's part of it, and the way to each one's own page."""
    return write_page(
        folder / "report.html", "hours.html.j2",
        content=content, answer=several.answer_of_sum(content, readings=True),
        rows=[(row, content["families"][row[0]]) for row in several.family_rows(content)],
        exposures=several.exposures(content), called=several.called,
        moved=_sensitivity(folder, tests_of_sum(content), str(folder)), folder=typed(folder),
    )  # fmt: skip


def write_comparison(folder: Path, stored: dict[str, Any], runs: Sequence[RunFolder], replay: Replay) -> Path:
    """Write the page of a comparison in hand; ``replay`` runs a test of one of its folders again."""
    pairs, campaign = crashing_pairs(runs, stored["shells"]), runs[0].campaign
    family = runs[0].family
    answers = [short_answer(run.campaign, run.manifest, run.estimates) for run in runs]
    rows_of_each = [{row.key: row for row in answer.rows} for answer in answers]
    shown = {"ratio": "× competent driver", "impact": "impact"}
    return _write_comparison(
        folder, stored, [(answer.vehicle, answer.parameters) for answer in answers],
        [(what, [rows.get(key) for rows in rows_of_each]) for key, what in shown.items()],
        above=campaign.crash.counts_above_mps, level=campaign.environment.lane_change_level,
        family=family, words=family.words, plot=pairs.plot(family),
        scenes=list(scenes_of(runs, pairs, replay)), counts=pairs.counts,
    )  # fmt: skip


def write_comparison_of_sum(folder: Path, stored: dict[str, Any]) -> Path:
    """Write the page of a comparison in several scenarios: the sum, and the way to each one's own page."""
    beside = [several.beside_row("", stored[side], stored[side]["beside"]) for side in "ab"]
    scenarios = [
        (several.called(name), name, pair, several.ratio_words(pair), several.pair_words(pair["decision"], pair))
        for name, pair in stored["families"].items()
    ]
    vehicles = [(campaign["label"], ()) for campaign in stored["campaigns"].values()]
    return _write_comparison(folder, stored, vehicles, [("× competent driver", beside)], above=0.0, scenarios=scenarios)


def _write_comparison(
    folder: Path, stored: dict[str, Any], vehicles: Iterable[tuple[Any, ...]], rows: Sequence[Any], **content: Any
) -> Path:
    """Write the page of either comparison; ``rows`` are further rows of its table, with cells for A and for B."""
    asked, sides = several.pair_asked(stored), zip("AB", vehicles, strict=True)
    return write_page(
        folder / "report.html", "compare.html.j2",
        compared=stored, asked=asked, given=asked is not stored, ratio=several.ratio_words(asked),
        verdict=several.pair_words(stored["decision"], asked), to_decide=several.deciding_words(stored),
        warnings=list(several.pair_warnings(stored)), vehicles=[(name, *vehicle) for name, vehicle in sides],
        rates=[several.rates_of(stored[side]) for side in "ab"],
        rows=rows, **content,
    )  # fmt: skip


def _plots(run: RunFolder, summary: RunSummary) -> list[Plot]:
    plots = [
        severity_plot(run.estimates),
        where_plot(run, summary),
        None if run.shells is None else shells_plot(run.shells),
        _sensitivity(run.path, run.manifest["campaign_hash"], typed(run.path)),
        convergence_plot(run),
    ]
    return [plot for plot in plots if plot is not None]


def _sensitivity(folder: Path, campaign_hash: str, typed: str) -> Plot | None:
    """Plot of what `harness sensitivity` has found; None where it has not been run, or on tests of another campaign."""
    if not (file := folder / SENSITIVITY).is_file():
        return None
    sensitivity = read_as(Sensitivity, file, mend=f"Make it again with `harness sensitivity {typed}`.")
    return sensitivity_plot(sensitivity) if sensitivity.campaign_hash == campaign_hash and sensitivity.shown else None


def _write_plots(folder: Path, plots: list[Plot]) -> None:
    folder.mkdir(exist_ok=True)
    files = {f"{plot.name}.svg": plot.file(style_of_plots()) for plot in plots}
    for name, content in files.items():
        write_bytes(folder / name, content)
    for old in folder.iterdir():
        if old.name not in files and PLOT_NAMES.fullmatch(old.name):
            old.unlink()


def uncovered(run: RunFolder, summary: RunSummary) -> list[str]:
    """A warning of estimates that are not of these records."""
    n_tests, n_estimated = summary.n_episodes, run.estimates.n_episodes
    if n_estimated in (n_tests, n_tests - int(summary.count[FAILED])):
        return []
    message = f"the estimates cover {count(n_estimated)} tests but the records hold {count(n_tests)}"
    return [f"{message}: run harness estimate {typed(run.path)} --write"]
