"""Kill what a running campaign consists of at random moments: nothing on record may differ, nobody may live on.

    python -m benchmarks.kills runs/kills --kills 1000
    sudo python -m benchmarks.kills runs/kills --kills 200 --machines 3

runs a campaign of each of three methods in the twin, once undisturbed and once with SIGKILL to a worker or to the
run's own process, with equal chances, at random moments less than ``--pause`` seconds apart, again and again with
``--resume``, until all kills are spent (a run that comes to its end before is begun anew); with ``--machines`` on a
Ray cluster of so many (namespaces of this one), also to actors, and to the raylets of machines, which are then started
again. Without ``--machines`` commands are killed as a whole, too: `compare`, `pool` in a cache of its own, `estimate
--write` and `report`, each again and again until it comes to its end. Then it compares every file of records, and
``estimates.json``, byte by byte. What a killed run had started must be gone soon after. Kills follow from ``--seed``;
what they strike depends on the machine's load, and so differs each time.
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
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from benchmarks.contenders import SCENARIOS
from benchmarks.ray_nodes import Nodes, missing
from harness.records.folder import TABLES

METHODS = {"forced": "overtaking_forced", "step_mixture": "overtaking_nade", "shells": "overtaking_shells"}
"""Method and its scenario."""
SETTINGS = ("world.engine=twin", "world.cells=64", "stop.rhw=null", "run.shard_size=500", "records.trace_share=0.01")
LONGEST_WAIT_S = 600.0
DONE, LOST = (0, 4), 3
"""Exit codes; the last when workers were killed three times on the same shard."""
_POLL_S = 0.02


def command(method: str, out: Path, episodes: int) -> list[str]:
    """`harness run --resume`."""
    settings = (*SETTINGS, f"stop.episodes={episodes}")
    words = [sys.executable, "-m", "harness", "run", str(SCENARIOS / f"{METHODS[method]}.yaml"), "--resume", "--quiet"]
    return [*words, "--out", str(out), *(word for setting in settings for word in ("--set", setting))]


COMMANDS = {
    "compare": "compare {scenario} late-600ms --out {work} --workers 2 --quiet --set world.engine=twin "
    "--set stop.rhw=0.3",
    "pool": "pool {scenario} --set pool.relative_error=0.05",
    "estimate": "estimate {work} --write",
    "report": "report {work}",
}
"""What is killed as a whole; the last two on a copy of a finished run."""


class Here:
    """Runs with two workers that are processes of their own."""

    grace_s = 5.0

    def start(self, words: list[str]) -> subprocess.Popen[bytes]:
        """Start a run."""
        return subprocess.Popen([*words, "--workers", "2"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

    def targets(self, run: subprocess.Popen[bytes]) -> dict[str, list[int]]:
        """What can be killed."""
        return {
            "run": [run.pid],
            "worker": [pid for pid in descendants(run.pid) if started_by(pid, b"multiprocessing.forkserver")],
        }

    def mend(self) -> None:
        """Nothing is broken for long."""


class OnMachines(Here):
    """Runs on a Ray cluster that outlives them."""

    grace_s = 30.0  # Ray has to notice

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes

    def start(self, words: list[str]) -> subprocess.Popen[bytes]:
        """See `Here`."""
        words = [*words, "--executor", "ray", "--workers", str(self._nodes.n)]
        return self._nodes.start(*words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

    def targets(self, run: subprocess.Popen[bytes]) -> dict[str, list[int]]:
        """See `Here`; the head's raylet is spared: a cluster without its head is none."""
        on = (k for k in range(self._nodes.n) if not self._nodes.is_off(k))  # one may end while it joins again
        machines = [descendants(self._nodes.init(k)) for k in on]
        everywhere = [pid for machine in machines for pid in machine]
        return {
            "run": [pid for pid in descendants(run.pid) if started_by(pid, b"harness\0run")],
            "worker": [pid for pid in everywhere if started_by(pid, b"multiprocessing.forkserver")],
            "actor": [pid for pid in everywhere if started_by(pid, b"ray::OnMachine")],
            "raylet": [pid for machine in machines[1:] for pid in machine if started_by(pid, b"/raylet/raylet")],
        }

    def mend(self) -> None:
        """Start machines again that ended with their raylet."""
        for k in range(1, self._nodes.n):
            if self._nodes.is_off(k):
                self._nodes.power_on(k)


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


def started_by(pid: int, words: bytes) -> bool:
    """Whether a process was started by these words."""
    try:
        return words in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that is only waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def orphans(pids: list[int], grace_s: float) -> list[int]:
    """Those of a killed run's processes that are still there after a while."""
    until = time.monotonic() + grace_s
    while (left := [pid for pid in pids if is_alive(pid)]) and time.monotonic() < until:
        time.sleep(_POLL_S)
    return left


