from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from synthetic_run import RECIPES, write_run

from harness.report import write_report
from harness.report.run_folder import RunFolder, read_run_folder


class OnDemand(dict):
    """Makes a value when it is first asked for: a report takes seconds, and few tests need all."""

    def __init__(self, make: Callable[[str], Any]) -> None:
        self.make = make

    def __missing__(self, name: str) -> Any:
        self[name] = self.make(name)
        return self[name]


@pytest.fixture(scope="session")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One run folder with its report per recipe; tests must not change them."""

    def written(name: str) -> Path:
        folder = write_run(tmp_path_factory.mktemp(name) / "run", RECIPES[name])
        write_report(folder)
        return folder

    return OnDemand(written)


@pytest.fixture(scope="session")
def runs(reports: dict[str, Path]) -> dict[str, RunFolder]:
    """The same folders, read."""
    return OnDemand(lambda name: read_run_folder(reports[name]))


@pytest.fixture
def run_folder(reports: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of a full run, to be damaged."""
    copy = tmp_path / "run"
    shutil.copytree(reports["full"], copy)
    return copy
