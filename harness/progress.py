"""Progress of a campaign: what the runner reports, and how a terminal shows it."""

from __future__ import annotations

import math
import sys
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bars

Figure = float | int | str

_BAR_WIDTH = 12  # leaves room for all figures on a terminal of 80 columns
_RECKONED_WITH = ("rhw", "crashes", "heaviest")


class Progress:
    """What the runner tells about its work, and nobody shows. Nothing that is told here changes a result."""

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        """Begin a stage of ``total`` units (None: not known), ``done`` of which were finished by an earlier run."""

    def advance(self, n: int) -> None:
        """Report ``n`` more units as finished."""

    def status(self, **figures: Figure) -> None:
        """Show figures beside the bar; ``crashes`` and ``rhw`` also give the time left."""


class SilentProgress(Progress):
    """Shows nothing: for files, pipes, tests and the Python API."""


def episodes_left(
    done: int,
    total: int,
    *,
    rhw: float | None = None,
    target_rhw: float | None = None,
    crashes: float | None = None,
    min_crashes: float = 0,
    heaviest: float = 0.0,
) -> int:
    """Estimate how many more episodes a campaign needs until it stops.

    The relative half-width falls as 1/√n and crashes come at a steady rate, so that a target needs about
    n·(rhw/target)² episodes. One crash of the largest weight moves the estimate in proportion to 1/n, and may do so by
    no more than the target (`harness.estimators.stopping`). The budget ``total`` ends the campaign in any case.
    """
    if not done or target_rhw is None or rhw is None or not crashes:
        return max(total - done, 0)
    # No ratio beyond the budget matters, and an infinite one could not be squared.
    ratio = min(rhw / target_rhw, math.sqrt(total))
    needed = done * max(ratio * ratio, min_crashes / crashes, min(heaviest / target_rhw, total))
    return max(math.ceil(min(needed, total)) - done, 0)


class RichProgress(Progress):
    """A bar on a terminal: share done, episodes per second, crashes so far, current RHW, time left.

    The share is that of the work which is thought necessary: a campaign that stops on precision ends at 100 %, however
    little of its budget it took. Use as a context manager.

    Parameters
    ----------
    target_rhw : float, optional
        Relative half-width at which the campaign stops; without it the time left is that of the whole budget.
    min_crashes : int
        Crashes that it needs before it may stop.
    stream : text stream, optional
        Stderr by default, since stdout is for results.
    """

    def __init__(self, target_rhw: float | None = None, min_crashes: int = 0, stream: TextIO | None = None) -> None:
        self._bars = Bars(
            TextColumn("{task.description}"),
            BarColumn(bar_width=_BAR_WIDTH),
            TaskProgressColumn(),
            TextColumn("{task.fields[figures]}"),
            console=Console(file=stream or sys.stderr),
        )
        self._target_rhw, self._min_crashes = target_rhw, min_crashes
        self._task: TaskID | None = None
        self._figures: dict[str, Figure] = {}
        self._done_before = 0
        self._budget: int | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        """Begin a bar; it takes the place of the last stage's, for there is one line on the terminal."""
        if self._task is not None:
            self._bars.update(self._task, visible=False)
        self._figures, self._done_before, self._budget = {}, done, total
        self._task = self._bars.add_task(name, total=total, completed=done, figures="")

    def advance(self, n: int) -> None:
        """Move the bar on, and renew rate and time left."""
        if self._task is not None:
            self._bars.advance(self._task, n)
            self._show()

    def status(self, **figures: Figure) -> None:
        """Show figures beside the bar, keeping those not named."""
        self._figures |= figures
        self._show()

    def _show(self) -> None:
        if self._task is not None:
            figures = [_worded(name, figure) for name, figure in self._figures.items()]
            n_left = self._left()
            rate, left = self._pace(n_left)
            total = None if n_left is None else int(self._bars.tasks[-1].completed) + n_left
            self._bars.update(self._task, total=total, figures=" · ".join([*rate, *figures, *left]))

    def _pace(self, n_left: int | None) -> tuple[list[str], list[str]]:
        """Rate, and time left, of what this run itself has done: an earlier run's share took no time now."""
        task = self._bars.tasks[-1]
        if not task.elapsed or task.completed <= self._done_before:
            return [], []
        rate_per_s = (task.completed - self._done_before) / task.elapsed
        rate = [f"{rate_per_s:,.0f}/s" if rate_per_s >= 10 else f"{rate_per_s:.2g}/s"]
        return rate, [] if n_left is None else [f"{_clock(n_left / rate_per_s)} left"]

    def _left(self) -> int | None:
        if self._budget is None:
            return None
        known = {name: float(figure) for name, figure in self._figures.items() if name in _RECKONED_WITH}
        done = int(self._bars.tasks[-1].completed)
        return episodes_left(done, self._budget, target_rhw=self._target_rhw, min_crashes=self._min_crashes, **known)


def terminal_progress(target_rhw: float | None = None, min_crashes: int = 0) -> RichProgress | None:
    """Give a bar when stderr is a terminal, else None: a log file is no place for one."""
    return RichProgress(target_rhw, min_crashes) if sys.stderr.isatty() else None


def _worded(name: str, figure: Figure) -> str:
    label = {"rhw": "RHW"}.get(name, name.replace("_", " "))
    if isinstance(figure, int):
        return f"{label} {figure:,}"
    if figure == math.inf:
        return f"{label} unknown"
    return f"{label} {figure:.2g}" if isinstance(figure, float) else f"{label} {figure}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
