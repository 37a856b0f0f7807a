"""Put the report together: read once, draw, fill the template, write."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.style
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from harness.records.folder import write_bytes
from harness.records.schemas import OUTCOMES
from harness.report import number_format
from harness.report.answer_plot import answer_plot
from harness.report.contrast_plot import contrast_plot
from harness.report.convergence_plot import convergence_plot
from harness.report.crash_contrast import Contrast, band_in_words, crash_contrast
from harness.report.crash_gallery import GalleryRow, crash_gallery
from harness.report.crash_plot import crash_time_plot, impact_speed_plot
from harness.report.cut_in_conditions import CONDITIONS
from harness.report.cut_in_plot import cut_in_plot
from harness.report.estimate_table import asked_of_conditional, estimate_table, in_unit, run_notes, target_rhw
from harness.report.plot_style import RC, Plot, inline_svg, png, svg
from harness.report.run_folder import RunFolder, read_run_folder, typed_folder
from harness.report.settings_table import flat, setting_sections
from harness.report.shard_tables import table_sizes
from harness.report.shells_plot import shells_plot
from harness.report.shells_result import SHOWN_IN_SECTION, ShellsResult, shells_result
from harness.report.strata_plot import strata_plot
from harness.report.summary import RunSummary, summarise
from harness.report.telling_bands import RELABELINGS, SIGNIFICANT
from harness.report.weight_plot import weight_plot

PLOT_NAMES = re.compile(
    r"(answer|shells|convergence|weights|strata|contrast|cut_ins|impact_speed|crash_time|crash-\d+)\.(png|svg)"
)


@dataclass(frozen=True)
class Figure:
    """A plot as the template needs it: markup that is ours, texts that are escaped."""

    name: str
    markup: Markup
    alt: str
    caption: str


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and ``plots/`` (PNG and SVG) into a run folder.

    The same folder gives the same bytes if it is reached from the working directory by the same relative path, by which
    the commands on the page name it; outside the working directory they use its name alone. Plots of an earlier report
    that this one does not have are removed.

    Parameters
    ----------
    folder : Path
        A finished run, as `harness run` leaves it.

    Returns
    -------
    Path
        The page, self-contained: it can be mailed, archived and opened offline.

    Raises
    ------
    RunFolderError
        If the folder misses a file, or a file is damaged or belongs to another run.
    """
    folder = Path(folder)
    run = read_run_folder(folder)
    sizes = table_sizes(run)
    summary, shells = summarise(run), shells_result(run.estimates)
    contrast = crash_contrast(run, shells)
    with matplotlib.style.context(["default", RC]):
        gallery = crash_gallery(run, summary)
        files, figures = _rendered(_plots(run, summary, shells, contrast, gallery))
    page = _page(
        run=run, summary=summary, shells=shells, contrast=contrast, sizes=sizes, gallery=gallery, figures=figures
    )
    _write_plots(folder / "plots", files)
    write_bytes(folder / "report.html", page.encode("utf-8"))
    return folder / "report.html"


def _plots(
    run: RunFolder, summary: RunSummary, shells: ShellsResult | None, contrast: Contrast, gallery: list[GalleryRow]
) -> list[Plot]:
    # Within a shell all tests weigh the same and there is one control step, the cut-in: nothing to draw of either.
    drawn_by = [weight_plot(summary), strata_plot(summary)] if shells is None else [shells_plot(shells)]
    plots = [
        answer_plot(run.estimates),
        convergence_plot(run.estimates, target_rhw(run), of_conditional=asked_of_conditional(run)),
        *drawn_by,
        contrast_plot(contrast),
        cut_in_plot(summary),
        impact_speed_plot(summary),
        crash_time_plot(summary),
        *(row.plot for row in gallery),
    ]
    return [plot for plot in plots if plot is not None]


