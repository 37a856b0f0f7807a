"""Progress of a campaign: what the runner reports, and how a terminal or a log shows it."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Self, TextIO

from harness.numbers import count, duration, share, words

if TYPE_CHECKING:
    from rich.progress import Task

Figure = float | int | str
_SIGNS = {"rhw": "±", "asked": "asked ±"}
"""What is a share of the rate."""


class Progress:
    """Reports of the runner about its work; this class shows nothing, as for the Python API. No result depends on it.

    Setting ``cancelled`` ends the work of another thread when it next reports something.
    """

    cancelled, remark = False, ""
    """``remark`` is added to the names of later stages."""

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        """Begin a stage of ``total`` units (None: not known), ``done`` of which were finished by an earlier run."""

    def advance(self, n: int, **counts: int) -> None:  # noqa: ARG002 - for those who show it
        """Report ``n`` more units as finished, and what else is counted; KeyboardInterrupt if cancelled."""
        if self.cancelled:
            raise KeyboardInterrupt

    def status(self, **figures: Figure) -> None:
        """Show figures beside the bar, keeping those not named."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Show no more."""


class ShownProgress(Progress):
    """One bar on a terminal; elsewhere, for logs, a line every ``interval_s``, and none for shorter work.

    The stream is stderr by default, since stdout is for results.
    """

    def __init__(self, stream: TextIO | None = None, *, interval_s: float = 30.0) -> None:
        from rich.console import Console  # noqa: PLC0415 - what shows nothing needs none
        from rich.progress import BarColumn, TaskProgressColumn  # noqa: PLC0415
        from rich.progress import Progress as Bars  # noqa: PLC0415

        self._stream, self._interval_s = stream or sys.stderr, interval_s
        columns = "{task.description}", BarColumn(bar_width=12), TaskProgressColumn(), "{task.fields[words]}"
        self._bars = Bars(*columns, console=Console(file=self._stream))
        self._ended, self._told = threading.Event(), False
        self._thread = threading.Thread(target=self._print_lines, daemon=True)  # a shard may take longer than that

    def __enter__(self) -> Self:
        self.stage("preparing", None)
        if self._stream.isatty():
            self._bars.start()
        else:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        else:
            self._bars.stop()

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        """Begin a bar in place of the last one; a log gets a line at once if it has one already, or if some is done."""
        name += self.remark + (f" ({count(done)} kept)" if done else "")
        if total is None and [name] == [task.description for task in self._bars.tasks]:
            return  # the same stage, of the next scenario
        for task_id in self._bars.task_ids:
            self._bars.remove_task(task_id)
        self._bars.add_task(name, total=total, completed=done, before=done, figures={}, words="")
        if self._told or done:
            self._print()

    def advance(self, n: int, **counts: int) -> None:
        """Move the bar on, and add up figures beside it."""
        super().advance(n)
        for task in self._bars.tasks:  # one, or none before the first stage
            self._bars.update(task.id, advance=n)
            task.fields["figures"] |= {name: task.fields["figures"].get(name, 0) + m for name, m in counts.items()}
        self.status()

    def status(self, **figures: Figure) -> None:
        """Show figures beside the bar, keeping those not named."""
        for task in self._bars.tasks:
            task.fields["figures"] |= figures
            self._bars.update(task.id, words=_words(task))

    def _print_lines(self) -> None:
        while not self._ended.wait(self._interval_s):
            self._print()

    def _print(self) -> None:
        for line in self.lines():
            self._told = True
            print(line, file=self._stream, flush=True)

    def lines(self) -> Iterator[str]:
        """Lines for a log, with the time of day; none until a stage begins."""
        for task in self._bars.tasks:
            of_total = f" of {count(task.total)}" if task.total is not None else ""
            so_far = task.completed if task.total is None else min(task.completed, task.total)  # rounds may go beyond
            text = " · ".join(filter(None, (f"{count(so_far)}{of_total}" if so_far else "", _words(task))))
            yield f"{time.strftime('%H:%M:%S')} {task.description}: {text}".rstrip(" :")


def _words(task: Task) -> str:
    """Rate, figures, and time left, by the work of this run alone, without what an earlier run had done.

    A relative half-width of 1 or more is left out: it says nothing yet.
    """
    figures = [
        f"{_SIGNS[name]} {share(figure)}" if name in _SIGNS else f"{name.replace('_', ' ')} {words(figure, 2)}"
        for name, figure in task.fields["figures"].items()
        if not isinstance(figure, float) or figure < 1.0
    ]
    done, took_s = task.completed - task.fields["before"], task.elapsed or 0.0
    if done <= 0 or not took_s:
        return " · ".join([*figures, *([] if took_s < 1.0 else [f"for {duration(took_s)}"])])
    s_each = took_s / done
    rate = f"{count(1.0 / s_each)}/s" if s_each < 1.0 else f"{duration(s_each)} each"
    missing = 0.0 if task.total is None else task.total - task.completed
    return " · ".join([rate, *figures, *([f"{duration(missing * s_each)} left"] if missing > 0.0 else [])])
