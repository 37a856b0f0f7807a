"""The answer in one sentence."""

from __future__ import annotations

from harness.estimators.estimate import Estimate

_PER_KM = 1e6
SCOPE = "The interval is about sampling error in this environment, not about how well the environment matches the road."


def per_distance(estimate: Estimate, distance_per_test_km: float) -> dict[str, float]:
    """Crash rate and interval per 1e6 km of such overtaking driving."""
    scale = _PER_KM / distance_per_test_km
    return {
        "rate": estimate.crash_rate * scale,
        "ci_low": estimate.ci_low * scale,
        "ci_high": estimate.ci_high * scale,
    }


def statement(estimate: Estimate, lane_change_level: float, distance_per_test_km: float | None) -> str:
    """Rate, interval, number of tests and level, in words."""
    tests = (
        f"{estimate.n_episodes:,} overtaking tests at lane-change level {lane_change_level:g} "
        f"({estimate.n_crashes:,} sampled crashes)"
    )
    level = f"{estimate.confidence:.0%}"
    if estimate.n_crashes == 0:
        upper = estimate.upper_bound
        bound = f"No crash was sampled in {tests}: with {level} confidence the rate is below {upper:.3g} per test"
        if distance_per_test_km:
            bound += f", or {upper * _PER_KM / distance_per_test_km:.3g} per 1e6 km of such driving"
        return f"{bound}."
    text = (
        f"The crash rate is {estimate.crash_rate:.3g} per test ({level} interval {estimate.ci_low:.3g} to "
        f"{estimate.ci_high:.3g}, relative half-width {estimate.rhw:.1%}), estimated from {tests}"
    )
    if distance_per_test_km:
        scaled = per_distance(estimate, distance_per_test_km)
        text += (
            f"; that is {scaled['rate']:.3g} crashes per 1e6 km of such overtaking driving "
            f"({scaled['ci_low']:.3g} to {scaled['ci_high']:.3g})"
        )
    return f"{text}."
