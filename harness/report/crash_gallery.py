"""The worst crashes: a table of them, and a time-space diagram of each that was traced."""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

from harness.report.number_format import number
from harness.report.plot_style import Plot
from harness.report.run_folder import RunFolder, typed_folder
from harness.report.shard_tables import trace_rows
from harness.report.shells_result import shells_result
from harness.report.summary import RunSummary
from harness.report.time_space_plot import TRACE_COLUMNS, time_space_plot, tracks_of
from harness.report.worst_crashes import Crash

SHOWN_PER_RANKING = 3


@dataclass(frozen=True)
class GalleryRow:
    """One crash in the table: why it is there, how to see it again, and its diagram if it was traced."""

    crash: Crash
    reason: str
    share_of_estimate: float
    component: str
    command: str
    plot: Plot | None


def crash_gallery(run: RunFolder, summary: RunSummary) -> list[GalleryRow]:
    """Hardest impacts first, then the largest weights (of shells: the outermost) that are not among them.

    Traced crashes go first where some of the worst have no trace: a diagram is worth more than a rank.

    Raises
    ------
    RunFolderError
        If a traces shard is damaged.
    """
    rankings = [(summary.hardest.crashes, "impact")]
    if summary.from_shells:
        rankings.append((summary.outermost.crashes, "outermost"))
    elif not summary.all_weights_one:
        rankings.append((summary.heaviest.crashes, "weight"))
    traces = trace_rows(run, {crash.episode for ranked, _ in rankings for crash in ranked}, TRACE_COLUMNS)
    traced = set() if traces is None else set(traces.column("episode").unique().to_pylist())
    reasons: dict[Crash, list[str]] = {}
    for ranked, reason in rankings:
        chosen = sorted(enumerate(ranked, 1), key=lambda item: item[1].episode not in traced)[:SHOWN_PER_RANKING]
        for rank, crash in sorted(chosen, key=lambda item: item[0]):
            reasons.setdefault(crash, []).append(f"{reason} no. {rank}")
    return [
        GalleryRow(
            crash=crash,
            reason=", ".join(why),
            share_of_estimate=_share(crash, summary),
            component=component_name(run, crash.component),
            command=replay_command(run, crash.episode),
            plot=_diagram(run, summary, crash, traces) if crash.episode in traced else None,
        )
        for crash, why in reasons.items()
    ]


def _diagram(run: RunFolder, summary: RunSummary, crash: Crash, traces: pa.Table) -> Plot:
    worth = f"weight {number(crash.weight)}"
    if summary.from_shells:
        worth = f"in the shell {component_name(run, crash.component)}, adding {number(crash.weight)} to the rate"
    return time_space_plot(crash, tracks_of(traces, crash.episode), worth=worth)


def replay_command(run: RunFolder, episode: int) -> str:
    """Return the shell command that runs an episode again, bit for bit."""
    return f"harness replay {typed_folder(run.path)} {episode}"


def component_name(run: RunFolder, component: int) -> str:
    """Name the shell of an episode, or the importance function it followed, of which the forced cut-in is the first."""
    if component < 0:
        return "–"
    surrogates, shells = run.campaign.get("surrogates"), shells_result(run.estimates)
    names = ["forced", *(surrogates if isinstance(surrogates, dict) else ())]
    if shells is not None:
        names = [shell.name for shell in shells.shells]
    return str(names[component]) if component < len(names) else str(component)


def _share(crash: Crash, summary: RunSummary) -> float:
    total = float(summary.log10_weight_crash.weight.sum())
    return crash.weight / total if total > 0.0 else float("nan")
