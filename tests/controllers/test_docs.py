"""Every recipe of docs/controllers.md is run, as it stands on the page, by ``harness run``."""

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from harness.cli import main
from tests.pool.conftest import SMALL_POOL
from tests.stored_runs import ROOT, answer_in

pytestmark = pytest.mark.slow

PAGE = (ROOT / "docs/controllers.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
CAMPAIGN = """\
name: recipe
testing: {method: forced}
records: {moments: none}
world: {cells: 8}
stop: {episodes: 60}
run: {shard_size: 60}
"""
RECIPES = [text for kind, text in BLOCKS if kind == "yaml"]
BRAKES = [text for text in RECIPES if "Brakes" in text or "my_script" in text]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the page's files, and what its shell lines make."""
    folder = tmp_path_factory.mktemp("recipes")
    shutil.copy(ROOT / "examples/traci_client/idm_client.py", folder)
    for kind, text in BLOCKS:
        if kind == "py":
            (folder / re.match(r"# (\w+\.py)\n", text)[1]).write_text(text, encoding="utf-8")
    return folder


def run(folder, recipe):
    number = RECIPES.index(recipe)
    if "fmu:" in recipe:
        pytest.importorskip("pythonfmu", reason="the extra test")
        (line,) = (text for kind, text in BLOCKS if kind == "sh")
        words = shlex.split(line)
        subprocess.run([sys.executable, "-m", *words], cwd=folder, check=True, capture_output=True)
    if "traci:" in recipe:
        pytest.importorskip("sumo", reason="the extra sumo")
    (folder / f"c{number}.yaml").write_text(CAMPAIGN + recipe, encoding="utf-8")
    out = folder / f"run{number}"
    with contextlib.chdir(folder), pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
        assert main(["run", f"c{number}.yaml", "--out", str(out), "--workers", "1", "--quiet"]) == 0
    rows = pq.read_table(out / "episodes").to_pylist()
    assert [row["failure"] for row in rows] == [None] * 60
    return rows


@pytest.fixture(scope="module")
def per_vehicle(folder):
    return run(folder, RECIPES[0])


@pytest.mark.parametrize("recipe", RECIPES[1:], ids=lambda recipe: " ".join(recipe.split())[:50])
def test_recipes_of_the_same_controller_are_the_same_vehicle_and_all_others_run(recipe, folder, per_vehicle):
    rows = run(folder, recipe)
    assert (len(RECIPES), len(BRAKES)) == (9, 7)
    assert {row["outcome"] for row in per_vehicle} >= {"crash", "timeout"}
    if "fmu:" in recipe:
        assert [row["outcome"] for row in rows] == [row["outcome"] for row in per_vehicle]
        assert [row["av_distance_m"] for row in rows] == pytest.approx(
            [row["av_distance_m"] for row in per_vehicle], abs=1e-9
        )
    elif recipe in BRAKES:
        assert rows == per_vehicle


def test_the_first_vehicle_of_a_new_user_runs(tmp_path, monkeypatch):
    page = (ROOT / "README.md").read_text("utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "my_av", raising=False)  # the page's, where it has been imported here
    ((name, text),) = re.findall(r"^```(?:py|yaml)\n# (\S+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    Path(name).write_text(text, encoding="utf-8")
    short = [f"--set={setting}" for setting in ("stop.rhw=0.5", *SMALL_POOL)]
    (command,) = re.findall(r"^harness (run my_av.py:\w+)  ", page, re.MULTILINE)
    code = main([*command.split(), "--workers", "1", "--quiet", *short])
    sys.modules.pop("my_av", None)
    assert code == 0
    rows = answer_in(Path("runs/my_av-MyAV"))["rows"]
    assert "ratio" in [row["key"] for row in rows]
