"""Crash rate of a campaign by a long run of the twin that keeps sums instead of records.

    python -m benchmarks.reference_rates scenarios/overtaking_forced.yaml --episodes 1e7 --seed 777

prints one line of JSON: rate, standard error, crashes, and the command. Used where a run folder would take tens of
gigabytes: the committed references of the tests, and plain NDE with 1e8 episodes.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.resolved import resolve
from harness.sampling import prepare
from harness.sampling.protocol import Source
from harness.vocabulary import CONTACT, CRASH
from harness.worlds.twin import TwinWorld

CELLS = 1024
CHUNK = 50_000


@cache
def _prepared(path: str, overrides: tuple[str, ...]) -> Source:
    return prepare(resolve(_campaign(path, overrides)))


def _campaign(path: str, overrides: tuple[str, ...]) -> Campaign:
    return load_campaign(path, overrides)


def sums_of(task: tuple[str, tuple[str, ...], int, int]) -> np.ndarray:
    """(n, crashes, ΣY, ΣY², ΣW·1{cut-in}, ΣW·1{contact}) of a range of episodes."""
    path, overrides, first, n = task
    prepared = _prepared(path, overrides)
    rows = prepared.loop(TwinWorld(CELLS)).run(first, prepared.tests(first, n)).episode
    weight = np.exp(rows["log_weight"])
    crash = rows["outcome"] == CRASH
    y = np.where(crash, weight, 0.0)
    cut_in, contact = rows["event_step"] >= 0, rows["outcome"] == CONTACT
    return np.array([n, crash.sum(), y.sum(), (y * y).sum(), weight[cut_in].sum(), weight[contact].sum()])


def reference(path: str, overrides: Sequence[str], episodes: int, workers: int) -> dict[str, float]:
    """Rate and standard error over ``episodes`` episodes."""
    settings = (*overrides, "world.engine=twin", "records.moments=none", "records.traces=none")
    prepare(resolve(_campaign(path, settings)))  # tables and kernels are built once, before the workers start
    tasks = [(path, settings, first, min(CHUNK, episodes - first)) for first in range(0, episodes, CHUNK)]
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        total = sum(pool.map(sums_of, tasks), np.zeros(6))
    n, crashes, y, y2, cut, contact = (float(value) for value in total)
    rate = y / n
    std_error = math.sqrt(max(y2 / n - rate * rate, 0.0) / (n - 1))
    return {
        "crash_rate": rate,
        "std_error": std_error,
        "relative_error": std_error / rate if rate else math.nan,
        "relvar": (y2 / n - rate * rate) / (rate * rate) if rate else math.nan,
        "n_episodes": int(n),
        "n_crashes": int(crashes),
        "mean_weight_event": cut / n,
        "mean_weight_contact": contact / n,
    }


def main() -> None:
    """Parse the command line and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign")
    parser.add_argument("--episodes", type=float, default=1e6)
    parser.add_argument("--seed", type=int, required=True, help="other than that of the runs it is compared with")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="A.B=C")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    started = time.monotonic()
    overrides = [*arguments.overrides, f"seed={arguments.seed}"]
    result = reference(arguments.campaign, overrides, int(arguments.episodes), arguments.workers)
    command = "python -m benchmarks.reference_rates " + " ".join(sys.argv[1:])
    print(json.dumps({**result, "seconds": round(time.monotonic() - started, 1), "command": command}))


if __name__ == "__main__":
    main()
