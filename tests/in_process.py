"""Stand-ins that spare tests what they are not about: starting processes, and drawing the page.

Whoever moves what is patched here mends it here: no other file of the tests knows where it lies.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from benchmarks.kills import descendants, started_by
from harness import run
from harness.campaign.campaign import Campaign
from harness.resolved import Resolved
from harness.runner import kept, workers
from harness.runner.underway import RunResult
from harness.runner.workers import ShardResult, ShardRunner
from harness.sampling.protocol import ShardRequest


@contextmanager
def without_page() -> Iterator[None]:
    """It takes longer than small campaigns; test_api.py looks at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.runner.underway.write_page_of", lambda run: run.path / "report.html")
        patch.setattr("harness.runner.compare.write_comparison", lambda folder, *_: folder / "report.html")
        yield


class WorkerInThisProcess:
    """Stands in for `Child` where the tests are not about processes: spares starting one."""

    def __init__(self, _serve: Callable[..., None], resolved: Resolved, baseline: Path) -> None:
        self._runner = ShardRunner(resolved, baseline)

    def give(self, request: ShardRequest, fatal: Mapping[int, str], alone: bool) -> bool:
        self._done = self._runner.run(request, fatal)
        return True

    def answer(self) -> ShardResult:
        return self._done

    def kill(self) -> None:
        self.dismiss()

    def dismiss(self) -> None:
        self._runner.close()

    def wait(self, seconds: float) -> None: ...


@contextmanager
def one_process() -> Iterator[None]:
    """Where shards are run, it is here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "Child", WorkerInThisProcess)
        patch.setattr(workers.LocalWorkers, "first_to_answer", lambda _, busy: busy[0])
        patch.setattr(workers, "start_server", lambda: None)
        patch.setattr(kept, "PART_TESTS", 80)  # several files of small runs
        yield


def _work_here(_: Any, work: Callable[..., Any], *arguments: Any) -> Any:
    return work(*arguments)


@contextmanager
def controllers_here() -> Iterator[None]:
    """Where a controller is tried, or tests run again, it is here: for those that end no process."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("controllers.find", "runner.again", "runner.stored"):
            patch.setattr(f"harness.{module}.run_apart", _work_here)
        yield


def run_here(campaign: Campaign, out: Path, **options: Any) -> RunResult:
    """Run a campaign in this process, without its page."""
    with one_process(), controllers_here(), without_page():
        return run(campaign, out, workers=1, **options)


def run_with_workers(campaign: Campaign, out: Path, **options: Any) -> RunResult:
    """Run a campaign with processes of its own, without its page."""
    with without_page():
        return run(campaign, out, **options)


def workers_alive() -> list[int]:
    """Workers of this process."""
    of_server = [pid for pid in descendants(os.getpid()) if started_by(pid, b"multiprocessing.forkserver")]
    return [pid for pid in of_server if os.getsid(pid) == pid]
