"""Small campaigns with the real policies, run once and looked at by many tests."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.controllers.black_box import Death
from harness.runner import RunResult, executor, run_campaign
from harness.runner.worker import ShardDone, ShardRunner, ShardSpec

MIXTURE_FILE = Path(__file__).parents[2] / "scenarios" / "overtaking_mixture.yaml"
SMALL = ("stop.episodes=1600", "stop.rhw=null", "run.shard_size=80", "records.trace_share=0.05")
TWIN = ("world.engine=twin", "stop.episodes=400")


def sets(*overrides: str) -> list[str]:
    """The same on a command line."""
    return [word for override in overrides for word in ("--set", override)]


@pytest.fixture(scope="session")
def campaign() -> Callable[..., Campaign]:
    """The smoke campaign in small, with overrides."""
    return lambda *overrides: load_campaign(MIXTURE_FILE, [*SMALL, *overrides])


@contextmanager
def without_page() -> Iterator[None]:
    """It takes longer than these campaigns; test_api.py looks at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.report.write_report", lambda folder, final=None: folder / "report.html")
        yield


@pytest.fixture(scope="session")
def run() -> Callable[..., RunResult]:
    """`run_campaign` without the page."""
    return without_page()(run_campaign)


class WorkerInThisProcess:
    """Stands in for `WorkerProcess` where the tests are not about processes: spares starting one."""

    def __init__(self, resolved: Path, folder: Path, black_box: Path) -> None:
        self._runner = ShardRunner(pickle.loads(resolved.read_bytes()), folder)

    def give(self, spec: ShardSpec, doomed: Mapping[int, Death]) -> bool:
        self._done = self._runner.run(spec, doomed)
        return True

    def answer(self) -> ShardDone:
        return self._done

    def kill(self) -> None:
        self.dismiss()

    def dismiss(self) -> None:
        self._runner.close()
        self._runner._loop._world.close()

    def wait(self) -> None: ...


@contextmanager
def one_process() -> Iterator[None]:
    """Where shards are run, it is here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executor, "WorkerProcess", WorkerInThisProcess)
        patch.setattr(executor.LocalExecutor, "first_to_answer", lambda _, busy: busy[0])
        yield


@pytest.fixture(scope="session")
def run_here() -> Callable[..., RunResult]:
    """`run` with one worker that is this process."""
    return one_process()(without_page()(partial(run_campaign, workers=1)))


@pytest.fixture(scope="session")
def sumo_run(campaign, run, tmp_path_factory) -> Path:
    """One worker, eight cells. Never written to: damage a copy."""
    out = tmp_path_factory.mktemp("sumo") / "run"
    run(campaign("world.cells=8"), out, workers=1)
    return out


@pytest.fixture(scope="session")
def twin_run(campaign, run_here, tmp_path_factory) -> Path:
    """Its first 400 episodes in the twin. Never written to: damage a copy."""
    out = tmp_path_factory.mktemp("twin") / "run"
    run_here(campaign(*TWIN), out)
    return out
