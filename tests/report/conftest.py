from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from synthetic_run import RECIPES, write_run

from harness.report import write_report
from harness.report.run_folder import RunFolder, read_run_folder


@pytest.fixture(scope="session")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One run folder with its report per recipe; tests must not change them."""
    folders = {}
    for name, recipe in RECIPES.items():
        folders[name] = write_run(tmp_path_factory.mktemp(name) / "run", recipe)
        write_report(folders[name])
    return folders


@pytest.fixture(scope="session")
def runs(reports: dict[str, Path]) -> dict[str, RunFolder]:
    """The same folders, read."""
    return {name: read_run_folder(folder) for name, folder in reports.items()}


@pytest.fixture
def run_folder(reports: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of a full run, to be damaged."""
    copy = tmp_path / "run"
    shutil.copytree(reports["full"], copy)
    return copy