def _rendered(plots: list[Plot]) -> tuple[dict[str, bytes], dict[str, Figure]]:
    files: dict[str, bytes] = {}
    figures: dict[str, Figure] = {}
    for plot in plots:
        drawing = svg(plot)
        files[f"{plot.name}.svg"], files[f"{plot.name}.png"] = drawing, png(plot)
        # The SVG is matplotlib's own output, in which every text is escaped: the one place that is not autoescaped.
        figures[plot.name] = Figure(plot.name, Markup(inline_svg(drawing)), plot.alt, plot.caption)  # noqa: S704
    return files, figures


def _page(
    *,
    run: RunFolder,
    summary: RunSummary,
    shells: ShellsResult | None,
    contrast: Contrast,
    sizes: list[Any],
    gallery: list[GalleryRow],
    figures: dict[str, Figure],
) -> str:
    environment = Environment(
        loader=PackageLoader("harness.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(_filters())
    style = (Path(__file__).parent / "report.css").read_text(encoding="utf-8")
    return environment.get_template("report.html.j2").render(
        run=run,
        summary=summary,
        shells=shells,
        contrast=contrast,
        conditions=CONDITIONS,
        relabelings=RELABELINGS,
        significant=SIGNIFICANT,
        outcomes=_outcomes(summary),
        sizes=sizes,
        gallery=gallery,
        figures=figures,
        estimators=estimate_table(run.estimates),
        in_unit=in_unit(run.estimates),
        notes=run_notes(run, summary),
        target_rhw=target_rhw(run),
        asked_of_conditional=asked_of_conditional(run),
        diagnostics=_diagnostics(run, shells),
        retraced=run.manifest.get("retraced"),
        alarm=(run.estimates.get("diagnostics") or {}).get("alarm"),
        details=_details(run),
        table_errors=run.manifest.get("table_errors") or [],
        reproducible=run.manifest.get("reproducible", True),
        settings=setting_sections(run.campaign, reproducible=run.manifest.get("reproducible")),
        folder=typed_folder(run.path),
        style=Markup(style),  # noqa: S704 - our own file
    )


def _filters() -> dict[str, Callable[..., str]]:
    return {
        "band_in_words": band_in_words,
        "number": number_format.number,
        "interval": number_format.interval,
        "count": number_format.count,
        "decimal": number_format.decimal,
        "half_width": number_format.half_width,
        "percent": number_format.percent,
        "coarse_percent": number_format.coarse_percent,
        "duration": number_format.duration,
        "plain": number_format.plain,
        "size": number_format.size,
        "value": number_format.value,
        "result": number_format.result,
        "sentence": number_format.sentence,
        "signed_percent": number_format.signed_percent,
    }


def _outcomes(summary: RunSummary) -> list[tuple[str, float, float, float]]:
    """Per outcome: name, tests, share of the tests, how often it happens per naturalistic test."""
    n = max(summary.n_episodes, 1)
    return [
        (name, float(summary.count[k]), float(summary.count[k]) / n, summary.per_test(float(summary.weight[k])))
        for k, name in enumerate(OUTCOMES)
    ]


def _diagnostics(run: RunFolder, shells: ShellsResult | None) -> list[tuple[str, Any]]:
    """Return sums of the run as (key, value); of shells without those about weights, which have none to say."""
    content = run.estimates.get("diagnostics")
    leaves = flat(content) if content else []
    return leaves if shells is None else [(path, leaf) for path, leaf in leaves if leaf not in (None, {})]


def _details(run: RunFolder) -> list[tuple[str, Any]]:
    """Return what single estimators report about themselves and no other section shows, as (estimator.key, value)."""
    found = {
        name: {key: value for key, value in e["details"].items() if name != "shells" or key not in SHOWN_IN_SECTION}
        for name, e in run.estimates["estimates"].items()
        if e.get("details")
    }
    return flat(found) if found else []


def _write_plots(folder: Path, files: dict[str, bytes]) -> None:
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        write_bytes(folder / name, content)
    for old in folder.iterdir():
        if old.name not in files and PLOT_NAMES.fullmatch(old.name):
            old.unlink()
