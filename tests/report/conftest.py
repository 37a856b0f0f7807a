import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import harness
from harness.campaign.files import load_campaign
from harness.report.page import write_report
from harness.report.summary import RunFolder, read_run_folder
from tests.golden.campaigns import SHELLS
from tests.golden.record import load
from tests.in_process import controllers_here, one_process, run_here, without_page
from tests.report.page_text import write_run


class OnDemand(dict):
    """Makes a value when it is first asked for: a report takes seconds, and few tests need all."""

    def __init__(self, make: Callable[[str], Any]) -> None:
        self.make = make

    def __missing__(self, name: str) -> Any:
        self[name] = self.make(name)
        return self[name]


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One run folder of each, without its report unless `reports` was asked for it; tests must not change them."""
    return OnDemand(lambda name: write_run(tmp_path_factory.mktemp(name) / "run", name))


@pytest.fixture(scope="session")
def reports(folders: dict[str, Path]) -> dict[str, Path]:
    """The same folders with their reports."""
    return OnDemand(lambda name: write_report(folders[name]).parent)


@pytest.fixture(scope="session")
def runs(folders: dict[str, Path]) -> dict[str, RunFolder]:
    """The same folders, read."""
    return OnDemand(lambda name: read_run_folder(folders[name]))


@pytest.fixture(scope="session")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison without its page: of A, and of B, which brakes harder and later, there are crashes alone."""
    shared = (*SHELLS, "world.engine=twin", "stop.rhw=0.4", "stop.episodes=240", "records.traces=crash")
    late = "av={model: idm, parameters: {min_acceleration_mps2: -8}, reaction: {delay_s: 0.5}}"
    out = tmp_path_factory.mktemp("compared") / "out"
    with one_process(), controllers_here(), without_page():
        harness.compare(load(*shared), load(*shared, late), out, workers=1)
    return out


@pytest.fixture(scope="session")
def crashing(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run of each scenario, by its name, of a pool that is small: idm crashes in all; tests must not change them."""

    def make(scenario: str) -> Path:
        small = "pool.relative_error=0.2", "pool.events_per_shell=200", "stop.episodes=200", "stop.rhw=0.9"
        campaign = load_campaign("idm", [f"scenario={scenario}", "world.engine=twin", "records.traces=crash", *small])
        return run_here(campaign, tmp_path_factory.mktemp(scenario) / "run").folder

    return OnDemand(make)


@pytest.fixture
def run_folder(folders: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of a full run without report, to be damaged."""
    return shutil.copytree(folders["weighted"], tmp_path / "run", ignore=shutil.ignore_patterns("plots", "report.html"))
