"""How the command line shows results on stdout and complaints on stderr."""

from __future__ import annotations

import errno
import json
import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from harness.errors import HarnessError

if TYPE_CHECKING:
    import pyarrow as pa

    from harness.runner import AvCheck

_WIDTH_OF_FILES = 140


def show_error(error: HarnessError) -> None:
    """Print an error on stderr: where it is, and what was found, expected and can be done, each on its line."""
    parts = getattr(error, "problems", (error,))
    if len(parts) > 1:
        click.secho("error:", fg="red", bold=True, err=True, nl=False)
        click.echo(f" {error.where}: {len(parts)} problems", err=True)
    for part in parts:
        click.secho("error:", fg="red", bold=True, err=True, nl=False)
        click.echo(f" {part.where}", err=True)
        for label in ("found", "expected", "mend"):
            click.echo(f"  {label + ':':<9} {getattr(part, label)}", err=True)


_HOW_TO_GO_ON = {
    "run": " Finished shards are kept: the same command with --resume goes on.",
    "compare": " Finished shards are kept: the same command goes on.",
}


def show_interrupted(command: str, signal_name: str | None) -> None:
    """Say that the user or the system asked for the end, and that nothing finished is lost."""
    by = f" by {signal_name}" if signal_name not in (None, "SIGINT") else ""
    with suppress(OSError):  # after SIGHUP there may be no terminal left
        click.echo(f"Interrupted{by}.{_HOW_TO_GO_ON.get(command, '')}", err=True)


def system_error(error: OSError) -> HarnessError | None:
    """Translate an error of the operating system that a user can mend; None for any other."""
    where = str(error.filename or f"disk of the output folder, or of the cache {_cache_folder()}")
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return HarnessError(
            where,
            found="no space left",
            expected="room for what is written there",
            mend="Nothing finished is lost: free some space, then give the same command again (`run` with --resume).",
        )
    if error.errno in (errno.EFBIG, errno.EIO):
        return HarnessError(
            where,
            found=f"a file that could not be written or read on ({error.strerror})",
            expected="a sound disk, and no limit on the size of files (`ulimit -f`)",
            mend="Nothing finished is lost: lift the limit or choose another disk, then give the same command again "
            "(`run` with --resume).",
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return HarnessError(
            where,
            found=f"no permission ({error.strerror})",
            expected="a place that may be read and written",
            mend="Change its permissions, or choose another place.",
        )
    return None


def _cache_folder() -> str:
    """Where compiled kernels are kept: numba does not say of a file of its own which it was."""
    from harness.compiled import cache_root  # noqa: PLC0415 - keeps --help fast

    return str(cache_root())


def usage_error(error: click.UsageError, context: click.Context) -> HarnessError:
    """Put what click says of a wrong call into the words of all errors."""
    usage = " ".join(context.get_usage().removeprefix("Usage: ").split())
    return HarnessError(
        context.command_path,
        found=error.format_message().rstrip("."),
        expected=f"a call of the form: {usage}",
        mend=f"See `{context.command_path} --help`.",
    )


def print_json(content: Any) -> None:
    """Print strict JSON (no NaN) on stdout."""
    click.echo(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False))


def print_plan(plan: dict[str, Any]) -> None:
    """Print what a campaign will cost as YAML comments, so that the whole output stays a campaign file."""
    click.echo("# What it will cost")
    for key, value in plan.items():
        shown = f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else value
        click.echo(f"#   {key.replace('_', ' ')}: {shown}")


def print_av_check(found: AvCheck) -> None:
    """Print what is known about an AV, line by line, with a verdict first."""
    from rich.console import Console  # noqa: PLC0415 - keeps --help fast
    from rich.table import Table  # noqa: PLC0415 - keeps --help fast

    what, speed, (low, high) = found.behaviour, found.speed, found.limits_mps2
    failed = sum(found.failures.values())
    table = Table(title=f"AV from av.{found.source}: {found.n_episodes} episodes ({found.method}, {found.engine})")
    table.add_column("question")
    table.add_column("answer")
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
    for question, answer in rows.items():
        table.add_row(question, answer)
    console = Console()
    if not console.is_terminal:
        console.width = _WIDTH_OF_FILES
    console.print(table)
    for cause, count in found.failures.items():
        click.echo(f"{count} × failed: {cause}")


