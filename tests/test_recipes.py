"""CONTRIBUTING.md: its recipes run as they stand there, each from an empty folder."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib

import pytest

import harness
from tests.stored_runs import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
FAMILY = ROOT / "tests/families"
_FILE = re.compile(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(recipe, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", recipe, re.MULTILINE | re.DOTALL)


def laid_out(name, folder):
    """The text of a recipe, whose files lie in a folder now."""
    recipe = re.search(rf"^### {name}\n(.*?)(?=^##)", TEXT, re.MULTILINE | re.DOTALL)[1]
    for file, content in _FILE.findall(recipe):
        (folder / file).write_text(content, encoding="utf-8")
    return recipe


def ran(recipe, folder, *importable):
    """What the commands of a recipe have written on the terminal, run in a folder by a process of their own."""
    path = os.pathsep.join(map(str, (*importable, ROOT)))
    env = {**os.environ, "PYTHONPATH": path, "COLUMNS": "200"}
    said = ""
    for line in "".join(blocks(recipe, "sh")).splitlines():
        command = [sys.executable, "-m", *shlex.split(line)]
        done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        said += done.stdout
    return said


@pytest.mark.slow
def test_a_new_family_is_a_package_that_is_installed_beside(tmp_path):
    """Installed as pip does it: a module, its file, and a folder of metadata with the entry point."""
    recipe = laid_out("A new family", tmp_path)
    project = tomllib.loads((tmp_path / "pyproject.toml").read_text())["project"]
    site = tmp_path / "site"
    metadata = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    ((group, entries),) = project["entry-points"].items()
    lines = [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    shutil.copy(FAMILY / "fake.py", site / "my_events.py")
    shutil.copy(FAMILY / "two-events.yaml", site)
    assert "2,000 tests" in ran(recipe, tmp_path, site)
    tests = harness.read(tmp_path / "runs/mine").episodes()
    assert set(tests["gap_m"]) == {8.0, 100.0}
    assert set(tests["outcome"][tests["gap_m"] == 8.0]) == {"crash"}


@pytest.mark.slow
def test_a_new_estimator_is_a_class_in_a_file(tmp_path):
    said = ran(laid_out("A new estimator", tmp_path), tmp_path)
    name = "my.py:SelfNormalised"
    assert re.search(rf"{name}\W+1\.\d+ × 10⁻⁷", said)
    found = json.loads((tmp_path / "runs/mine/estimates.json").read_text())["estimates"]
    assert found[name]["ci_low"] < found["nade"]["crash_rate"] < found[name]["ci_high"]
    assert found[name]["cautions"] == found["nade"]["cautions"]
    assert found[name]["warnings"][-1]["key"] == "own"
    assert name in (tmp_path / "runs/mine/report.html").read_text()


@pytest.mark.slow
def test_a_new_surrogate_is_a_driver_or_a_class_in_a_file(tmp_path):
    ran(laid_out("A new surrogate", tmp_path), tmp_path)
    estimates = json.loads((tmp_path / "runs/mine/estimates.json").read_text())
    ratios = estimates["diagnostics"]["mean_ratio"]
    assert set(ratios) == {"forced", "mine", "careful", "late"}
    assert 1.0e-7 < estimates["estimates"]["mixture_cv"]["crash_rate"] < 1.8e-7


@pytest.mark.slow
def test_a_new_criticality_is_a_function_in_a_file(tmp_path):
    """It steers well, and the rate stays that of the traffic: 1.352e-7 by 12 million tests (tests/reference)."""
    assert "bit for bit as stored" in ran(laid_out("A new criticality", tmp_path), tmp_path)
    estimates = json.loads((tmp_path / "runs/mine/estimates.json").read_text())
    ratio = estimates["diagnostics"]["mean_ratio"]["mine"]
    assert abs(ratio["mean"] - 1.0) < 4.0 * ratio["std_error"] < 0.04
    nade = estimates["estimates"]["nade"]
    assert nade["n_crashes"] > 1000
    assert nade["crash_rate"] == pytest.approx(1.352e-7, rel=0.1)


def test_the_diff_of_a_new_controller_kind_fits_the_code():
    apply = ["git", "apply", "--check", "--unidiff-zero", "examples/new_controller_kind.diff"]
    subprocess.run(apply, cwd=ROOT, check=True)


@pytest.mark.slow
def test_a_new_controller_kind_is_three_files(tmp_path):
    recipe = laid_out("A new controller kind", tmp_path)
    own = tmp_path / "own"
    shutil.copytree(ROOT / "harness", own / "harness", symlinks=False, ignore=shutil.ignore_patterns("__pycache__"))
    diff = (ROOT / "examples/new_controller_kind.diff").read_text(encoding="utf-8")
    assert diff.count("\n+++ ") == 3
    subprocess.run(["git", "apply", "--unidiff-zero", "-"], cwd=own, input=diff, text=True, check=True)
    assert "profile · 500 tests" in ran(recipe, tmp_path, own)
