"""What `benchmarks.speed` prints: rates, ratios against what is asked for, cost per part, start-up."""

from __future__ import annotations

from statistics import median
from typing import NamedTuple

from benchmarks.contender_process import Measurement
from benchmarks.contenders import TWIN_CELLS, campaign
from benchmarks.startup import Start

HOW = f"""\
Campaign: scenarios/overtaking_nade.yaml (published NADE), {campaign("nade").world.cells} cells side by side in SUMO,
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


def ratio(found: dict[str, list[Measurement]], wanted: Ratio) -> float | None:
    """Median over rounds of the quotient within a round; None where one of the two was not measured."""
    if wanted.of not in found or wanted.to not in found:
        return None
    pairs = zip(found[wanted.of], found[wanted.to], strict=True)
    return median(getattr(a, wanted.quantity) / getattr(b, wanted.quantity) for a, b in pairs)


def _verdict(value: float, least: float | None, most: float | None) -> str:
    if least is None and most is None:
        return ""
    bound = f">= {least:,g}" if least is not None else f"<= {most:,g}"
    met = value >= least if least is not None else value <= most
    return f"asked {bound}: {'met' if met else 'MISSED'}"


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
        if rounds[0].part_s is None:
            continue
        print(f"\n{name}: wall time in ns per cell-step, stopwatch included")
        for part in sorted(rounds[0].part_s, key=lambda part: -rounds[0].part_s[part]):
            share = median(one.part_s[part] / sum(one.part_s.values()) for one in rounds)
            each = median(1e9 * one.part_s[part] / one.cell_steps for one in rounds)
            print(f"  {part:<32}{each:>8.0f}{share:>7.0%}")
