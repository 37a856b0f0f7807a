"""A vehicle's code is that of its files, as they are now."""

from __future__ import annotations

import os
import py_compile
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from harness.campaign.python_files import FromSource
from harness.controllers.find import own_code
from tests.worlds.running import drive


@pytest.fixture
def rewritten(tmp_path, monkeypatch):
    """Writes a file that Python has compiled when it said something else, of the same size in the same second."""
    monkeypatch.setattr(sys, "path", [*sys.path])

    def write(name: str, before: str, now: str):
        file = tmp_path / name
        for text in (before, now):
            assert len(before) == len(now)
            file.write_text(text, "utf-8")
            os.utime(file, (1.7e9, 1.7e9))
            if text is before:
                py_compile.compile(str(file))
        return file

    return write


VEHICLE = """
from {beside} import HARDEST
class Brakes:
    hardest = HARDEST, {own}
    def step(self, seen): return 0.0
"""


@pytest.mark.parametrize(("name", "hardest"), [("brakes", 7), ("others", 4)])
def test_what_python_has_kept_of_other_versions_is_not_run_unlike_by_its_own_loader(
    name, hardest, rewritten, monkeypatch
):
    if name == "others":
        monkeypatch.delattr(FromSource, "get_code")
    rewritten(f"beside_of_{name}.py", "HARDEST = 4", "HARDEST = 7")
    before, now = (VEHICLE.format(beside=f"beside_of_{name}", own=own) for own in (4, 7))
    file = rewritten(f"{name}.py", before, now)
    assert own_code(f"{file}:Brakes").hardest == (hardest, hardest)


def test_nor_of_what_lies_beside_a_script(rewritten):
    rewritten("beside_of_script.py", "HARDEST = 1", "HARDEST = 2")
    script = (
        "import traci\nfrom beside_of_script import HARDEST\ntraci.start([])\nwhile True:\n    traci.simulationStep()\n"
        "    traci.vehicle.setAcceleration('ego', -HARDEST, 0.1)\n"
    )
    file = rewritten("script.py", script, script)
    shard = drive(f"av={{controller: '{file}'}}", n=4)
    assert shard.failures == {}
    assert min(trace[:-1, 2, 2].min() for trace in shard.traces.values()) == -2.0


def test_nobody_sees_half_of_a_file_that_another_thread_runs(tmp_path):
    file = tmp_path / "slow.py"
    file.write_text("import time\n\ntime.sleep(0.2)\n\n\ndef challenge():\n    return 0.5\n")
    with ThreadPoolExecutor(3) as threads:
        found = list(threads.map(own_code, [f"{file}:challenge"] * 3))
    assert [each() for each in found] == [0.5] * 3
