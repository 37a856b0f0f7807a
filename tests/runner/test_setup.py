"""`harness setup` compiles what a first run needs."""

import os
import subprocess
import sys

import pytest

from harness import cache
from harness.compiled import KERNELS
from harness.runner.setup import compile_kernels

AV = "class MyAV:\n    def step(self, seen):\n        return -0.5\n"


@pytest.mark.slow
def test_a_first_run_compiles_nothing(tmp_path):
    """Neither of a built-in vehicle nor of a controller, in SUMO."""
    variables = {**os.environ, cache.FOLDER: str(tmp_path / "cache")}
    (tmp_path / "my_av.py").write_text(AV)

    def harness(*arguments):
        subprocess.run([sys.executable, "-m", "harness", *arguments], env=variables, cwd=tmp_path, check=True)

    def kernels():
        return {path.name for path in (tmp_path / "cache" / KERNELS).iterdir()}

    harness("setup")
    before = kernels()
    assert len(before) > 5
    for av in ("idm", "my_av.py:MyAV"):
        harness("run", av, "--set", "stop.episodes=300", "--set", "stop.rhw=null", "--out", av[:3])
    assert kernels() == before


def test_what_was_compiled_is_not_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.FOLDER, str(tmp_path))
    monkeypatch.setattr("harness.runner.setup.run_campaign", lambda *_, **__: None)
    assert [compile_kernels(), compile_kernels()] == [True, False]
