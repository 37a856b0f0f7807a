"""Campaigns on a Ray cluster of two and three machines (namespaces of this one): bits, losses, overhead, memory.

    sudo python -m benchmarks.ray_cluster runs/ray

compares records with a local run's byte by byte (``bits``), also when a machine is switched off and when its cable is
pulled in mid-run (``losses``); times SUMO tests on two machines of one worker each against two local workers, in turns
(``overhead``); and samples the memory of the run's own process over many tests (``memory``).
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.contenders import SCENARIOS
from benchmarks.kills import finish, unlike
from benchmarks.ray_nodes import Nodes, missing

FORCED = ("overtaking_forced", "stop.rhw=null")
BITS = {
    "forced": (*FORCED, "world.engine=twin", "stop.episodes=20000", "run.shard_size=500"),
    "step_mixture": (
        "overtaking_nade_epsilon_0.1",
        "stop.rhw=null",
        "world.engine=twin",
        "stop.episodes=20000",
        "run.shard_size=500",
    ),
    "shells": ("overtaking_shells", "world.engine=twin", "stop.rhw=0.4", "testing.shells.first_tests=null"),
    "forced in SUMO": (*FORCED, "stop.episodes=4000", "run.shard_size=250"),
}
"""Scenario and settings."""
LOSSES = (*FORCED, "world.engine=twin", "stop.episodes=1000000", "run.shard_size=2000", "records.moments=none")
OVERHEAD = (*FORCED, "run.shard_size=1000", "records.moments=none")


def command(out: Path, campaign: tuple[str, ...], *more: str) -> list[str]:
    """`harness run` into a new folder."""
    shutil.rmtree(out, ignore_errors=True)
    scenario, *settings = campaign
    words = [sys.executable, "-m", "harness", "run", str(SCENARIOS / f"{scenario}.yaml"), "--out", str(out), *more]
    return [*words, "--quiet", *(word for setting in settings for word in ("--set", setting))]


def start(nodes: Nodes | None, words: list[str]) -> subprocess.Popen[bytes]:
    """Start it on the cluster's head, or here."""
    if nodes is None:
        return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    return nodes.start(*words, "--executor", "ray", stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def timed(nodes: Nodes | None, words: list[str]) -> float:
    """Run it; how long it took (s)."""
    began = time.monotonic()
    finish(start(nodes, words))
    return time.monotonic() - began


def verdict(calm: Path, other: Path) -> str:
    """Whether records are the same, in words."""
    differing = unlike(calm, other)
    return f"DIFFERENT: {', '.join(differing)}" if differing else "records equal, byte for byte"


def bits(folder: Path, cache: Path | None) -> Iterator[str]:
    """Each campaign locally, on two and on three machines."""
    for n in (2, 3):
        with Nodes(folder / f"nodes-{n}", n, cache=cache) as nodes:
            for name, campaign in BITS.items():
                local = folder / "local" / name
                if not local.exists():
                    finish(start(None, command(local, campaign, "--workers", "2")))
                seconds = timed(nodes, command(folder / f"on-{n}" / name, campaign))
                yield f"{name}, {n} machines, {seconds:.0f} s: {verdict(local, folder / f'on-{n}' / name)}"


def losses(folder: Path, cache: Path | None, n_episodes: int) -> Iterator[str]:
    """A machine is lost, or only its cable, after a tenth of the tests; it comes back later, and is used again."""
    campaign = (*LOSSES, f"stop.episodes={n_episodes}")
    local = folder / "local" / "losses"
    finish(start(None, command(local, campaign, "--workers", "2")))
    for how in ("switched off", "cut off"):
        out = folder / how.replace(" ", "-")
        with Nodes(folder / "nodes-losses", 3, cache=cache) as nodes:
            began = time.monotonic()
            run = start(nodes, command(out, campaign))
            while len(list((out / "episodes").glob("*"))) < n_episodes / 2000 / 10:
                if run.poll() is not None:
                    break
                time.sleep(0.1)
            struck = time.monotonic() - began
            nodes.power_off(2) if how == "switched off" else nodes.cut(2)
            finish(run)
            seconds = time.monotonic() - began
        yield f"a machine of three {how} after {struck:.0f} of {seconds:.0f} s: {verdict(local, out)}"


def overhead(folder: Path, cache: Path | None, n_episodes: int, pairs: int) -> Iterator[str]:
    """Two local workers and two machines of one worker, in turns."""
    campaign = (*OVERHEAD, f"stop.episodes={n_episodes}")
    ratios = []
    with Nodes(folder / "nodes-overhead", 2, cache=cache) as nodes:
        for _ in range(pairs):
            here = timed(None, command(folder / "here", campaign, "--workers", "2"))
            there = timed(nodes, command(folder / "there", campaign))
            ratios.append(there / here)
            yield f"{n_episodes:,} tests in SUMO: {here:.1f} s by two local workers, {there:.1f} s by two machines"
    yield f"ratio: {statistics.median(ratios):.3f} (median; {', '.join(f'{ratio:.3f}' for ratio in ratios)})"


def memory(folder: Path, cache: Path | None, n_episodes: int) -> Iterator[str]:
    """Resident memory of the run's own process, in tenths of its tests."""
    campaign = (*LOSSES, f"stop.episodes={n_episodes}")
    out = folder / "memory"
    with Nodes(folder / "nodes-memory", 2, cache=cache) as nodes:
        run = start(nodes, command(out, campaign))
        n_shards = n_episodes // 2000
        seen: dict[int, float] = {}
        while run.poll() is None:
            tenth = 10 * len(list((out / "episodes").glob("*"))) // n_shards
            seen[tenth] = max(seen.get(tenth, 0.0), _resident_mb(run.pid))
            time.sleep(0.2)
        finish(run)
    yield "resident memory (MB) by tenths of the tests: " + ", ".join(f"{seen[tenth]:.0f}" for tenth in sorted(seen))


def _resident_mb(pid: int) -> float:
    """Of the run, which `nsenter` has become or started."""
    task = Path(f"/proc/{pid}/task/{pid}/children")
    pids = [pid, *map(int, task.read_text().split())] if task.exists() else [pid]
    sizes = [0.0]
    for each in pids:
        status = Path(f"/proc/{each}/status")
        if status.exists():
            sizes += [float(line.split()[1]) / 1000.0 for line in status.read_text().splitlines() if "VmRSS" in line]
    return max(sizes)


def main() -> int:
    """Measure what is asked for; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="place of run folders and caches; what is there goes")
    parser.add_argument("--only", choices=("bits", "losses", "overhead", "memory"))
    parser.add_argument(
        "--cache",
        type=Path,
        help="what the machines' caches begin with; default: nothing. $HARNESS_CACHE_DIR, for estimates of forced "
        "cut-ins to be equal, too: they are compared with surrogates where a pool is cached",
    )
    parser.add_argument(
        "--episodes", type=int, help="default: 200,000 for losses, 100,000 for overhead, 1e6 for memory"
    )
    parser.add_argument("--pairs", type=int, default=3)
    options = parser.parse_args()
    if why := missing():
        parser.error(f"this machine cannot play several: {why}")
    folder, cache, n = options.folder.resolve(), options.cache, options.episodes
    asked = {
        "bits": lambda: bits(folder, cache),
        "losses": lambda: losses(folder, cache, n or 200_000),
        "overhead": lambda: overhead(folder, cache, n or 100_000, options.pairs),
        "memory": lambda: memory(folder, cache, n or 1_000_000),
    }
    failed = False
    for what in [options.only] if options.only else asked:
        for line in asked[what]():
            failed |= "DIFFERENT" in line
            print(line, flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
