"""From the command to the first finished episode: with nothing cached, and with kernels and tables in the cache."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks.contenders import SCENARIOS

SHARD = 96
_POLL_S = 0.01


class Start(NamedTuple):
    """Seconds from the start of the process to its first episode on disk, and to its end, report included."""

    first_episode_s: float
    done_s: float


def start_up(name: str, cache: Path) -> Start:
    """Run ``harness run`` on a shipped campaign, in a process that finds only this cache of kernels and tables."""
    with tempfile.TemporaryDirectory(prefix="harness-benchmark-") as scratch:
        out = Path(scratch) / "run"
        settings = ("run.shard_size=96", f"stop.episodes={2 * SHARD}", "stop.rhw=null")
        command = [sys.executable, "-m", "harness", "run", str(SCENARIOS / f"overtaking_{name}.yaml")]
        command += ["--out", str(out), *(word for setting in settings for word in ("--set", setting))]
        environment = {**os.environ, "HARNESS_CACHE_DIR": str(cache), "PYTHONPATH": str(SCENARIOS.parent)}
        with (Path(scratch) / "log").open("w+") as log:
            started = time.perf_counter()
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            first_s = _wait_for_first_tests(process, out, started)
            if process.wait() != 0 or first_s is None:
                log.seek(0)
                raise RuntimeError(f"harness run {name} failed: {log.read()}")
            return Start(first_s, time.perf_counter() - started)


def _wait_for_first_tests(process: subprocess.Popen[bytes], out: Path, started: float) -> float | None:
    while process.poll() is None:
        if any((out / "episodes").glob("*.parquet")):
            return time.perf_counter() - started
        time.sleep(_POLL_S)
    return None


def cold_and_warm(name: str, warm_repetitions: int) -> tuple[Start, list[Start]]:
    """One start with an empty cache, then several with what it has left there."""
    with tempfile.TemporaryDirectory(prefix="harness-cache-") as cache:
        cold = start_up(name, Path(cache))
        return cold, [start_up(name, Path(cache)) for _ in range(warm_repetitions)]
