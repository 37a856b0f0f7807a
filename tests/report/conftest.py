from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import harness
from harness.campaign.files import load_campaign
from harness.report.summary import RunFolder, read_run_folder
from harness.runner.stored import write_report
from tests.golden.campaigns import SHELLS
from tests.golden.record import load
from tests.in_process import controllers_here, one_process, run_here, without_page
from tests.report.page_text import write_run
from tests.stored_runs import copy_of


class OnDemand(dict):
    """Makes a value when it is first asked for: a report takes seconds, and few tests need all."""

    def __init__(self, make: Callable[[str], Any]) -> None:
        self.make = make

    def __missing__(self, name: str) -> Any:
        self[name] = self.make(name)
        return self[name]


@pytest.fixture(scope="session")
def folders(made_once) -> dict[str, Path]:
    """One run folder of each, without its report; tests must not change them."""
    return OnDemand(lambda name: made_once(f"page-{name}", lambda out: write_run(out / "run", name)) / "run")


@pytest.fixture(scope="session")
def reports(made_once, folders: dict[str, Path]) -> dict[str, Path]:
    """The same with their reports."""

    def make(name: str) -> Path:
        return made_once(f"report-{name}", lambda out: write_report(copy_of(folders[name], out / "run"))) / "run"

    return OnDemand(make)


@pytest.fixture(scope="session")
def runs(folders: dict[str, Path]) -> dict[str, RunFolder]:
    """The same folders, read."""
    return OnDemand(lambda name: read_run_folder(folders[name]))


@pytest.fixture(scope="session")
def compared(made_once) -> Path:
    """A comparison without its page: of A, and of B, which brakes harder and later, there are crashes alone."""
    shared = (*SHELLS, "world.engine=twin", "stop.rhw=0.4", "stop.episodes=240", "records.traces=crash")
    late = "av={model: idm, parameters: {min_acceleration_mps2: -8}, reaction: {delay_s: 0.5}}"

    def make(out: Path) -> None:
        with one_process(), controllers_here(), without_page():
            harness.compare(load(*shared), load(*shared, late), out, workers=1)

    return made_once("compared", make)


@pytest.fixture(scope="session")
def crashing(made_once) -> dict[str, Path]:
    """A run of each scenario, by its name, of a pool that is small: idm crashes in all; tests must not change them."""
    small = "pool.relative_error=0.2", "pool.events_per_shell=200", "stop.episodes=200", "stop.rhw=0.9"
    settings = "world.engine=twin", "records.traces=crash", *small

    def make(scenario: str) -> Path:
        campaign = load_campaign("idm", [f"scenario={scenario}", *settings])
        return made_once(scenario, lambda out: run_here(campaign, out))

    return OnDemand(make)
