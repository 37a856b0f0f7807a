"""What it costs to come back to a large run folder: `harness run --resume` of a finished run, or with one more shard
until a worker is started for it, and `harness estimate`.

    python -m benchmarks.resume runs/resume

makes a folder of 1e6 tests of the forced cut-in in 200 shards (unless it is there: 0.15 GB) and measures the commands
in processes of their own. Only the first shard is simulated; the others repeat it under other indices, which is all the
same to whoever reads them.
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
SHARD = 5_000
SETTINGS = ("world.engine=twin", "world.cells=64", "stop.rhw=null", "records.traces=none")


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


def run_words(folder: Path, episodes: int) -> list[str]:
    """`harness run --resume` into a folder, up to so many tests."""
    settings = (*SETTINGS, f"run.shard_size={SHARD}", f"stop.episodes={episodes}")
    command = ["run", str(SCENARIOS / "overtaking_forced.yaml"), "--resume", "--quiet", "--out", str(folder)]
    return [*command, *(word for setting in settings for word in ("--set", setting))]


def make_run(folder: Path) -> None:
    """Simulate a shard, and repeat it up to the number of tests."""
    harness(*run_words(folder, SHARD))
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    table = pq.read_table(folder / shard_file("episodes", 0), partitioning=None)
    column = table.schema.get_field_index("episode")
    for index in range(1, EPISODES // SHARD):
        first, file = index * SHARD, shard_file("episodes", index)
        episode = pa.array(range(first, first + SHARD), pa.int64())
        table = table.set_column(column, table.schema.field(column), episode)
        pq.write_table(table, folder / file, compression=COMPRESSION)
        shard = {"index": index, "first_episode": first, "n_episodes": SHARD, "files": {"episodes": file}}
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


def main() -> None:
    """Make the folder if it is not there, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the run folder")
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    folder: Path = options.folder
    if not (folder / shard_file("episodes", EPISODES // SHARD - 1)).exists():
        make_run(folder)
    for name, command in (("resume", run_words(folder, EPISODES)), ("estimate", ["estimate", str(folder), "--json"])):
        for _ in range(options.repetitions):
            cost = harness(*command)
            print(f"  {name}: {cost.wall_s:.1f} s ({cost.cpu_s:.1f} s of CPU, {cost.gib:.2f} GiB)", flush=True)
    for _ in range(options.repetitions):
        wall_s = until_worker(*run_words(folder, EPISODES + SHARD))
        print(f"  one more shard: {wall_s:.1f} s until a worker starts", flush=True)


if __name__ == "__main__":
    main()
