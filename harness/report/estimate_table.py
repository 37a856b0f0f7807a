"""The table of estimators, and what the reader must be warned of before believing any of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from harness.report.answer_plot import rate_exponent
from harness.report.number_format import (
    MISSING,
    count,
    exponent_of,
    fixed,
    half_width,
    number,
    percent,
    power_of_ten,
    significant,
)
from harness.report.run_folder import RunFolder
from harness.report.summary import RunSummary
from harness.stopped_by import MENDS


@dataclass(frozen=True)
class EstimateRow:
    """One estimator, formatted; ``reason`` instead of numbers when the records do not allow it."""

    name: str
    is_headline: bool
    rate: str
    ends: str
    upper_bound: str
    rhw: str
    per_1e6_km: str
    n_episodes: str
    n_crashes: str
    n_effective: str
    largest_weight_share: str
    method: str
    warnings: tuple[str, ...]
    reason: str | None


@dataclass(frozen=True)
class EstimateTable:
    """All estimators with the power of ten (``unit``) that their rates share."""

    unit: str
    rows: tuple[EstimateRow, ...]


def estimate_table(estimates: dict[str, Any]) -> EstimateTable:
    """Rows in the order of estimates.json, the headline first."""
    exponent = rate_exponent(estimates)
    names = sorted(estimates["estimates"], key=lambda name: name != estimates["headline"])
    rows = tuple(_row(name, estimates, exponent) for name in names)
    return EstimateTable(f" × {power_of_ten(exponent)}" if exponent else "", rows)


def run_notes(run: RunFolder, summary: RunSummary) -> list[str]:
    """Return what the reader must know about this run as a whole."""
    notes = list(run.headline.get("warnings") or [])
    notes += _coverage_notes(run, summary)
    n_failed = summary.n_episodes and int(summary.count[-1])
    if n_failed:
        share = percent(n_failed / summary.n_episodes)
        notes.append(
            f"{count(n_failed)} of {count(summary.n_episodes)} tests failed ({share}). They are kept as rows and "
            "listed under Outcomes; a crash rate over the others is biased if failing and crashing go together."
        )
    return notes


def _coverage_notes(run: RunFolder, summary: RunSummary) -> list[str]:
    notes = []
    n_estimated, n_failed = run.estimates.get("n_episodes"), int(summary.count[-1])
    if n_estimated is not None and n_estimated not in (summary.n_episodes, summary.n_episodes - n_failed):
        notes.append(
            f"The estimates cover {count(n_estimated)} tests but the records hold {count(summary.n_episodes)}: run "
            "harness estimate DIR --write."
        )
    target, rhw = target_rhw(run), run.headline.get("rhw")
    if asked_of_conditional(run):
        rhw = run.headline["details"]["conditional"]["rhw"]
    if target is not None and (rhw is None or not rhw <= target):
        reached = "it is not known" if rhw is None else f"it is {half_width(rhw)}"
        mend = MENDS.get(run.manifest.get("stopped_by") or "")
        why = f" ({mend})" if mend else ""
        notes.append(f"The asked relative half-width of {target:g} was not reached: {reached}{why}.")
    return notes


def target_rhw(run: RunFolder) -> float | None:
    """Relative half-width that the campaign asked for, if any."""
    stop = run.campaign.get("stop")
    target = stop.get("rhw") if isinstance(stop, dict) else None
    return float(target) if isinstance(target, int | float) else None


def asked_of_conditional(run: RunFolder) -> bool:
    """Whether it is the conditional statement of a shells run that should reach the relative half-width."""
    if run.method != "shells":
        return False
    settings = run.campaign["testing"].get("shells")
    return isinstance(settings, dict) and settings.get("statement") == "conditional"


def in_unit(estimates: dict[str, Any]) -> Callable[[float, int], str]:
    """Return what writes a rate in the table's power of ten with a given number of significant digits."""
    factor = 10.0 ** rate_exponent(estimates)
    return lambda rate, digits: significant(rate / factor, digits)


def _row(name: str, estimates: dict[str, Any], exponent: int) -> EstimateRow:
    e = estimates["estimates"][name]
    rate = e.get("crash_rate")
    known = isinstance(rate, int | float)
    return EstimateRow(
        name=name,
        is_headline=name == estimates["headline"],
        rate=_rate(rate, exponent),
        ends=_ends(e.get("ci_low"), e.get("ci_high"), exponent),
        upper_bound=_rate(e.get("upper_bound"), exponent),
        rhw=half_width(e.get("rhw")),
        per_1e6_km=_per_1e6_km(rate, estimates.get("distance_per_test_km")),
        n_episodes=count(e.get("n_episodes")),
        n_crashes=count(e.get("n_crashes")),
        n_effective=count(e.get("n_effective")),
        largest_weight_share=percent(e.get("largest_weight_share")),
        method=str(e.get("method") or MISSING),
        warnings=tuple(str(text) for text in e.get("warnings") or ()),
        reason=None if known else str(e.get("reason") or "no reason was recorded"),
    )


def _rate(rate: float | None, exponent: int) -> str:
    """In the table's power of ten, unless that would show no digit of it or too many."""
    if rate is None or not math.isfinite(rate):
        return number(rate)
    if rate == 0.0 or 1e-2 <= abs(rate / 10.0**exponent) < 1e4:
        return fixed(rate, exponent, rate)
    return _full(rate, exponent)


def _ends(low: float | None, high: float | None, exponent: int) -> str:
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        return MISSING
    if high == 0.0 or 1e-2 <= high / 10.0**exponent < 1e4:
        return f"{fixed(low, exponent, high)} to {fixed(high, exponent, high)}"
    return f"{_full(low, exponent)} to {_full(high, exponent)}"


def _full(rate: float, exponent: int) -> str:
    """Write a rate that does not fit the column's power of ten, marked as such by its own."""
    text = number(rate)
    return text if exponent == 0 or exponent_of(rate) != 0 else f"{text} × 10⁰"


def _per_1e6_km(rate: float | None, distance_km: float | None) -> str:
    if rate is None or not distance_km:
        return MISSING
    return number(rate * 1e6 / distance_km)
