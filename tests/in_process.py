"""Stand-ins that spare tests what they are not about: starting processes, and drawing the page.

Whoever moves what is patched here mends it here: no other file of the tests knows where it lies.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.kills import descendants, started_by
from harness import run
from harness.campaign.campaign import Campaign
from harness.controllers.hosts import Death
from harness.processes import ForkServer
from harness.runner import workers
from harness.runner.run import RunResult
from harness.runner.workers import ShardResult, ShardRunner
from harness.sampling.protocol import ShardRequest


@contextmanager
def without_page() -> Iterator[None]:
    """It takes longer than small campaigns; test_api.py looks at it."""
    with pytest.MonkeyPatch.context() as patch:
        for write in ("page.write_report", "compare_page.write_comparison"):
            patch.setattr(f"harness.report.{write}", lambda folder, **_: folder / "report.html")
        yield


class WorkerInThisProcess:
    """Stands in for `WorkerProcess` where the tests are not about processes: spares starting one."""

    def __init__(self, server: ForkServer, serve: Callable[..., None], resolved: Path, baseline: Path) -> None:
        self._runner = ShardRunner(pickle.loads(resolved.read_bytes()), baseline)

    def give(self, spec: ShardRequest, fatal_episodes: Mapping[int, Death]) -> bool:
        self._done = self._runner.run(spec, fatal_episodes)
        return True

    def answer(self) -> ShardResult:
        return self._done

    def kill(self) -> None:
        self.dismiss()

    def dismiss(self) -> None:
        self._runner.close()
        self._runner._loop._world.close()

    def wait(self, seconds: float) -> None: ...


@contextmanager
def one_process() -> Iterator[None]:
    """Where shards are run, it is here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "WorkerProcess", WorkerInThisProcess)
        patch.setattr(workers.LocalWorkers, "first_to_answer", lambda _, busy: busy[0])
        yield


def _work_here(_: Any, work: Callable[..., Any], *arguments: Any) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        return work(*arguments, black_box=Path(folder) / "black-box")


@contextmanager
def controllers_here() -> Iterator[None]:
    """Where a controller is tried before a run, it is here: for those that are known to end no process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.controllers.find.run_apart", _work_here)
        yield


def run_here(campaign: Campaign, out: Path, **options: Any) -> RunResult:
    """Run a campaign in this process, without its page."""
    with one_process(), controllers_here(), without_page():
        return run(campaign, out, workers=1, **options)


def run_with_workers(campaign: Campaign, out: Path, **options: Any) -> RunResult:
    """Run a campaign with processes of its own, without its page."""
    with without_page():
        return run(campaign, out, **options)


class ForkedPython(subprocess.Popen):
    """Instead of a fresh Python for a worker, a copy of this one: its imports take seconds, and are done here."""

    def _execute_child(self, args: Any, executable: Any, preexec_fn: Any, close_fds: Any, *rest: Any) -> None:
        if not (isinstance(args, list) and args[:2] == [sys.executable, "-c"] and "harness.processes" in args[2]):
            super()._execute_child(args, executable, preexec_fn, close_fds, *rest)
            return
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # threads of xdist are nothing to a worker
            self.pid = os.fork()
        if self.pid == 0:
            try:
                os.setsid()
                sys.stdout, sys.stderr = (open(fd, "w", buffering=1, closefd=False) for fd in (1, 2))  # noqa: SIM115
                nothing = os.open(os.devnull, os.O_RDWR)  # Arrow aborts a copy of this copy if its pipe is closed
                for fd in {int(each.name) for each in Path("/proc/self/fd").iterdir()} - {0, 1, 2, nothing, *rest[0]}:
                    with suppress(OSError):  # that of the folder itself
                        os.fstat(fd)
                        os.dup2(nothing, fd, inheritable=False)
                exec(args[2], {"__name__": "__worker__"})
                os._exit(0)
            except SystemExit as error:
                os._exit(error.code if isinstance(error.code, int) else 1)
            except BaseException:  # noqa: BLE001 - nothing of pytest may go on in a copy
                traceback.print_exc()
                os._exit(1)
        while os.getsid(self.pid) != self.pid:  # as after a true start: from now on it can be ended
            time.sleep(0.0)
        self._child_created = True


@contextmanager
def forked_workers() -> Iterator[None]:
    """Workers that are processes of their own begin at once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.processes.subprocess", SimpleNamespace(**{**vars(subprocess), "Popen": ForkedPython}))
        yield


def workers_alive() -> list[int]:
    """Processes below this one, but for Python's own watcher of shared memory, which other tests may have started."""
    return [pid for pid in descendants(os.getpid()) if not started_by(pid, b"resource_tracker")]
