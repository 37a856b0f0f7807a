"""What a stranger meets first is true: commands, links, Python lines, generated tables."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from docs import generate
from harness.cli import cli

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = [README, ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
FIRST = (
    "python3 -m venv .venv && .venv/bin/pip install -c requirements.lock -e . && "
    ".venv/bin/harness setup && .venv/bin/harness run scenarios/smoke.yaml --out runs/smoke"
)
SECOND = ".venv/bin/pip install -c requirements.lock -e '.[test]' && .venv/bin/python -m pytest -n 2"

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_CODE_SPAN = re.compile(r"`(harness [^`\n]+)`")
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def _blocks(page, language):
    return [text for kind, text in _FENCE.findall(page.read_text(encoding="utf-8")) if kind == language]


def _commands():
    """Every ``harness …`` command line that a page or a shipped campaign shows."""
    for page in PAGES:
        shown = "\n".join(_blocks(page, "sh") + _blocks(page, "bash")).replace("\\\n", " ").splitlines()
        shown += _CODE_SPAN.findall(page.read_text(encoding="utf-8"))
        for line in shown:
            if line.startswith("harness "):
                yield pytest.param(line, id=f"{page.name}: {line[:60]}")
    for workflow in sorted((ROOT / "examples/ci").glob("*.yml")):
        for line in re.findall(r"^ *- run: (harness .*)$", workflow.read_text(encoding="utf-8"), re.MULTILINE):
            yield pytest.param(line, id=f"{workflow.name}: {line[:60]}")
    for job in sorted((ROOT / "examples/cluster").glob("*.yaml")):
        for line in re.findall(r"(harness run [^;]*);", job.read_text(encoding="utf-8")):
            yield pytest.param(line, id=f"{job.name}: {line[:60]}")
    for campaign in sorted((ROOT / "scenarios").glob("*.yaml")):
        text = campaign.read_text(encoding="utf-8").replace("\\\n#", " ")
        for line in re.findall(r"^# +(harness \S.*)$", text, re.MULTILINE):
            yield pytest.param(re.split(r"\s{3,}", line)[0], id=f"{campaign.name}: {line[:60]}")


def test_readme_has_the_two_commands_once_each():
    assert [block.strip() for block in _blocks(README, "bash")] == [FIRST, SECOND]
    text = README.read_text(encoding="utf-8")
    assert (text.count(FIRST), text.count(SECOND)) == (1, 1)


def test_ci_runs_the_commands_as_they_stand_in_readme():
    done = subprocess.run([str(ROOT / ".ci/run"), "--commands"], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [FIRST, SECOND]


def test_ci_refuses_a_readme_without_them(tmp_path):
    (tmp_path / ".ci").mkdir()
    (tmp_path / ".ci/run").write_bytes((ROOT / ".ci/run").read_bytes())
    text = README.read_text(encoding="utf-8")
    for wrong in (text.replace(f"```bash\n{SECOND}", f"```sh\n{SECOND}"), text + "\n```bash\ntrue\n```\n"):
        (tmp_path / "README.md").write_text(wrong, encoding="utf-8")
        done = subprocess.run(
            ["bash", str(tmp_path / ".ci/run"), "--commands"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 1
        assert "exactly two" in done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_relative_links_lead_somewhere(page):
    targets = [target.partition("#")[0] for target in _LINK.findall(page.read_text(encoding="utf-8"))]
    relative = [target for target in targets if target and not target.startswith(("http://", "https://"))]
    assert [target for target in relative if not (page.parent / target).exists()] == []


def test_the_index_names_every_page():
    linked = set(_LINK.findall((ROOT / "docs/index.md").read_text(encoding="utf-8")))
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in PAGES if ROOT / "docs" in page.parents}
    assert pages - {"index.md"} <= linked


@pytest.mark.parametrize("line", list(_commands()))
def test_shown_command_lines_parse(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(line, comments=True)[1:]
    if ">" in words:
        words = words[: words.index(">")]
    for word in words:
        if word == "DIR" or (word.startswith("runs/") and not word.endswith(".xml")):
            (tmp_path / word).mkdir(parents=True, exist_ok=True)
    context = click.Context(cli, info_name="harness")
    name, command, rest = cli.resolve_command(context, words)
    if rest:  # a command may be mentioned by its name alone
        command.make_context(name, rest, parent=context)


def test_a_wrong_command_line_would_be_noticed():
    context = click.Context(cli, info_name="harness")
    with pytest.raises(click.UsageError):
        cli.commands["run"].make_context("run", ["scenarios/smoke.yaml", "--outt", "x"], parent=context)


def test_python_lines_run(tmp_path):
    """README first, then the other pages, in one folder: later lines use the runs of earlier ones."""
    (tmp_path / "scenarios").symlink_to(ROOT / "scenarios")
    lines = [(page, text) for page in PAGES for text in _blocks(page, "python")]
    assert lines[0][0] == README
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    names = [f"lines_{i}.py" for i in range(len(lines))]
    for name, (_, text) in zip(names, lines, strict=True):
        (tmp_path / name).write_text(text, encoding="utf-8")
    each = "print('====', name)\n    runpy.run_path(name, run_name='__main__')"
    one_by_one = f"import runpy\nfor name in {names}:\n    {each}"
    command = [sys.executable, "-W", "error", "-c", one_by_one]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(len(said.splitlines()) > 1 for said in done.stdout.split("==== ")[1:])


def test_generated_parts_are_current():
    stale = [
        page.name
        for page in generate.pages()
        if generate.regenerate(page.read_text(encoding="utf-8")) != page.read_text(encoding="utf-8")
    ]
    assert stale == [], "run: python docs/generate.py"


def test_every_long_run_is_in_the_table():
    shown = {name for names in generate.RESULTS.values() for name in names}
    shown |= {file for name in generate.VARIED for file in generate.varied_files(name)}
    shown |= {*generate.VALIDATED, *generate.METHODS, "limits"}
    assert {path.stem for path in (ROOT / "docs/validation").glob("*.json")} <= shown


def test_a_full_study_becomes_a_page_of_the_docs_and_a_quick_one_is_refused(tmp_path, monkeypatch):
    docs, study = tmp_path / "docs", tmp_path / "study"
    monkeypatch.setattr(generate, "FOLDER", docs)
    for folder in (docs, study / "plots"):
        folder.mkdir(parents=True)
    (study / "plots" / "tests.png").write_bytes(b"picture")
    (study / "case_study.md").write_text("# Title\n\n![tests](plots/tests.png), defect (docs/scv-defect.md)\n\nend\n")
    (study / "claims.json").write_text('{"conclusive": false}')
    with pytest.raises(SystemExit, match="quick"):
        generate.take_case_study(study)
    assert list(docs.iterdir()) == []
    (study / "claims.json").write_text('{"conclusive": true}')
    generate.take_case_study(study)
    page = (docs / "case_study.md").read_text()
    assert page.count("Made by") == 1
    assert (docs / re.search(r"!\[tests\]\(([^)]+)\)", page)[1]).read_bytes() == b"picture"
    assert "([why](scv-defect.md))" in page


def test_the_lock_pins_what_the_project_depends_on():
    import tomllib

    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    for text in project["dependencies"] + extras["test"] + extras["docs"] + extras["dev"]:
        wanted = Requirement(text)
        assert wanted.specifier.contains(pins[canonicalize_name(wanted.name)]), text
