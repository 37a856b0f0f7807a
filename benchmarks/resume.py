"""What it costs to come back to a large run folder: `harness run --resume` of a finished run, or with one more shard
until a worker is started for it, and `harness estimate`.

    python -m benchmarks.resume runs/resume

makes two folders of 1e6 tests of the forced cut-in (unless they are there: 0.3 GB), one of 200 shards, one of 10,000,
and measures the commands in processes of their own. Only the first shards are simulated; the others repeat them under
other indices, which is all the same to whoever reads them. They are gathered before anything is measured.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.contenders import SCENARIOS
from harness.records.folder import COMPRESSION, shard_file, write_json

EPISODES = 1_000_000
SIMULATED = 5_000
SETTINGS = ("world.engine=twin", "world.cells=64", "stop.rhw=null", "records.traces=none")


class Size(NamedTuple):
    """A run folder, and the seconds that its commands may take."""

    shard_size: int
    resume_s: float
    estimate_s: float


SIZES = {"200 shards": Size(5_000, 3.0, 6.0), "10,000 shards": Size(100, 5.0, 6.0)}


class Cost(NamedTuple):
    """Wall time and CPU time of a command, workers included, and its largest resident memory."""

    wall_s: float
    cpu_s: float
    gib: float


def harness(*arguments: str) -> Cost:
    """Run a command in a process of its own."""
    started = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "harness", *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise RuntimeError(f"harness {' '.join(arguments)} ended with {status}")
    return Cost(time.perf_counter() - started, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 2**20)


def run_words(folder: Path, size: int, episodes: int) -> list[str]:
    """`harness run --resume` into a folder, up to so many tests."""
    settings = (*SETTINGS, f"run.shard_size={size}", f"stop.episodes={episodes}")
    command = ["run", str(SCENARIOS / "overtaking_forced.yaml"), "--resume", "--quiet", "--out", str(folder)]
    return [*command, *(word for setting in settings for word in ("--set", setting))]


def make_run(folder: Path, size: int) -> None:
    """Simulate a few shards, and repeat them up to the number of tests."""
    harness(*run_words(folder, size, SIMULATED))
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    simulated = [pq.read_table(folder / shard["files"]["episodes"], partitioning=None) for shard in manifest["shards"]]
    for index in range(len(simulated), EPISODES // size):
        table = simulated[index % len(simulated)]
        column = table.schema.get_field_index("episode")
        episode = pa.array(range(index * size, (index + 1) * size), pa.int64())
        table = table.set_column(column, table.schema.field(column), episode)
        file = shard_file("episodes", index)
        pq.write_table(table, folder / file, compression=COMPRESSION)
        shard = {"index": index, "first_episode": index * size, "n_episodes": size, "files": {"episodes": file}}
        manifest["shards"].append(shard)
    write_json(path, {**manifest, "n_episodes": EPISODES, "status": "interrupted"})


def until_worker(*arguments: str) -> float:
    """Wall time (s) of a command until its first worker process is there; it is killed then."""
    started = time.perf_counter()
    with subprocess.Popen([sys.executable, "-m", "harness", *arguments], stdout=subprocess.DEVNULL) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        while process.poll() is None and not children.read_text():
            time.sleep(0.005)
        seconds = time.perf_counter() - started
        process.kill()
    if process.returncode != -signal.SIGKILL:
        raise RuntimeError(f"harness {' '.join(arguments)} ended with {process.returncode} without a worker")
    return seconds


def measured(folder: Path, size: Size, repetitions: int) -> None:
    """Print what the commands take."""
    finished = run_words(folder, size.shard_size, EPISODES)
    harness(*finished)
    for name, command, asked_s in (
        ("resume", finished, size.resume_s),
        ("estimate", ["estimate", str(folder), "--json"], size.estimate_s),
    ):
        for _ in range(repetitions):
            cost = harness(*command)
            print(f"  {name}: {cost.wall_s:.1f} s ({cost.cpu_s:.1f} s of CPU); asked <= {asked_s:.0f} s", flush=True)
    for _ in range(repetitions):
        wall_s = until_worker(*run_words(folder, size.shard_size, EPISODES + size.shard_size))
        print(f"  one more shard: {wall_s:.1f} s until a worker starts; asked <= {size.resume_s:.0f} s", flush=True)


def main() -> None:
    """Make the folders that are not there, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="place of the run folders")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--only", choices=SIZES, help="one of the two")
    options = parser.parse_args()
    for name in [options.only] if options.only else SIZES:
        folder, size = options.folder / name.replace(" ", "-").replace(",", ""), SIZES[name]
        if not (folder / shard_file("episodes", EPISODES // size.shard_size - 1)).exists():
            make_run(folder, size.shard_size)
        print(f"{EPISODES:,} tests in {name}")
        measured(folder, size, options.repetitions)


if __name__ == "__main__":
    main()
