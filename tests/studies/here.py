"""Work in this process, and an end to it as by Ctrl-C."""

from __future__ import annotations

from concurrent.futures import Executor

from harness.progress import Progress


class Here(Executor):
    """Works in the main thread, which alone can limit a controller's time, and where tests can look on."""

    map = staticmethod(map)


class Interrupting(Progress):
    """Ends the work after some advances within a stage."""

    def __init__(self, stage: str, after: int) -> None:
        self._asked, self._left, self._stage = stage, after, ""

    def stage(self, name: str, total: int | None, *, done: int = 0) -> None:
        self._stage = name

    def advance(self, n: int) -> None:
        self._left -= self._stage.startswith(self._asked)
        if self._left == 0:
            raise KeyboardInterrupt
