"""What stands beside the code is true: commands, Python lines, generated tables, pins."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from benchmarks.contenders import CONTENDERS, missing
from benchmarks.speed import STARTUP
from docs import generate
from harness.cli import cli

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = [README, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_CODE_SPAN = re.compile(r"`(harness [^`\n]+)`")
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


def test_files_that_contributing_names_are_there():
    """Links are looked at where the site is made: a broken one is a warning, and an error there."""
    named = _FILE.findall((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    assert named
    assert [name for name in named if not (ROOT / name).exists()] == []


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
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
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


@pytest.mark.slow
def test_all_contenders_run():
    names = [name for name in CONTENDERS if not missing(name) and name != "traci"]
    wanted = ",".join([*names, STARTUP])
    command = [sys.executable, "-m", "benchmarks.speed", "--quick", "--repetitions", "1", "--only", wanted]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "Start-up of `harness run overtaking_nade.yaml`" in found
    assert all(f"\n{name}  " in found for name in names)
