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
from statistics import median
from typing import NamedTuple

from benchmarks.contender_process import ContenderProcess, Measurement
from benchmarks.contenders import CONTENDERS, NADE, TWIN_CELLS, campaign, missing
from benchmarks.startup import Start, cold_and_warm
from harness.runner.kept import cpu_name, versions

STARTUP = "startup"
HOW = f"""\
Campaign: scenarios/overtaking_nade_epsilon_0.1.yaml, {campaign(NADE).world.cells} cells side by side in SUMO,
{TWIN_CELLS} in the twin.
What ends an episode, everywhere: a crash; BV and LV in contact; AV past BV without a cut-in; 20 s (about 99 of 100).
Recorded: one row per episode and the first nine control steps, written to Parquet; "twin" alone keeps nothing.
Read back: by harness every position after every step, and every speed after every tenth step, with the shim after
every step; all are compared with what was commanded, bit for bit. By one-at-a-time (getters) and traci (subscriptions)
every position and speed after every step; by floor nothing. Harness, one-at-a-time and traci have given equal rows for
the first episodes. "bare one-at-a-time" tells and reads the same with no policy, no records and nothing compared: what
SUMO costs that way, whoever decides."""


class Ratio(NamedTuple):
    """A quotient of two contenders that must not be too small (``least``) or too large (``most``)."""

    of: str
    to: str
    quantity: str
    least: float | None = None
    most: float | None = None


RATIOS = (
    Ratio("harness", "one-at-a-time", "episodes_per_cpu_s", least=1.8),
    Ratio("harness+shim", "one-at-a-time", "episodes_per_cpu_s", least=3.0),
    Ratio("harness", "bare one-at-a-time", "episodes_per_cpu_s"),
    Ratio("harness+shim", "bare one-at-a-time", "episodes_per_cpu_s"),
    Ratio("harness", "traci", "episodes_per_cpu_s", least=35.0),
    Ratio("harness+shim", "traci", "episodes_per_cpu_s", least=55.0),
    Ratio("harness", "floor", "cpu_ns_per_cell_step", most=3.5),
    Ratio("harness+shim", "floor", "cpu_ns_per_cell_step", most=2.2),
    Ratio("2 workers", "1 worker", "episodes_per_s", least=1.8),
    Ratio("2 workers", "1 worker", "episodes_per_cpu_s"),
)
RATES = {
    "harness": 1_500.0,
    "harness+shim": 2_500.0,
    "twin nde": 100_000.0,
    "twin nade": 40_000.0,
    "twin recursive": 20_000.0,
}
"""Finished episodes per second and core that are asked for."""
COLD_S, WARM_S = 45.0, 5.0


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


def ratio(found: dict[str, list[Measurement]], wanted: Ratio) -> float | None:
    """Median over rounds of the quotient within a round; None where one of the two was not measured."""
    if wanted.of not in found or wanted.to not in found:
        return None
    pairs = zip(found[wanted.of], found[wanted.to], strict=True)
    return float(median(getattr(a, wanted.quantity) / getattr(b, wanted.quantity) for a, b in pairs))


def _verdict(value: float, least: float | None, most: float | None) -> str:
    asked = [(f">= {least:,g}", value >= least)] if least is not None else []
    asked += [(f"<= {most:,g}", value <= most)] if most is not None else []
    return ", ".join(f"asked {bound}: {'met' if met else 'MISSED'}" for bound, met in asked)


def show(found: dict[str, list[Measurement]], starts: dict[str, tuple[Start, list[Start]]]) -> None:
    """Print everything that was measured."""
    head = ("", "episodes/s/core", "(range)", "wall eps/s", "ns/cell-step", "kB/episode")
    print(f"\n{HOW}\n\n{head[0]:<20}{head[1]:>16}{head[2]:>18}{head[3]:>12}{head[4]:>14}{head[5]:>12}")
    for name, rounds in found.items():
        rates = [one.episodes_per_cpu_s for one in rounds]
        step = median(one.cpu_ns_per_cell_step for one in rounds)
        size = median(one.bytes_written / one.episodes for one in rounds) / 1e3
        span = f"{min(rates):,.0f}-{max(rates):,.0f}"
        wall = median(one.episodes_per_s for one in rounds)
        verdict = _verdict(median(rates), RATES.get(name), None)
        print(
            f"{name:<20}{median(rates):>16,.0f}{span:>18}{wall:>12,.0f}{step:>14,.1f}"
            f"{f'{size:.2f}' if size else '-':>12}  {verdict}".rstrip()
        )
    print("\nRatios (median over rounds)")
    for wanted in RATIOS:
        if (value := ratio(found, wanted)) is not None:
            text = f"{wanted.of} / {wanted.to}, {wanted.quantity}"
            print(f"  {text:<55}{value:>8.2f}  {_verdict(value, wanted.least, wanted.most)}".rstrip())
    _show_parts(found)
    for name, (cold, warm) in starts.items():
        first = median(one.first_episode_s for one in warm)
        print(f"\nStart-up of `harness run overtaking_{name}.yaml` until its first episodes are on disk")
        for text, one, most in (("cold", cold.first_episode_s, COLD_S), ("warm", first, WARM_S)):
            print(f"  {text} {one:6.1f} s  {_verdict(one, None, most)}")


def _show_parts(found: dict[str, list[Measurement]]) -> None:
    for name, rounds in found.items():
        parts = [one.part_s for one in rounds if one.part_s is not None]
        if not parts:
            continue
        print(f"\n{name}: wall time in ns per cell-step, stopwatch included")
        for part in sorted(parts[0], key=parts[0].__getitem__, reverse=True):
            share = median(part_s[part] / sum(part_s.values()) for part_s in parts)
            each = median(1e9 * part_s[part] / one.cell_steps for part_s, one in zip(parts, rounds, strict=True))
            print(f"  {part:<32}{each:>8.0f}{share:>7.0%}")


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
