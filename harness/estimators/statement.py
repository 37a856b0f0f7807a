"""The answer in one sentence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from harness.estimators.estimate import WIDEST_RHW, Estimate

_PER_KM = 1e6
REPLAY = "harness replay FOLDER"
"""Command that replays a test, without its number; FOLDER stands for the run's."""
SCOPE = "The interval is about sampling error in this environment, not about how well the environment matches the road."


def warned(cautions: Iterable[str], text: str) -> str:
    """The text, with what may be wrong about it first."""
    return " ".join([*(f"WARNING: {caution.rstrip('.')}." for caution in cautions), text])


def per_distance(estimate: Estimate, distance_per_test_km: float) -> dict[str, float]:
    """Crash rate and interval per 1e6 km of such overtaking driving."""
    scale = _PER_KM / distance_per_test_km
    return {
        "rate": estimate.crash_rate * scale,
        "ci_low": estimate.ci_low * scale,
        "ci_high": estimate.ci_high * scale,
    }


def statement(estimate: Estimate, lane_change_level: float, distance_per_test_km: float | None) -> str:
    """Why the interval may be wrong, if it may; then rate, interval, number of tests and level, in words."""
    tests = (
        f"{estimate.n_episodes:,} overtaking tests at lane-change level {lane_change_level:g} "
        f"({estimate.n_crashes:,} sampled crashes)"
    )
    level, per_km = f"{estimate.confidence:.0%}", ""
    if estimate.n_crashes == 0:
        upper = estimate.upper_bound
        if distance_per_test_km:
            per_km = f", or {upper * _PER_KM / distance_per_test_km:.3g} per 1e6 km of such driving"
        text = f"No crash was sampled in {tests}: with {level} confidence the rate is below {upper:.3g} per test"
    else:
        if distance_per_test_km:
            scaled = per_distance(estimate, distance_per_test_km)
            per_km = (
                f"; that is {scaled['rate']:.3g} crashes per 1e6 km of such overtaking driving "
                f"({scaled['ci_low']:.3g} to {scaled['ci_high']:.3g})"
            )
        text = (
            f"The crash rate is {estimate.crash_rate:.3g} per test ({level} interval {estimate.ci_low:.3g} to "
            f"{estimate.ci_high:.3g}{_width(estimate)}), estimated from {tests}"
        )
    return warned(estimate.cautions, f"{text}{per_km}.")


def _width(estimate: Estimate) -> str:
    if estimate.cautions:
        return ""
    if estimate.rhw > WIDEST_RHW:
        return ", still open upwards: far wider than the rate"
    return f", relative half-width {estimate.rhw:.1%}"


def failed_statement(found: Mapping[str, Any]) -> str:
    """What failed tests (``details``) would change, as a sentence to follow the answer; empty without any."""
    if not found["n_failed"]:
        return ""
    return (
        f" Of these tests {found['n_failed']:,} FAILED: they count as no crash in the rate and as crashes in the upper "
        f"limit. Had they all crashed, the rate would be {found['crash_rate_if_failed_had_crashed']:.3g}."
    )


def reference_statements(estimate: Estimate) -> list[str]:
    """How the vehicle compares with each reference driver, a sentence each; none unless drawn from shells."""
    references, level = estimate.details.get("references", ()), f"{estimate.confidence:.0%}"
    return [_beside(found, level) for found in references if found["crash_rate"] > 0.0]


def _beside(found: Mapping[str, Any], level: str) -> str:
    who = f"{found['described']} ({found['reference']})"
    if found["ratio"] == 0.0:
        return (
            f"In the same traffic this vehicle crashes less than {found['ratio_high']:.3g} times as often as {who} "
            f"would (upper end of the {level} interval): no crash was sampled."
        )
    low, high = found["preventable_low"], found["preventable_high"]
    return (
        f"This vehicle crashes {found['ratio']:.2f} times as often as {who} would in the same traffic ({level} "
        f"interval {found['ratio_low']:.2f} to {found['ratio_high']:.2f}); {_percent(found['preventable'])} of its "
        f"crashes such a driver would have avoided ({_percent(low)} to {_percent(high)})."
    )


