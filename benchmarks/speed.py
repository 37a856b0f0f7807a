"""What a test costs, as ratios: the harness in SUMO, one episode at a time, TraCI, SUMO alone, the twin.

    python -m benchmarks.speed
    python -m benchmarks.speed --quick --only harness+shim,floor
    python -m benchmarks.speed --json speed.json

Contenders wait in processes of their own and run in turn (A B C A B C …), so that noise of the machine hits all alike;
a ratio is the median of the ratios within one round. Ratios are of CPU time over all processes that a contender uses,
which hardly depends on what else runs; wall time is printed beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.contender_process import ContenderProcess, Measurement
from benchmarks.contenders import CONTENDERS, missing
from benchmarks.speed_page import RATIOS, ratio, show
from benchmarks.startup import Start, cold_and_warm
from harness.runner.manifest import cpu_name, versions

STARTUP = "startup"


def measure(names: Sequence[str], repetitions: int, scale: float) -> dict[str, list[Measurement]]:
    """Measurements of all contenders, taken in turn."""
    processes = []
    try:
        for name in names:
            print(f"  preparing {name}", file=sys.stderr)
            processes.append(ContenderProcess(name))
        require_equal_rows(processes)
        found: dict[str, list[Measurement]] = {name: [] for name in names}
        for repetition in range(repetitions):
            print(f"  round {repetition + 1} of {repetitions}", file=sys.stderr)
            for process in processes:
                n = max(20, round(CONTENDERS[process.name][1] * scale))
                found[process.name].append(process.measure(repetition * 100_000, n))
        return found
    finally:
        for process in processes:
            process.close()


def require_equal_rows(processes: Sequence[ContenderProcess]) -> None:
    """Stop where contenders that claim to run the same episodes do not."""
    of_nade = ("harness", "harness+shim", "one-at-a-time", "traci", "twin recorded", "parts", "parts+shim")
    rows = {process.name: process.rows for process in processes if process.name in of_nade}
    if len(set(rows.values())) > 1:
        raise RuntimeError(f"these contenders did not run the same episodes: {', '.join(rows)}")


def as_json(
    found: dict[str, list[Measurement]], starts: dict[str, tuple[Start, list[Start]]], command: str
) -> dict[str, object]:
    """Everything that was measured, and where."""
    return {
        "command": command,
        "date": datetime.now(UTC).date().isoformat(),
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "system": platform.system(),
        "versions": versions(),
        "measurements": {name: [one._asdict() for one in rounds] for name, rounds in found.items()},
        "ratios": [{**wanted._asdict(), "median": ratio(found, wanted)} for wanted in RATIOS],
        "startup": {
            name: {"cold": cold._asdict(), "warm": [one._asdict() for one in warm]}
            for name, (cold, warm) in starts.items()
        },
    }


def main() -> None:
    """Measure, print, and write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="a fifth of the episodes, start-up of one campaign only")
    parser.add_argument("--only", default="", help=f"of {', '.join([*CONTENDERS, STARTUP])}, separated by commas")
    parser.add_argument("--json", type=Path, help="write all measurements to this file")
    options = parser.parse_args()
    wanted = [name.strip() for name in options.only.split(",") if name.strip()] or [*CONTENDERS, STARTUP]
    if unknown := set(wanted) - {*CONTENDERS, STARTUP}:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join([*CONTENDERS, STARTUP])}")
    for name in wanted:
        if reason := missing(name):
            print(f"without {name}: {reason}")
    names = [name for name in wanted if name != STARTUP and not missing(name)]
    found = measure(names, options.repetitions, 0.2 if options.quick else 1.0)
    campaigns = ("nade",) if options.quick else ("nade", "recursive")
    starts = {name: cold_and_warm(name, options.repetitions) for name in campaigns} if STARTUP in wanted else {}
    show(found, starts)
    if options.json:
        command = "python -m benchmarks.speed " + " ".join(sys.argv[1:])
        options.json.write_text(json.dumps(as_json(found, starts, command.strip()), indent=1) + "\n")


if __name__ == "__main__":
    main()
