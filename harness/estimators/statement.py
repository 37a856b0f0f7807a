"""The answer in one sentence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from harness.estimators.estimate import WIDEST_RHW, Estimate

_PER_KM = 1e6
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


def conditional_statement(estimate: Estimate) -> str | None:
    """What holds if the vehicle crashes only where the boundary surrogate does; None unless drawn from shells."""
    found = estimate.details.get("conditional")
    if found is None:
        return None
    boundary, level = estimate.details["boundary"], f"{estimate.confidence:.0%}"
    if found["refuted"]:
        return (
            f"This vehicle crashed {found['n_crashes_outside']:,} times where the surrogate {boundary} does not crash: "
            f"nothing can be said under the assumption that it crashes only where {boundary} does."
        )
    if math.isinf(found["rhw_from_pool"]):
        return "Under an assumption about where it crashes nothing more can be said: its crashes lie on too few paths."
    text = (
        f"If this vehicle crashes only where the surrogate {boundary} or a more careful one crashes, its crash rate is "
        f"{found['crash_rate']:.3g} per test ({level} interval {found['ci_low']:.3g} to {found['ci_high']:.3g}), "
        f"estimated from {found['n_episodes']:,} tests ({found['n_crashes']:,} sampled crashes)."
        f"{failed_statement(found)}"
    )
    if all(shell["inside"] for shell in estimate.details["shells"]):
        return f"{text} Nothing lies outside."
    if not found["n_episodes_outside"]:
        return f"{text} Nothing was tested outside: whether the assumption holds is not known."
    failed = found["n_failed_outside"]
    counted = f", but {failed:,} of them FAILED and are counted as crashes here" if failed else ""
    return (
        f"{text} There was no crash in {found['n_episodes_outside']:,} tests outside{counted}: with {level} confidence "
        f"fewer than {found['upper_bound_outside']:.3g} crashes per test lie there."
    )


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


def alarm_cautions(alarm: Mapping[str, Any]) -> list[str]:
    """What a raised alarm (``diagnostics.alarm``) says about every estimate of the run; empty without one."""
    if not alarm["raised"]:
        return []
    rates = alarm["surrogate_crash_rates"]
    return [
        "ALARM, replayed surrogates do not crash as often as the pool says (p-value "
        f"{min(rates['p_value_holm'], rates['p_value_jointly']):.1e}): weights, maneuvers, twin or pool are wrong; see "
        "diagnostics.alarm"
    ]
