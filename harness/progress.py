"""Progress of a campaign: what the runner reports, and how a terminal or a log shows it."""

from __future__ import annotations

import math
import sys
import threading
import time
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bars

Figure = float | int | str

_BAR_WIDTH = 12  # leaves room for all figures on a terminal of 80 columns
LINE_INTERVAL_S = 30.0
END_SHOWN_FROM_S = 600.0
_HALF_A_DAY_S = 43_200.0
_CLOCK_S = 1e-6
_RECKONED_WITH = ("rhw", "crashes", "heaviest")


class Progress:
    """What the runner tells about its work; shown to nobody, as for files, pipes and the Python API.

    Nothing that is told here changes a result.
    """

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        """Begin a stage of ``total`` units (None: not known), ``done`` of which were finished by an earlier run."""

    def advance(self, n: int) -> None:
        """Report ``n`` more units as finished."""

    def status(self, **figures: Figure) -> None:
        """Show figures beside the bar; ``crashes`` and ``rhw`` also give the time left."""


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


class ShownProgress(Progress):
    """What is to be shown: work done, units per second, crashes so far, current RHW, time left.

    Use as a context manager. This one itself shows nothing.

    The share is that of the work which is thought necessary: a campaign that stops on precision ends at 100 %, however
    little of its budget it took.

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
        self._stream = stream or sys.stderr
        self._target_rhw, self._min_crashes = target_rhw, min_crashes
        self._begin("", None, 0)

    def _begin(self, name: str, budget: int | None, done: int) -> None:
        self._name, self._budget, self._done_before, self._done = name, budget, done, done
        self._began_s = time.monotonic()
        self._figures: dict[str, Figure] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Show no more."""

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        """Begin a stage; the last one is shown no more."""
        self._begin(name, total, done)

    def advance(self, n: int) -> None:
        """Count, and renew rate and time left."""
        self._done += n

    def status(self, **figures: Figure) -> None:
        """Show figures, keeping those not named."""
        self._figures = self._figures | figures  # a new one: a thread may be reading the old

    def _left(self) -> int | None:
        if self._budget is None:
            return None
        known = {name: float(figure) for name, figure in self._figures.items() if name in _RECKONED_WITH}
        target, crashes = self._target_rhw, self._min_crashes
        return episodes_left(self._done, self._budget, target_rhw=target, min_crashes=crashes, **known)

    def _words(self) -> str:
        """Rate, figures, and time left, of what this run itself has done: an earlier run's share took no time now."""
        figures = [_worded(name, figure) for name, figure in self._figures.items()]
        rate_per_s = (self._done - self._done_before) / max(time.monotonic() - self._began_s, _CLOCK_S)
        if rate_per_s <= 0.0:
            return " · ".join(figures)
        left = self._left()
        end = [] if left is None else [_end(left / rate_per_s)]
        return " · ".join([_rate(rate_per_s), *figures, *end])


class RichProgress(ShownProgress):
    """A bar on a terminal."""

    def __init__(self, target_rhw: float | None = None, min_crashes: int = 0, stream: TextIO | None = None) -> None:
        super().__init__(target_rhw, min_crashes, stream)
        self._bars = Bars(
            TextColumn("{task.description}"),
            BarColumn(bar_width=_BAR_WIDTH),
            TaskProgressColumn(),
            TextColumn("{task.fields[figures]}"),
            console=Console(file=self._stream),
        )
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        """Begin a bar; it takes the place of the last stage's, for there is one line on the terminal."""
        super().stage(name, total, done=done)
        if self._task is not None:
            self._bars.update(self._task, visible=False)
        self._task = self._bars.add_task(name, total=total, completed=done, figures="")

    def advance(self, n: int) -> None:
        """Move the bar on."""
        super().advance(n)
        self._show()

    def status(self, **figures: Figure) -> None:
        """Show figures beside the bar."""
        super().status(**figures)
        self._show()

    def _show(self) -> None:
        if self._task is not None:
            left = self._left()
            total = None if left is None else self._done + left
            self._bars.update(self._task, completed=self._done, total=total, figures=self._words())


class LineProgress(ShownProgress):
    """A line every half a minute, for logs; nothing of work that takes less.

    ``interval_s`` is the time between lines.
    """

    def __init__(
        self,
        target_rhw: float | None = None,
        min_crashes: int = 0,
        stream: TextIO | None = None,
        *,
        interval_s: float = LINE_INTERVAL_S,
    ) -> None:
        super().__init__(target_rhw, min_crashes, stream)
        self._interval_s = interval_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._print_lines, daemon=True)  # a shard may take longer than that

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _print_lines(self) -> None:
        while not self._ended.wait(self._interval_s):
            if self._name:  # until a stage begins there is nothing to say
                print(self.line(), file=self._stream, flush=True)

    def line(self) -> str:
        """What there is to say now, with the time of day."""
        left = self._left()
        of = "" if left is None else f" of {self._done + left:,}"
        done = f" {self._done:,}{of}" if self._done else ""
        return f"{time.strftime('%H:%M:%S')} {self._name}:{done} · {self._words()}".rstrip(" ·:")


def shown_progress(target_rhw: float | None = None, min_crashes: int = 0, *, quiet: bool = False) -> ShownProgress:
    """Give a bar when stderr is a terminal, else lines: a log file is no place for a bar. Nothing at all if quiet."""
    kind = ShownProgress if quiet else RichProgress if sys.stderr.isatty() else LineProgress
    return kind(target_rhw, min_crashes)


def _worded(name: str, figure: Figure) -> str:
    label = {"rhw": "RHW"}.get(name, name.replace("_", " "))
    if isinstance(figure, int):
        return f"{label} {figure:,}"
    if figure == math.inf:
        return f"{label} unknown"
    return f"{label} {figure:.2g}" if isinstance(figure, float) else f"{label} {figure}"


def _rate(per_s: float) -> str:
    if per_s < 1.0:
        return f"{1.0 / per_s:,.3g} s each"
    return f"{per_s:,.0f}/s" if per_s >= 10.0 else f"{per_s:.2g}/s"


def _end(left_s: float) -> str:
    """The time left; of what takes long also the time of day, and of what takes very long the day."""
    left = f"{_clock(left_s)} left"
    if left_s < END_SHOWN_FROM_S:
        return left
    end = time.localtime(time.time() + left_s)
    return f"{left}, until {time.strftime('%a %H:%M' if left_s > _HALF_A_DAY_S else '%H:%M', end)}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