def disturbed(
    place: Here, method: str, out: Path, episodes: int, chance: random.Random, kills: int, pause_s: float
) -> Counter[str]:
    """Run a campaign to its end in spite of so many kills, and count them; orphans under a name of their own."""
    done: Counter[str] = Counter()

    def left() -> bool:
        return done.total() - done["orphan"] < kills

    while left():
        process = place.start(command(method, out, episodes))
        while process.poll() is None and left():
            with suppress(subprocess.TimeoutExpired):
                process.wait(chance.uniform(0.0, pause_s))
                continue
            place.mend()
            targets = place.targets(process)
            kind = chance.choice(sorted(targets))
            if not targets[kind]:
                continue  # not yet, or not at the moment
            below = [pid for other in ("worker", "actor") for pid in targets.get(other, [])]
            with suppress(ProcessLookupError):
                os.kill(chance.choice(targets[kind]), signal.SIGKILL)
                done[kind] += 1
            if kind == "run":
                done["orphan"] += len(orphans(below, place.grace_s))
        _, complaints = process.communicate(timeout=LONGEST_WAIT_S)
        if process.returncode not in (*DONE, LOST, -signal.SIGKILL, 128 + signal.SIGKILL):
            raise RuntimeError(f"the run ended with {process.returncode}: {complaints.decode()}")
        if process.returncode in DONE and left():
            shutil.rmtree(out)  # it was faster than the kills: once more from the beginning
    place.mend()
    finish(place.start(command(method, out, episodes)))
    return done


def struck_command(name: str, folder: Path, run: Path, chance: random.Random, kills: int, pause_s: float) -> list[str]:
    """Kill a command so many times; what differs of an undisturbed one's files, lives on, or is left in ``TMPDIR``."""
    wrong: list[str] = []
    shutil.rmtree(folder, ignore_errors=True)
    for side in ("undisturbed", "killed"):  # in folders of one name: a page names its own
        work, temporary, left = folder / side / "work", folder / side / "tmp", kills if side == "killed" else 0
        temporary.mkdir(parents=True)
        shutil.copytree(run, work) if name in ("estimate", "report") else work.mkdir()
        words = COMMANDS[name].format(scenario=SCENARIOS / "overtaking_shells.yaml", work=work.name).split()
        cache = {"HARNESS_CACHE_DIR": str(folder / side / "cache")} if name == "pool" else {}
        environment = {**os.environ, "TMPDIR": str(temporary), **cache}
        while True:
            process = subprocess.Popen(
                [sys.executable, "-m", "harness", *words],
                cwd=work.parent,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )
            with suppress(subprocess.TimeoutExpired):
                process.wait(chance.uniform(0.0, pause_s) if left else LONGEST_WAIT_S)
            if process.poll() is None:
                below = descendants(process.pid)
                process.kill()
                left -= 1
                wrong += [f"process {pid}" for pid in orphans(below, Here.grace_s)]
            _, complaints = process.communicate()
            if process.returncode not in (*DONE, -signal.SIGKILL):
                raise RuntimeError(f"{name} ended with {process.returncode}: {complaints.decode()}")
            if not left and process.returncode in DONE:
                break
        if cache:
            shutil.copytree(folder / side / "cache" / "pools", work / "pools")
        wrong += [str(path) for path in temporary.iterdir() if path.name[:5] != "pymp-"]  # multiprocessing's own
    of_time = ("manifest.json", "report.html") if name == "compare" else ()
    return wrong + differing_files(folder / "undisturbed" / "work", folder / "killed" / "work", of_time)


def differing_files(a: Path, b: Path, ignored: Collection[str]) -> list[str]:
    """Files of two folders that differ."""
    names = {path.relative_to(side) for side in (a, b) for path in side.rglob("*") if path.is_file()}
    return sorted(str(name) for name in names if name.name not in ignored and _bytes(a / name) != _bytes(b / name))


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
    parser.add_argument("--pause", type=float, default=5.0, help="longest time from one kill to the next, s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=METHODS)
    parser.add_argument("--machines", type=int, help="run on a Ray cluster of so many")
    parser.add_argument("--cache", type=Path, help="what the machines' caches begin with; default: nothing")
    options = parser.parse_args()
    folder = options.folder.resolve()
    if options.machines is None:
        return campaigns(Here(), folder, options)
    if why := missing():
        parser.error(f"this machine cannot play several: {why}")
    with Nodes(folder / "machines", options.machines, cache=options.cache) as nodes:
        return campaigns(OnMachines(nodes), folder, options)


def campaigns(place: Here, folder: Path, options: argparse.Namespace) -> int:
    """Each method: undisturbed, disturbed, compared."""
    chance, failed = random.Random(options.seed), False
    methods = [options.only] if options.only else list(METHODS)
    for k, method in enumerate(methods):
        calm, struck = folder / method / "undisturbed", folder / method / "killed"
        shutil.rmtree(folder / method, ignore_errors=True)
        finish(place.start(command(method, calm, options.episodes)))
        kills = (options.kills + k) // len(methods)
        done = disturbed(place, method, struck, options.episodes, chance, kills, options.pause)
        differing = unlike(calm, struck)
        failed |= bool(differing or done["orphan"])
        verdict = f"DIFFERENT: {', '.join(differing)}" if differing else "records equal, byte for byte"
        killed = ", ".join(f"{n} {kind}s" for kind, n in sorted(done.items()) if kind != "orphan")
        print(f"{method}: {killed} killed, {done['orphan']} orphans; {verdict}", flush=True)
    if options.machines is None and not options.only:
        run, kills = folder / methods[-1] / "undisturbed", options.kills // len(COMMANDS)
        for name in COMMANDS:
            wrong = struck_command(name, folder / name, run, chance, kills, options.pause)
            failed |= bool(wrong)
            print(f"{name}: {kills} killed; {', '.join(wrong) or 'files equal, byte for byte'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
