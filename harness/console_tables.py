"""How the command line shows results as tables, with what is to be said about them below."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from harness.runner import AvCheck, RunResult

_WIDTH_OF_FILES = 140


def print_av_check(found: AvCheck) -> None:
    """Print what is known about an AV, line by line, with a verdict first."""
    what, speed, (low, high) = found.behaviour, found.speed, found.limits_mps2
    failed = sum(found.failures.values())
    accelerations = (what.mean_acceleration_mps2, what.min_acceleration_mps2, what.max_acceleration_mps2)
    different = f"NO: {len(found.differing)} episodes differ, first {found.differing[:1]}" if found.differing else "yes"
    rows = {
        "same bits in another order and in other cells": different,
        "finite and within limits": f"NO: {failed} episodes failed" if failed else "yes",
        "cut-ins, crashes among them": f"{what.n_cut_ins}, {what.n_crashes}",
        "acceleration: mean, smallest, largest": ", ".join(f"{_defined(a)} m/s²" for a in accelerations),
        f"steps at {low:g} and at {high:g} m/s²": ", ".join(
            _defined(share, ".1%") for share in (what.share_at_min, what.share_at_max)
        ),
        "brakes after a cut-in": f"{_defined(what.braking_share, '.0%')}, median delay {_defined(what.reaction_s)} s",
        "time per step": f"{speed.us_per_step:.3g} µs, {speed.ratio:.2f} × the built-in IDM's",
        "episodes per second": f"{speed.episodes_per_s:,.0f} (built-in IDM {speed.idm_episodes_per_s:,.0f})",
    }
    title = f"AV from av.{found.source}: {found.n_episodes} episodes ({found.method}, {found.engine})"
    print_table(title, ("question", "answer"), rows.items(), texts=("question", "answer"))
    for cause, count in found.failures.items():
        click.echo(f"{count} × failed: {cause}")


def _defined(value: float | None, style: str = ".2f") -> str:
    return "-" if value is None or not math.isfinite(value) else format(value, style)


def print_estimates(content: dict[str, Any], asked: Sequence[str] = ()) -> None:
    """Print ``estimates.json`` as a table, with warnings and reasons below and the answer in a sentence last.

    ``asked`` are the estimators to show, all by default. What is said in the end is about them.
    """
    shown = {name: entry for name, entry in content["estimates"].items() if not asked or name in asked}
    title = f"{content['campaign']}: {content['n_crashes']:,} crashes in {content['n_episodes']:,} tests"
    level = f"{content['confidence']:.0%} interval"
    headings = ("estimator", "crash rate per test", level, "RHW", "effective crashes", "largest weight share")
    rows = [(name + (" *" if name == content["headline"] else ""), *_cells(entry)) for name, entry in shown.items()]
    print_table(title, headings, rows, texts=("estimator",))
    answered = content["headline"] in shown
    for name, entry in shown.items():
        # Without the campaign's own estimator the reason is the answer, and comes last.
        for remark in [*entry.get("warnings", ()), *filter(None, [entry.get("reason") if answered else None])]:
            click.echo(f"{name}: {remark}")
    if shells := shown.get("shells", {}).get("details", {}).get("shells"):
        _print_shells(shells)
    if answered:
        print_statements(content)
        return
    for name in shown:
        click.echo(f"{name}: {content['statements'][name]}")
    if any(entry["crash_rate"] is not None for entry in shown.values()):
        click.echo(content["scope"])


def print_pool(content: dict[str, Any]) -> None:
    """Print a pool: its surrogates from careful to careless, and the shells between them."""
    headings = ("surrogate", "crash rate per test", "std. error", "probability of its shell")
    rows = []
    for entry in content["surrogates"]:
        marks = {content["boundary"]: " (boundary)", content["envelope"]: " (envelope)"}
        error = entry["std_error"] / entry["crash_rate"] if entry["crash_rate"] else math.nan
        rate, p = f"{entry['crash_rate']:.3e}", f"{entry['shell_probability']:.3e}"
        rows.append((entry["name"] + marks.get(entry["name"], ""), rate, _defined(error, ".2%"), p))
    rows.append(("nobody crashes", "", "", f"{content['no_surrogate_crashes']:.3e}"))
    print_table(f"Pool {content['pool']}: {content['n_paths']:,} paths", headings, rows, texts=("surrogate",))
    error = content["p_cut_in_std_error"] / content["p_cut_in"]
    click.echo(f"BV cuts in in {content['p_cut_in']:.3e} of all tests (standard error {error:.2%}).")
    for name, delay_s in content["delays_after_cut_in_s"].items():
        click.echo(f"{name} begins to brake {delay_s:.2f} s after a dangerous cut-in: it has seen BV come over.")


def print_statements(content: dict[str, Any]) -> None:
    """Print the answer in a sentence, what else is stated under which assumption, and what all this is about."""
    if decision := content.get("decision"):
        click.echo(decision["sentence"])
    click.echo(content["statement"])
    for name, sentence in content.get("boundary_statements", {}).items():
        click.echo(f"Statement {name}: {sentence}")
    for sentence in (*content.get("reference_statements", [])[1:], content["scope"]):
        click.echo(sentence)


def print_result(result: RunResult) -> None:
    """Print what a run says, why it ended, and where all of it is."""
    print_statements(result.estimates)
    click.echo(result.ending)
    click.echo(str(result.report))
    click.echo(str(result.folder / "estimates.json"))


def _print_shells(shells: list[dict[str, Any]]) -> None:
    headings = ("first to crash", "probability", "tests", "crashes", "contribution to the crash rate")
    rows = [
        (
            shell["shell"] + ("" if shell["inside"] else " (beyond every boundary)"),
            f"{shell['p']:.3e}",
            f"{shell['n_episodes']:,}",
            f"{shell['n_crashes']:,}",
            f"{shell['contribution']:.3e}",
        )
        for shell in shells
    ]
    print_table("Shells, from careful to careless", headings, rows, texts=("first to crash",))


def _cells(entry: dict[str, Any]) -> list[str]:
    if entry["crash_rate"] is None:
        return ["-"] * 5
    interval = f"{_defined(entry['ci_low'], '.3e')} to {_defined(entry['ci_high'], '.3e')}"
    formats = {"n_effective": ",.1f", "largest_weight_share": ".2%"}
    others = [_defined(entry[key], style) for key, style in formats.items()]
    return [f"{entry['crash_rate']:.4e}", interval, _half_width(entry["rhw"]), *others]


def _half_width(rhw: float | None) -> str:
    from harness.estimators.estimate import WIDEST_RHW  # noqa: PLC0415 - keeps --help fast

    return f"> {WIDEST_RHW:g}" if rhw is not None and rhw > WIDEST_RHW else _defined(rhw, ".3f")


def print_table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], *, texts: Collection[str]) -> None:
    """Print a table; columns headed by one of ``texts`` are flush left, and nothing is cut off."""
    from rich.console import Console  # noqa: PLC0415 - keeps --help fast
    from rich.table import Table  # noqa: PLC0415 - keeps --help fast

    table = Table(title=title)
    for heading in headings:
        table.add_column(heading, justify="left" if heading in texts else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console = Console()
    if not console.is_terminal:
        console.width = _WIDTH_OF_FILES
    console.print(table)