def _defined(value: float, style: str = ".2f") -> str:
    return format(value, style) if math.isfinite(value) else "-"


def print_estimates(content: dict[str, Any], asked: Sequence[str] = ()) -> None:
    """Print estimates as a table, with warnings and reasons below and the answer in a sentence last.

    Parameters
    ----------
    content : dict
        As in ``estimates.json``.
    asked : sequence of str
        Estimators to show; all by default. What is said in the end is about them.
    """
    from rich.console import Console  # noqa: PLC0415 - keeps --help fast
    from rich.table import Table  # noqa: PLC0415 - keeps --help fast

    shown = {name: entry for name, entry in content["estimates"].items() if not asked or name in asked}
    table = Table(title=f"{content['campaign']}: {content['n_crashes']:,} crashes in {content['n_episodes']:,} tests")
    level = f"{content['confidence']:.0%} interval"
    for heading in ("estimator", "crash rate per test", level, "RHW", "effective crashes", "largest weight share"):
        table.add_column(heading, justify="left" if heading == "estimator" else "right")
    for name, entry in shown.items():
        table.add_row(name + (" *" if name == content["headline"] else ""), *_cells(entry))
    console = Console()
    if not console.is_terminal:
        console.width = _WIDTH_OF_FILES
    console.print(table)
    answered = content["headline"] in shown
    for name, entry in shown.items():
        # Without the campaign's own estimator the reason is the answer, and comes last.
        for remark in [*entry.get("warnings", ()), *filter(None, [entry.get("reason") if answered else None])]:
            click.echo(f"{name}: {remark}")
    if shells := shown.get("shells", {}).get("details", {}).get("shells"):
        console.print(_shells_table(shells))
    if answered:
        print_statements(content)
        return
    for name in shown:
        click.echo(f"{name}: {content['statements'][name]}")
    if any(entry["crash_rate"] is not None for entry in shown.values()):
        click.echo(content["scope"])


def print_required_tests(content: dict[str, Any]) -> None:
    """Print required numbers of tests as a table, with what limits each of them below."""
    from rich.console import Console  # noqa: PLC0415 - keeps --help fast
    from rich.table import Table  # noqa: PLC0415 - keeps --help fast

    level, n_shuffles = f"{content['confidence']:.0%}", f"{content['n_shuffles']:,}"
    table = Table(title=f"Tests until RHW stays at most {content['rhw']:g} ({level} normal interval)")
    for heading in ("run", "estimator", "tests on record", "grid", "shuffles", "mean RNoT", "5-95 %", "never", "AAR"):
        table.add_column(
            heading, justify="left" if heading in ("run", "estimator", "grid") else "right", overflow="fold"
        )
    for row in content["rows"]:
        cells = ["-"] * 6
        if row["mean"] is not None:
            limit = "≥ " if row["mean_is_lower_limit"] else ""
            aar = {"equal": "", "at least": "≥ ", "at most": "≤ "}.get(row["aar_is"])
            cells = [
                row["grid"],
                n_shuffles,
                f"{limit}{row['mean']:,.0f}",
                f"{row['low_5']:,} to {row['high_95']:,}",
                f"{row['never_reached']:,}",
                "-" if aar is None else f"{aar}{row['aar']:.3g}",
            ]
        table.add_row(row["run"], row["estimator"], f"{row['n_episodes']:,}", *cells)
    console = Console()
    if not console.is_terminal:
        console.width = _WIDTH_OF_FILES
    console.print(table)
    for row in content["rows"]:
        for remark in [*row.get("remarks", ()), *filter(None, [row.get("reason")])]:
            click.echo(f"{row['run']} {row['estimator']}: {remark}")


