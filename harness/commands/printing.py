"""What commands print: errors on stderr; results on stdout, as JSON, sentences and tables."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, TextIO

import click

from harness.errors import HarnessError, printable
from harness.numbers import count, half_width, interval, share, words
from harness.printed import PRINTED, Kept, Printed

_WIDTH_OF_FILES = 140


def say(*lines: object, err: bool = False) -> None:
    """Print lines; control characters in what a user named, as a folder, do not reach the terminal.

    A reader that has gone, as ``head``, is no error: the command still ends with its own exit code.
    """
    try:
        click.echo(printable("\n".join(map(str, lines))), err=err)
    except BrokenPipeError:
        go_on_unread(sys.stderr if err else sys.stdout)


@contextmanager
def prints_kept_in(folder: Path | None = None) -> Iterator[None]:
    """Write what workers print to a file of the run folder, and name it; to stderr if nothing was run there.

    Without a folder only the number of lines is given.
    """
    began = time.time()
    before, Printed.kept = Printed.kept, (kept := Kept())
    try:
        yield
    finally:
        Printed.kept = before
        with suppress(OSError):  # the error that ends the command is more important
            manifests = () if folder is None else folder.rglob("manifest.json")
            if folder is not None and not any(manifest.stat().st_mtime >= began for manifest in manifests):
                os.write(2, kept.text)
            elif first := kept.text.strip().partition(b"\n")[0].decode(errors="replace"):
                line = f"{count(kept.n_lines)} lines printed by the vehicle (or SUMO)"
                if folder is not None:
                    with (folder / PRINTED).open("ab") as file:
                        file.write(kept.text)
                    line += f": {folder / PRINTED}"
                say(line, f"  the first: {first[:80]}", err=True)


def go_on_unread(stream: TextIO) -> None:
    """Send a stream into nothing from here on, also what the interpreter flushes at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def show_error(error: HarnessError) -> None:
    """Print an error on stderr: where it is, and what was found, expected and can be done, each on its line."""
    if error.problems:
        click.secho("error:", fg="red", bold=True, err=True, nl=False)
        say(f" {error.where}: {error.found}", err=True)
    for part in error.problems or (error,):
        click.secho("error:", fg="red", bold=True, err=True, nl=False)
        parts = {"found:": part.found, "expected:": part.expected, "fix:": part.mend}
        # In documents a command stands in backquotes, which a shell would run.
        say(f" {part.where}", *(f"  {name:<9} {text}".replace("`", "'") for name, text in parts.items()), err=True)


@contextmanager
def error_in(junit: Path | None, suite: str) -> Iterator[None]:
    """Write an error, as there is no verdict then, also into the JUnit file, if one is asked for."""
    try:
        yield
    except HarnessError as error:
        if junit is not None:
            from harness.report.junit import Case, write_junit

            write_junit(junit, suite, Case("run", str(error), "error", verdict=f"{error.where}: {error.found}"), [])
        raise


_AGAIN = "Nothing finished is lost: then give the same command again (`run` with --resume)."
_HOW_TO_GO_ON = {
    "run": " Nothing finished is lost: the same command with --resume goes on.",
    "compare": " Nothing finished is lost: the same command goes on.",
}


def show_interrupted(command: str, signal_name: str | None) -> None:
    """Say that the user or the system asked for the end, and that nothing finished is lost."""
    sender = f" by {signal_name}" if signal_name not in (None, "SIGINT") else ""
    with suppress(OSError):  # after SIGHUP there may be no terminal left
        click.echo(f"Interrupted{sender}.{_HOW_TO_GO_ON.get(command, '')}", err=True)


