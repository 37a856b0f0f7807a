"""A contender in a process of its own, measured from outside: wall time, and CPU time of all processes it has started.

libsumo holds one simulation per process, and a contender must not warm or fill another one's caches. CPU time of the
whole process tree makes ratios robust where other programs run on the same machine, and counts a SUMO server's time.
"""

from __future__ import annotations

import os
import time
import traceback
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.contenders import CONTENDERS

_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_CHECKED_EPISODES = 100


class Measurement(NamedTuple):
    """One measurement of a contender: what it did, wall time, and CPU time of all its processes."""

    episodes: int
    cell_steps: int
    wall_s: float
    cpu_s: float
    bytes_written: int
    part_s: dict[str, float] | None

    @property
    def episodes_per_cpu_s(self) -> float:
        return self.episodes / self.cpu_s

    @property
    def episodes_per_s(self) -> float:
        return self.episodes / self.wall_s

    @property
    def cpu_ns_per_cell_step(self) -> float:
        return 1e9 * self.cpu_s / self.cell_steps if self.cell_steps else float("nan")


class ContenderProcess:
    """A contender of `CONTENDERS` that waits in its own process until it is told to run.

    Raises
    ------
    RuntimeError
        It could not be built; the message is its traceback.
    """

    def __init__(self, name: str) -> None:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the child inherits it
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(name, theirs))
        self._process.start()
        theirs.close()
        self.name = name
        self.rows: bytes | None = self._answer()

    def measure(self, first: int, n: int) -> Measurement:
        """Run n episodes."""
        others_s = descendants_cpu_s(self._process.pid or 0)
        self._pipe.send((first, n))
        work, wall, cpu = self._answer()
        cpu += descendants_cpu_s(self._process.pid or 0) - others_s
        wall, cpu = work.timed_s or (wall, cpu)
        return Measurement(work.episodes, work.cell_steps, wall, cpu, work.bytes_written, work.part_s)

    def close(self) -> None:
        """Let the contender close what it has opened."""
        self._pipe.send(None)
        self._process.join(30)

    def _answer(self) -> Any:
        answer = self._pipe.recv()
        if isinstance(answer, str):
            raise RuntimeError(f"{self.name}: {answer}")  # noqa: TRY004 - a traceback
        return answer


def _serve(name: str, pipe: Connection) -> None:
    try:
        contender = CONTENDERS[name][0]()
        pipe.send(contender.rows(_CHECKED_EPISODES))
        while (task := pipe.recv()) is not None:
            wall, cpu = time.perf_counter(), time.process_time()
            work = contender.run(*task)
            pipe.send((work, time.perf_counter() - wall, time.process_time() - cpu))
        contender.close()
    except Exception:  # noqa: BLE001 - the parent raises it
        pipe.send(traceback.format_exc())


def descendants_cpu_s(pid: int) -> float:
    """User and system time (s) of all descendants of a process that are alive, in steps of 10 ms."""
    fields = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            # The name of the program, in brackets, may hold spaces: fields are counted from behind it.
            fields[int(stat.parent.name)] = stat.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended meanwhile
    tree = {pid}
    while more := {task for task, field in fields.items() if int(field[1]) in tree} - tree:
        tree |= more
    return sum(int(ticks) for task in tree - {pid} for ticks in fields[task][11:13]) * _TICK_S
