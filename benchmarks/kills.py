"""Kill workers and parents of running campaigns at random moments: nothing on record may differ, nobody may live on.

    python -m benchmarks.kills runs/kills --kills 1000

runs a campaign of each of three methods in the twin, once undisturbed and once with SIGKILL to a worker or to the
parent at random moments, again and again with ``--resume``, until all kills are spent. Then it compares every file of
records, and ``estimates.json``, byte by byte. A parent's workers must be gone `GRACE_S` after its death. Kills follow
from ``--seed``; what they strike depends on the machine's load, and so differs each time.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from benchmarks.contenders import SCENARIOS
from harness.records.folder import TABLES

METHODS = {"forced": "overtaking_forced", "step_mixture": "overtaking_nade", "shells": "smoke"}
"""Method and its scenario."""
SETTINGS = ("world.engine=twin", "world.cells=64", "stop.rhw=null", "run.shard_size=100", "records.trace_share=0.01")
GRACE_S = 5.0
WORKERS_SHARE = 0.5
"""Of the kills."""
LONGEST_WAIT_S = 600.0
DONE, LOST = (0, 4), 3
"""Exit codes; the last when workers were killed three times on the same shard."""
_POLL_S = 0.02


def start(method: str, out: Path, episodes: int) -> subprocess.Popen[bytes]:
    """`harness run --resume` with two workers."""
    settings = (*SETTINGS, f"stop.episodes={episodes}")
    command = [sys.executable, "-m", "harness", "run", str(SCENARIOS / f"{METHODS[method]}.yaml"), "--resume"]
    command += ["--quiet", "--workers", "2", "--out", str(out)]
    command += [word for setting in settings for word in ("--set", setting)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def finish(process: subprocess.Popen[bytes]) -> None:
    """Let a run come to its end."""
    _, complaints = process.communicate(timeout=LONGEST_WAIT_S)
    if process.returncode not in DONE:
        raise RuntimeError(f"the run ended with {process.returncode}: {complaints.decode()}")


def descendants(pid: int) -> list[int]:
    """Processes below one, at present."""
    below = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, task.read_text().split()):
                below += [child, *descendants(child)]
    return below


def is_worker(pid: int) -> bool:
    """Whether a process is a worker, not the library's own that looks after its resources."""
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that is only waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def orphans(pids: list[int]) -> list[int]:
    """Those of a killed parent's processes that are still there after a while."""
    until = time.monotonic() + GRACE_S
    while (left := [pid for pid in pids if is_alive(pid)]) and time.monotonic() < until:
        time.sleep(_POLL_S)
    return left


def disturbed(
    method: str, out: Path, episodes: int, chance: random.Random, kills: int, longest_s: float
) -> Counter[str]:
    """Run a campaign to its end in spite of so many kills, and count them."""
    done: Counter[str] = Counter()
    while done["parent"] + done["worker"] < kills:
        process = start(method, out, episodes)
        while process.poll() is None and done["parent"] + done["worker"] < kills:
            with suppress(subprocess.TimeoutExpired):
                process.wait(chance.uniform(0.0, longest_s))
                continue
            below = descendants(process.pid)
            workers = [pid for pid in below if is_worker(pid)]
            if workers and chance.random() < WORKERS_SHARE:
                with suppress(ProcessLookupError):
                    os.kill(chance.choice(workers), signal.SIGKILL)
                    done["worker"] += 1
                continue
            process.kill()
            done["parent"] += 1
            done["orphan"] += len(orphans(below))
        _, complaints = process.communicate(timeout=LONGEST_WAIT_S)
        if process.returncode not in (*DONE, LOST, -signal.SIGKILL):
            raise RuntimeError(f"the run ended with {process.returncode}: {complaints.decode()}")
        if process.returncode in DONE and done["parent"] + done["worker"] < kills:
            shutil.rmtree(out)  # it was faster than the kills: once more from the beginning
    finish(start(method, out, episodes))
    return done


def unlike(a: Path, b: Path) -> list[str]:
    """Files of records that differ in a byte or are in one folder only."""
    names = {f"{table}/{path.name}" for table in TABLES for out in (a, b) for path in (out / table).glob("*")}
    names |= {"estimates.json"}
    return sorted(name for name in names if _bytes(a / name) != _bytes(b / name))


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def main() -> int:
    """Run, kill, compare; 1 if anything differs or lives on."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="place of the run folders; what is there goes")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=20_000, help="of each campaign")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=METHODS)
    options = parser.parse_args()
    chance, failed = random.Random(options.seed), False
    methods = [options.only] if options.only else list(METHODS)
    for k, method in enumerate(methods):
        calm, struck = options.folder / method / "undisturbed", options.folder / method / "killed"
        shutil.rmtree(options.folder / method, ignore_errors=True)
        began = time.monotonic()
        finish(start(method, calm, options.episodes))
        kills = (options.kills + k) // len(methods)
        done = disturbed(method, struck, options.episodes, chance, kills, 0.7 * (time.monotonic() - began))
        differing = unlike(calm, struck)
        failed |= bool(differing or done["orphan"])
        verdict = f"DIFFERENT: {', '.join(differing)}" if differing else "records equal, byte for byte"
        struck_down = f"{done['parent']} parents and {done['worker']} workers killed, {done['orphan']} orphans"
        print(f"{method}: {struck_down}; {verdict}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
