"""Put the report together: read once, draw, fill the template, write."""

from __future__ import annotations

import re
from inspect import getmembers, isfunction
from pathlib import Path

import matplotlib.style
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from harness.records.folder import write_bytes
from harness.records.reader import table_sizes
from harness.report import number_format
from harness.report.answer_plot import answer_plot, rate_exponent
from harness.report.convergence_plot import convergence_plot
from harness.report.crash_gallery import GalleryRow, crash_gallery
from harness.report.cut_in_plot import cut_in_plot
from harness.report.histogram_plots import crash_time_plot, impact_speed_plot, strata_plot, weight_plot
from harness.report.plot_style import RC, Plot, inline_svg, png, svg
from harness.report.run_folder import RunFolder, read_run_folder, typed_folder
from harness.report.shells_plot import shells_plot
from harness.report.summary import RunSummary, lateral_facts, summarise
from harness.report.tables import RateUnit, details, diagnostics, outcome_rows, run_notes, setting_sections, verdict

PLOT_NAMES = re.compile(
    r"(answer|shells|convergence|weights|strata|contrast|cut_ins|impact_speed|crash_time|crash-\d+)\.(png|svg)"
)


def write_report(folder: Path, *, final: Path | None = None) -> Path:
    """Write ``report.html`` and ``plots/`` (PNG and SVG) into a run folder.

    The same folder gives the same bytes if it is reached from the working directory by the same relative path, by which
    the commands on the page name it; outside the working directory they use its name alone. Plots of an earlier report
    that this one does not have are removed.

    Parameters
    ----------
    folder : Path
        A finished run, as `harness run` leaves it.
    final : Path, optional
        Where it is going to be, which the commands on the page name.

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
    run = read_run_folder(folder, typed=typed_folder(final or folder))
    sizes = table_sizes(folder)
    summary = summarise(run)
    with matplotlib.style.context(["default", RC]):
        gallery = crash_gallery(run, summary)
        files, figures = _rendered(_plots(run, summary, gallery))
    style = (Path(__file__).parent / "report.css").read_text(encoding="utf-8")
    environment = Environment(
        loader=PackageLoader("harness.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(getmembers(number_format, isfunction), verdict=verdict)
    page = environment.get_template("report.html.j2").render(
        run=run,
        summary=summary,
        sizes=sizes,
        gallery=gallery,
        figures=figures,
        lateral=lateral_facts(run),
        estimators=sorted(run.estimates.estimates.items(), key=lambda item: item[0] != run.estimates.headline),
        unit=RateUnit(rate_exponent(run.estimates)),
        outcomes=outcome_rows(summary),
        notes=run_notes(run, summary),
        diagnostics=diagnostics(run),
        details=details(run),
        settings=setting_sections(run.campaign, reproducible=run.manifest.get("reproducible")),
        folder=run.typed,
        style=Markup(style),  # noqa: S704 - our own file
    )
    _write_plots(folder / "plots", files)
    write_bytes(folder / "report.html", page.encode("utf-8"))
    return folder / "report.html"


def _plots(run: RunFolder, summary: RunSummary, gallery: list[GalleryRow]) -> list[Plot]:
    # Within a shell all tests weigh the same and there is one control step, the cut-in: nothing to draw of either.
    drawn_by = [weight_plot(summary), strata_plot(summary)] if run.shells is None else [shells_plot(run.shells)]
    plots = [
        answer_plot(run.estimates, run.shells),
        convergence_plot(run.estimates, run.campaign.stop.rhw, of_statement=run.asked_statement),
        *drawn_by,
        cut_in_plot(summary),
        impact_speed_plot(summary),
        crash_time_plot(summary),
        *(row.plot for row in gallery),
    ]
    return [plot for plot in plots if plot is not None]


def _rendered(plots: list[Plot]) -> tuple[dict[str, bytes], dict[str, dict[str, str]]]:
    """Files by name, and by plot what the template needs: markup that is ours, and texts that it escapes."""
    files, figures = {}, {}
    for plot in plots:
        drawing = svg(plot)
        files[f"{plot.name}.svg"], files[f"{plot.name}.png"] = drawing, png(plot)
        # The SVG is matplotlib's own output, in which every text is escaped: the one place that is not autoescaped.
        markup = Markup(inline_svg(drawing))  # noqa: S704
        figures[plot.name] = {"markup": markup, "alt": plot.alt, "caption": plot.caption}
    return files, figures


def _write_plots(folder: Path, files: dict[str, bytes]) -> None:
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        write_bytes(folder / name, content)
    for old in folder.iterdir():
        if old.name not in files and PLOT_NAMES.fullmatch(old.name):
            old.unlink()
