"""The benchmark of speed has hooks in the loop's own functions: all contenders of this machine still run."""

import subprocess
import sys

import pytest

from benchmarks.contenders import CONTENDERS, missing


@pytest.mark.slow
def test_all_contenders_run():
    names = [name for name in CONTENDERS if not missing(name) and name != "traci"]
    command = [sys.executable, "-m", "benchmarks.speed", "--quick", "--repetitions", "1", "--only", ",".join(names)]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert all(f"\n{name}  " in found for name in names)
