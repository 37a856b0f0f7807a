"""What stands beside the code is true: worked examples name what there is, workflows and the citation can be read."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))

_ROW = re.compile(r"^\| `(harness/[\w/.]+)`( \(new\))? \| (.*?) \|", re.MULTILINE)
_FILE = re.compile(r"`((?:harness|docs)/[\w/]+\.\w+)`(?! \(new\))")
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_NAME = re.compile(r"`([\w.]+)`")


def _read(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_contributing_names_files_that_are_there():
    named = _FILE.findall(CONTRIBUTING) + _LINK.findall(CONTRIBUTING)
    assert len(named) > 15
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("row", _ROW.findall(CONTRIBUTING), ids=lambda row: f"{row[0]}: {row[2]}")
def test_worked_examples_name_what_is_in_the_file(row):
    file, new, where = row
    if new:
        assert not (ROOT / file).exists()
        return
    names = _NAME.findall(where)
    text = (ROOT / file).read_text(encoding="utf-8")
    assert names
    assert [name for name in names if not re.search(rf"\b{re.escape(name)}\b", text)] == []


@pytest.mark.parametrize(
    ("folder", "imported", "may"),
    [
        ("harness", "studies", ()),
        ("harness", "tests", ()),
        ("benchmarks", "tests", ()),
    ],
)
def test_imports_lead_where_they_should(folder, imported, may):
    """Nothing in the package leads to studies, and nothing that is not a test to tests."""
    wrong = re.compile(rf"^\s*(?:from|import) {re.escape(imported)}\b", re.MULTILINE)
    files = [path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*.py")]
    found = [file for file in files if wrong.search((ROOT / file).read_text(encoding="utf-8"))]
    assert [file for file in found if not file.startswith(may)] == []


def test_there_are_four_worked_examples():
    _, _, examples = CONTRIBUTING.partition("## Four worked examples")
    assert len(re.findall(r"^### ", examples, re.MULTILINE)) == 4
    assert all(_ROW.search(example) for example in examples.split("\n### ")[1:])


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_pin_what_they_use_and_may_only_read(path):
    workflow = _read(path)
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert job["timeout-minutes"] <= 240
        used = [step["uses"] for step in job["steps"] if "uses" in step]
        assert [action for action in used if not re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", action)] == []


def test_hosted_ci_covers_the_pythons_that_are_promised():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (job,) = _read(ROOT / ".github/workflows/ci.yml")["jobs"].values()
    pythons = job["strategy"]["matrix"]["python"]
    assert project["project"]["requires-python"] == f">={pythons[0]},<3.{int(pythons[-1].partition('.')[2]) + 1}"
    wheels = ",".join(python.removeprefix("3.1") for python in pythons)
    assert project["tool"]["cibuildwheel"]["build"] == f"cp31{{{wheels}}}-manylinux_x86_64"
    assert job["steps"][-1]["run"] == "bash .ci/run"


def test_hooks_run_what_the_checkout_has_locked():
    (local,) = _read(ROOT / ".pre-commit-config.yaml")["repos"]
    assert {hook["entry"].split("/")[0] for hook in local["hooks"]} == {".venv"}


def test_the_citation_is_of_this_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = _read(ROOT / "CITATION.cff")
    assert (citation["title"], citation["version"]) == (project["name"], project["version"])
    assert citation["license"] == project["license"]
