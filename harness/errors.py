"""Errors that a user of the harness can cause, each with its exit code.

Every message says four things: where (YAML path or file), what was found, what was expected, and how to mend it.
Anything that is *not* a `HarnessError` is a defect of the harness itself and is shown with its traceback.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

EXIT_DONE = 0
EXIT_BAD_INPUT = 2
EXIT_TOO_MANY_FAILED = 3
EXIT_BUDGET_SPENT = 4
EXIT_REFUTED = 5

OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""Errors of the operating system about the disk, not the file."""
MEND_PART = "Delete this file and run again with --resume: the same tests are made anew."
LONGEST_PART = 400
"""Characters of a part of a message: five lines of a terminal. What a user typed may be as long as they like."""
LONGEST_ADVICE = 1200
"""Advice may hold several commands."""


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    r"""The text with control characters as ``\u001b``: what a user named may move a cursor, or end an XML document.

    So are marks that turn the direction of writing, and halves of surrogate pairs, which no encoding has. JSON stays
    the same JSON.
    """
    return _CONTROL.sub(lambda match: f"\\u{ord(match.group()):04x}", text)


def shortened(text: str, most: int = LONGEST_PART) -> str:
    """The text as it is `printable`, or its beginning with its full length where that is longer than ``most``."""
    text = printable(text)
    if len(text) <= most:
        return text
    end = f"… ({len(text):,} characters)"
    return text[: most - len(end)] + end


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Let an error of the system that is raised while ``path`` is written name it: a full disk by itself does not."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


class HarnessError(Exception):
    """Base of all errors that a user can cause and mend; its parts are `shortened`, for they may repeat what was given.

    ``where`` is a YAML path (``testing.alpha``), a file, or an option of the command line. ``problems`` are those of a
    file in which several were found at once, each with its own place; empty where there is one.
    """

    exit_code = EXIT_BAD_INPUT
    problems: tuple[HarnessError, ...] = ()

    def __init__(self, where: str, found: str, expected: str, mend: str) -> None:
        super().__init__(where, found, expected, mend)
        self.where, self.found, self.expected = map(shortened, (where, found, expected))
        self.mend = shortened(mend, LONGEST_ADVICE)

    def __str__(self) -> str:
        of_each = (f"\n  {problem}" for problem in self.problems)
        return "".join((f"{self.where}: found {self.found}; expected {self.expected}. {self.mend}", *of_each))


@contextmanager
def told_of(whom: str) -> Iterator[None]:
    """Add to an error which of several vehicles or scenarios it is about."""
    try:
        yield
    except HarnessError as error:
        error.where += f" ({whom})" if whom else ""
        raise


class CampaignError(HarnessError):
    """The campaign file, or a file that it names, is wrong."""


class TrajectoryError(HarnessError):
    """Trajectories, or how their columns are to be read, are wrong."""


class RunFolderError(HarnessError):
    """The output folder holds something else, or its records are damaged."""


class WorldDisagreementError(HarnessError):
    """SUMO did something else than it was told: the run cannot be trusted and stops."""

    exit_code = EXIT_TOO_MANY_FAILED


class TooManyFailedError(HarnessError):
    """More episodes failed than the campaign allows."""

    exit_code = EXIT_TOO_MANY_FAILED