def print_pool(content: dict[str, Any]) -> None:
    """Print a pool: its surrogates from careful to careless, and the shells between them."""
    from rich.console import Console  # noqa: PLC0415 - keeps --help fast
    from rich.table import Table  # noqa: PLC0415 - keeps --help fast

    table = Table(title=f"Pool {content['pool']}: {content['n_paths']:,} paths")
    for heading in ("surrogate", "crash rate per test", "std. error", "probability of its shell"):
        table.add_column(heading, justify="left" if heading == "surrogate" else "right")
    for entry in content["surrogates"]:
        marks = {content["boundary"]: " (boundary)", content["envelope"]: " (envelope)"}
        error = entry["std_error"] / entry["crash_rate"] if entry["crash_rate"] else math.nan
        rate, p = f"{entry['crash_rate']:.3e}", f"{entry['shell_probability']:.3e}"
        table.add_row(entry["name"] + marks.get(entry["name"], ""), rate, _defined(error, ".2%"), p)
    table.add_row("nobody crashes", "", "", f"{content['no_surrogate_crashes']:.3e}")
    console = Console()
    if not console.is_terminal:
        console.width = _WIDTH_OF_FILES
    console.print(table)
    error = content["p_cut_in_std_error"] / content["p_cut_in"]
    click.echo(f"BV cuts in in {content['p_cut_in']:.3e} of all tests (standard error {error:.2%}).")


def print_statements(content: dict[str, Any]) -> None:
    """Print the answer in a sentence, what holds under the conditional assumption, and what all this is about."""
    for sentence in (content["statement"], content.get("conditional_statement"), content["scope"]):
        if sentence:
            click.echo(sentence)


def _shells_table(shells: list[dict[str, Any]]) -> Any:
    from rich.table import Table  # noqa: PLC0415 - keeps --help fast

    table = Table(title="Shells, from careful to careless")
    for heading in ("first to crash", "probability", "tests", "crashes", "contribution to the crash rate"):
        table.add_column(heading, justify="left" if heading == "first to crash" else "right")
    for shell in shells:
        name = shell["shell"] + ("" if shell["inside"] else " (beyond the boundary)")
        row = (
            f"{shell['p']:.3e}",
            f"{shell['n_episodes']:,}",
            f"{shell['n_crashes']:,}",
            f"{shell['contribution']:.3e}",
        )
        table.add_row(name, *row)
    return table


def _cells(entry: dict[str, Any]) -> list[str]:
    if entry["crash_rate"] is None:
        return ["-"] * 5
    interval = f"{_number(entry['ci_low'], '.3e')} to {_number(entry['ci_high'], '.3e')}"
    formats = {"n_effective": ",.1f", "largest_weight_share": ".2%"}
    others = [_number(entry[key], style) for key, style in formats.items()]
    return [f"{entry['crash_rate']:.4e}", interval, _half_width(entry["rhw"]), *others]


def _half_width(rhw: float | None) -> str:
    from harness.estimators.estimate import WIDEST_RHW  # noqa: PLC0415 - keeps --help fast

    return f"> {WIDEST_RHW:g}" if rhw is not None and rhw > WIDEST_RHW else _number(rhw, ".3f")


def _number(value: float | None, style: str) -> str:
    return "-" if value is None else format(value, style)


def write_trace(trace: pa.Table, file: Path) -> None:
    """Write an episode's trace as Parquet or, when ``file`` ends in ``.csv``, as CSV."""
    from pyarrow import csv, parquet  # noqa: PLC0415 - keeps --help fast

    from harness.records.folder import write_atomically  # noqa: PLC0415 - keeps --help fast

    if file.suffix == ".csv":
        write_atomically(file, lambda unfinished: csv.write_csv(trace, unfinished))
    else:
        write_atomically(file, lambda unfinished: parquet.write_table(trace, unfinished, compression="zstd"))
