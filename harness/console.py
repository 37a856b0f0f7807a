"""What the command line says: complaints on stderr; plain results on stdout, or in a file."""

from __future__ import annotations

import errno
import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from harness.errors import HarnessError

if TYPE_CHECKING:
    import pyarrow as pa


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


def write_trace(trace: pa.Table, file: Path) -> None:
    """Write an episode's trace as Parquet or, when ``file`` ends in ``.csv``, as CSV."""
    from pyarrow import csv, parquet  # noqa: PLC0415 - keeps --help fast

    from harness.records.folder import write_atomically  # noqa: PLC0415 - keeps --help fast

    if file.suffix == ".csv":
        write_atomically(file, lambda unfinished: csv.write_csv(trace, unfinished))
    else:
        write_atomically(file, lambda unfinished: parquet.write_table(trace, unfinished, compression="zstd"))