def _percent(share: float) -> str:
    """A share to two figures at least: whether it is 0.1 or 0 % may matter."""
    return f"{100.0 * share:.2g} %" if share < 0.1 else f"{100.0 * share:.0f} %"


def boundary_statements(estimate: Estimate) -> dict[str, str]:
    """What holds for vehicles that crash only within a boundary, by statement; none unless drawn from shells."""
    details, level = estimate.details, f"{estimate.confidence:.0%}"
    return {found["name"]: _within(found, len(details["shells"]), level) for found in details.get("statements", ())}


def _within(found: Mapping[str, Any], n_shells: int, level: str) -> str:
    if found["refuted"]:
        return (
            f"REFUTED: it is not so that this vehicle {found['assumes']}. It crashed in "
            f"{found['n_crashes_outside']:,} of {found['n_episodes_outside']:,} tests beyond {found['boundary']}, "
            f"first in {_replayed(found['refuted_by'])}."
        )
    if math.isinf(found["rhw_from_pool"]):
        return "Under an assumption about where it crashes nothing more can be said: its crashes lie on too few paths."
    text = (
        f"If this vehicle {found['assumes']}, its crash rate is {found['crash_rate']:.3g} per test ({level} interval "
        f"{found['ci_low']:.3g} to {found['ci_high']:.3g}), estimated from {found['n_episodes']:,} tests "
        f"({found['n_crashes']:,} sampled crashes).{failed_statement(found)}"
    )
    return f"{text} {_outside(found, n_shells, level)}{_ahead(found)}"


def _outside(found: Mapping[str, Any], n_shells: int, level: str) -> str:
    if found["n_shells"] == n_shells:
        return "Nothing lies outside."
    if not found["n_episodes_outside"]:
        return "Nothing was tested outside: whether the assumption holds is not known."
    failed = found["n_failed_outside"]
    counted = f", but {failed:,} of them FAILED and are counted as crashes here" if failed else ""
    return (
        f"There was no crash in {found['n_episodes_outside']:,} tests outside{counted}: with {level} confidence "
        f"fewer than {found['upper_bound_outside']:.3g} crashes per test lie there."
    )


def _ahead(found: Mapping[str, Any]) -> str:
    """What each test says about the assumption, where it was asked."""
    if not found["n_checked"]:
        return ""
    if not found["n_ahead"]:
        return f" In none of {found['n_checked']:,} tests was it ahead of such a vehicle: each keeps to the assumption."
    return (
        f" In {found['n_ahead']:,} of {found['n_checked']:,} tests it was AHEAD of such a vehicle, first in "
        f"{_replayed(found['ahead_in'])}: it does not do what is assumed, and nothing but the lack of crashes outside "
        "speaks for the statement."
    )


def _replayed(episodes: Sequence[int]) -> str:
    """The first of some tests, and how to see it."""
    return f"episode {episodes[0]} (`{REPLAY} {episodes[0]}`)"


def repeated_statement(repeated: Mapping[str, Any] | None) -> str:
    """That repeated tests came out alike, as a sentence to follow the answer; empty where none did."""
    if repeated is None or not repeated["n_episodes"] or repeated["differing"]:
        return ""
    return f" {repeated['n_episodes']:,} of these tests were run a second time: same bits."


def repeated_cautions(repeated: Mapping[str, Any] | None) -> list[str]:
    """That repeated tests came out otherwise, which is to be said first; empty where none did."""
    if repeated is None or not repeated["differing"]:
        return []
    n, n_differing = repeated["n_episodes"], len(repeated["differing"])
    return [
        f"{n_differing:,} of {n:,} tests that were run a second time DIFFERED: this vehicle is not reproducible; its "
        "tests cannot be replayed, and depend on what ran beside and before them"
    ]