def holds_tests(folder: Path) -> bool:
    """Whether a run has finished something in a folder, or in one below it."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        manifests = [json.loads(path.read_bytes()) for path in folder.rglob("manifest.json")]
        return any(manifest["n_episodes"] or manifest["before"] for manifest in manifests)
    return True  # something is there, if it cannot be read


_OF_THE_SYSTEM = (
    (("ENOSPC", "EDQUOT"), "no space left", "room for what is written there", f"Free some space. {_AGAIN}"),
    (("EFBIG", "EIO"), "a file that cannot be written or read on ({})",
     "a sound disk, and no limit on the size of files (`ulimit -f`)",
     f"Lift the limit or choose another disk. {_AGAIN}"),
    (("ENAMETOOLONG", "ELOOP", "ENOTDIR"), "a name that the system refuses ({})", "the name of a file or folder",
     "Correct it."),
    (("EACCES", "EPERM", "EROFS"), "no permission ({})", "a place that may be read and written",
     "Change its permissions, or choose another place."),
    (("EMFILE", "ENFILE"), "no more files ({})", "some that may be open", f"Lift the limit (`ulimit -n`). {_AGAIN}"),
    (("EEXIST",), "a file", "a folder, or a place for one", "Move it away."),
    (("EISDIR",), "a path that leads to no file ({})", "a file, or a place for one", "Correct the path."),
)  # fmt: skip
"""Errors that a user can mend: which, what was found and expected, and how."""


def system_error(error: OSError | MemoryError) -> HarnessError | None:
    """Translate an error of the operating system that a user can mend; None for any other."""
    if isinstance(error, MemoryError):
        mend = f"Use fewer --workers, or lift the limit (`ulimit -v`, or one that the vehicle has set). {_AGAIN}"
        return HarnessError("memory", "none left", "room for the tests of each worker", mend)
    if isinstance(error, shutil.Error):  # all files of a folder that cannot be copied, and why
        (where, _, why), mend = error.args[0][0], "Restore it, or change its permissions."
        return HarnessError(str(where), why.partition("] ")[2], "a file that can be copied", mend)
    name = errno.errorcode.get(error.errno or 0)
    where = str(error.filename or "disk of the output folder")
    if name == "ENOENT" and error.filename is None:  # raised by os.getcwd
        return HarnessError("current folder", "that it has been removed", "a folder", "Go to one that is there (cd).")
    for names, found, expected, mend in _OF_THE_SYSTEM:
        if name in names:
            return HarnessError(where, found.format(error.strerror), expected, mend)
    return None


def usage_error(error: click.UsageError, context: click.Context) -> HarnessError:
    """Put what click says of a wrong call into the words of all errors."""
    usage = " ".join(context.get_usage().removeprefix("Usage: ").split())
    found = error.format_message().rstrip(".").replace("a valid integer range", "a whole number")
    found = found.replace("a valid float range", "a number")
    mend = f"See `{context.command_path} --help`."
    if isinstance(error, click.NoSuchOption):
        found = f"No such option '{error.option_name}'"
        options = [option for parameter in context.command.params for option in parameter.opts if len(option) > 2]
        longer = [option for option in options if error.option_name.startswith(option)]  # --output
        if not longer and (setting := _setting_of(error.option_name, context.command)):
            mend = f"Write --set {setting}=…"
        elif meant := [*longer, *(error.possibilities or ())]:
            mend = f"Did you mean '{meant[0]}'?"
    elif "extra argument" in found:
        mend = f"A setting is one word, as in --set stop.rhw=0.1; else see `{context.command_path} --help`."
    return HarnessError(context.command_path, found, f"a call of the form: {usage}", mend)


def _setting_of(option: str, command: click.Command) -> str:
    """The campaign's key of the same name as an unknown option; empty if there is none, or no ``--set``."""
    from harness.campaign.campaign import Campaign
    from harness.campaign.models import places_of

    *sections, key = option.lstrip("-").replace("-", "_").split(".")
    places = [f"{section}.{key}".lstrip(".") for section in places_of(key, Campaign)]
    places = [place for place in places if place.endswith(".".join([*sections, key]))]
    takes_settings = any("--set" in parameter.opts for parameter in command.params)
    return min(places, key=lambda place: place.count("."), default="") if takes_settings else ""


def print_json(content: Any) -> None:
    """Print strict JSON (no NaN) on stdout."""
    say(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False))


def print_either(content: Any, lines: Iterable[object], *, as_json: bool) -> None:
    """Print an answer as JSON, or in lines."""
    if as_json:
        print_json(content)
    else:
        say(*lines)


MOST_NAME = 40
"""Characters up to which names in a table's first column are not broken."""


def print_table(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print mappings of the same keys as a table; numbers to four digits and flush right, and nothing is cut off."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    for heading, cell in rows[0].items():
        justify: Literal["left", "right"] = "left" if isinstance(cell, str) else "right"
        table.add_column(heading.replace("_", " "), justify=justify, overflow="fold")
    table.columns[0].no_wrap = max(len(words(next(iter(row.values())))) for row in rows) <= MOST_NAME
    for row in rows:
        table.add_row(*(printable(words(cell, 4)) for cell in row.values()))
    console = Console()
    if not console.is_terminal and not os.environ.get("COLUMNS"):
        console.width = _WIDTH_OF_FILES
    console.print(table)


def print_estimates(content: dict[str, Any], estimators: Sequence[str]) -> None:
    """Print the estimators of ``estimates.json`` that are asked for as a table, with warnings and reasons below."""
    from harness.report.notes import note_words

    entries = {name: entry for name, entry in content["estimates"].items() if name in estimators}
    rows = [
        {
            "estimator": name + (" *" if name == content["headline"] else ""),
            "crash rate per test": entry["crash_rate"],
            f"{share(content['confidence'])} interval": interval(entry.get("ci_low"), entry.get("ci_high")),
            "RHW": "none, see below" if entry.get("cautions") else half_width(entry.get("rhw")),
            "effective crashes": entry.get("n_effective"),
            "largest weight share": share(entry.get("largest_weight_share")),
        }
        for name, entry in entries.items()
        if entry["crash_rate"] is not None  # else there is but a reason
    ]
    if rows:
        print_table(f"{content['campaign']}: {content['n_crashes']:,} crashes in {content['n_episodes']:,} tests", rows)
    for name, entry in entries.items():
        for remark in [*entry.get("warnings", ()), *filter(None, [entry.get("why")])]:
            say(f"{name}: {note_words(remark)}")
    if shells := entries.get("shells", {}).get("details", {}).get("shells"):
        names = ("shell", "inside", "p", "n_episodes", "n_crashes", "contribution")
        print_table("Shells, from careful to careless", [{name: shell[name] for name in names} for shell in shells])
