"""What stands beside the code is true: commands, links, Python lines, generated tables, workflows, pins."""

import json
import re
import runpy
import shlex
import subprocess
import tomllib
from pathlib import Path

import click
import matplotlib.pyplot as plt
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from docs import generate
from harness.cli import cli

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = [README, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FIRST = (
    "python3 -m venv .venv && .venv/bin/pip install -c requirements.lock -e . && "
    ".venv/bin/harness setup && .venv/bin/harness run scenarios/smoke.yaml --out runs/smoke"
)
SECOND = ".venv/bin/pip install -c requirements.lock -e '.[test]' && .venv/bin/python -m pytest -n 2"

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_CODE_SPAN = re.compile(r"`(harness [^`\n]+)`")
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
_FILE = re.compile(r"`((?:harness|docs)/[\w/]+\.\w+)`(?! \(new\))")


def _blocks(page, language):
    return [text for kind, text in _FENCE.findall(page.read_text(encoding="utf-8")) if kind == language]


def _commands():
    """Every ``harness …`` command line that a page, a shipped campaign or an example shows, with its place."""
    for page in set(PAGES) - {ROOT / "CHANGELOG.md"}:  # which also tells of commands that went
        shown = "\n".join(_blocks(page, "sh") + _blocks(page, "bash")).replace("\\\n", " ").splitlines()
        shown += _CODE_SPAN.findall(page.read_text(encoding="utf-8"))
        yield from ((page, line) for line in shown if line.startswith("harness "))
    in_files = {"examples/ci/*.yml": r"^ *- run: (harness .*)$", "examples/cluster/*.yaml": r"(harness run [^;]*);"}
    for pattern, line_of in {**in_files, "scenarios/*.yaml": r"^# +(harness \S.*)$"}.items():
        for file in sorted(ROOT.glob(pattern)):
            text = file.read_text(encoding="utf-8").replace("\\\n#", " ")
            yield from ((file, re.split(r"\s{3,}", line)[0]) for line in re.findall(line_of, text, re.MULTILINE))


def test_ci_runs_readmes_two_commands_and_refuses_a_readme_without_them(tmp_path):
    assert [block.strip() for block in _blocks(README, "bash")] == [FIRST, SECOND]
    (tmp_path / ".ci").mkdir()
    (tmp_path / ".ci/run").write_bytes((ROOT / ".ci/run").read_bytes())
    text = README.read_text(encoding="utf-8")
    wrong = (text.replace(f"```bash\n{SECOND}", f"```sh\n{SECOND}"), text + "\n```bash\ntrue\n```\n")
    for content, code, said in ((text, 0, f"{FIRST}\n{SECOND}\n"), (wrong[0], 1, ""), (wrong[1], 1, "")):
        (tmp_path / "README.md").write_text(content, encoding="utf-8")
        command = ["bash", str(tmp_path / ".ci/run"), "--commands"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (code, said)


def test_shown_command_lines_parse(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    context, wrong = click.Context(cli, info_name="harness"), []
    shown = list(_commands())
    assert len(shown) > 60
    for place, line in [*shown, (README, "harness run scenarios/smoke.yaml --outt x")]:
        words = shlex.split(line, comments=True)[1:]
        words = words[: words.index(">")] if ">" in words else words
        for word in words:
            if word == "DIR" or (word.startswith("runs/") and not word.endswith(".xml")):
                (tmp_path / word).mkdir(parents=True, exist_ok=True)
        try:
            name, command, rest = cli.resolve_command(context, words)
            if rest:  # a command may be mentioned by its name alone
                command.make_context(name, rest, parent=context)
        except click.UsageError as error:
            wrong.append(f"{place.name}: {line}: {error.message}")
    assert len(wrong) == 1, wrong
    assert "--outt" in wrong[0]


def test_links_and_named_files_lead_somewhere():
    missing = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        targets = [target.partition("#")[0] for target in _LINK.findall(text)]
        missing += [
            f"{page.name}: {target}"
            for target in targets
            if target and not target.startswith(("http://", "https://")) and not (page.parent / target).exists()
        ]
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    missing += [name for name in _FILE.findall(contributing) if not (ROOT / name).exists()]
    assert missing == []


@pytest.mark.slow
def test_python_lines_run(tmp_path, monkeypatch, capsys):
    """README first, then the other pages, in one folder: later lines use the runs of earlier ones."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenarios").symlink_to(ROOT / "scenarios")
    for page in PAGES:
        for i, text in enumerate(_blocks(page, "python")):
            script = tmp_path / f"{page.stem}_{i}.py"
            script.write_text(text, encoding="utf-8")
            runpy.run_path(str(script), run_name="__main__")
            assert capsys.readouterr().out.strip(), script.name


def test_the_notebook_runs(stored_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda: None)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/smoke").symlink_to(stored_run("shells-twin"))
    cells = json.loads((ROOT / "docs/first_look.ipynb").read_text(encoding="utf-8"))["cells"]
    assert all(cell["outputs"] for cell in cells if cell["cell_type"] == "code")
    known = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), known)
    assert (tmp_path / f"test_{known['worst']}.html").stat().st_size > 10_000


def test_generated_parts_are_current():
    stale = [page for page in generate.pages() if generate.regenerate(text := page.read_text("utf-8")) != text]
    assert stale == [], "run: python -m docs.generate"


def test_the_lock_pins_what_the_project_depends_on():
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    extras = PROJECT["project"]["optional-dependencies"]
    for text in PROJECT["project"]["dependencies"] + extras["test"] + extras["docs"] + extras["dev"]:
        wanted = Requirement(text)
        assert wanted.specifier.contains(pins[canonicalize_name(wanted.name)]), text


def test_the_pythons_that_are_promised_are_tested_and_have_wheels():
    (job,) = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))["jobs"].values()
    pythons = job["strategy"]["matrix"]["python"]
    assert PROJECT["project"]["requires-python"] == f">={pythons[0]},<3.{int(pythons[-1].partition('.')[2]) + 1}"
    wheels = ",".join(python.removeprefix("3.1") for python in pythons)
    assert PROJECT["tool"]["cibuildwheel"]["build"] == f"cp31{{{wheels}}}-manylinux_x86_64"


@pytest.mark.parametrize(
    ("folder", "imported"), [("harness", "studies"), ("harness", "tests"), ("benchmarks", "tests")]
)
def test_imports_lead_where_they_should(folder, imported):
    wrong = re.compile(rf"^\s*(?:from|import) {imported}\b", re.MULTILINE)
    files = (ROOT / folder).rglob("*.py")
    assert [file for file in files if wrong.search(file.read_text(encoding="utf-8"))] == []


TAG = re.compile(r"\[paper(: [^\]]+)?\]|source: paper")
PLACE = re.compile(r"section [IVX]+-[A-Z]|\(II-A\)|Lemma|Theorem|Algorithm")
"""What follows the paper's text or algorithm says where, and is no number."""


def test_every_number_tagged_with_the_paper_has_its_words_beside_it():
    page = (ROOT / "docs" / "environment.md").read_text()
    quoted = re.findall(r'^\| (`.+`) \| [IVX]+-[A-Z] \| ".+" \|$', page, re.MULTILINE)
    names = [name for cell in quoted for name in re.findall("`(.+?)`", cell)]
    assert len(quoted) >= 7
    files = [file for top in ("harness", "scenarios", "docs") for file in (ROOT / top).rglob("*")]
    lines = [
        (str(file.relative_to(ROOT)), line)
        for file in files
        if file.suffix in {".py", ".yaml", ".md", ".json"} and "validation" not in file.parts
        for line in file.read_text().splitlines()
        if TAG.search(line) and not line.startswith(("| [paper] |", "- [paper] ", "# docs/environment.md:"))
    ]
    assert len(lines) > 25
    assert [each for each in lines if not (PLACE.search(each[1]) or any(name in each[1] for name in names))] == []
