"""How the headline estimate settled: its value on growing prefixes of the campaign, for plots."""

from __future__ import annotations

from typing import Any

from harness.estimators.estimate import Estimate, finite_json

SPACING = 1.01
"""Prefixes closer than 1 % are one dot on a logarithmic axis; thinning them keeps long campaigns' files small."""


class Convergence:
    """Points (n, rate, interval, rhw, crashes) of one estimator at block boundaries at least 1 % apart."""

    def __init__(self) -> None:
        self._points: list[dict[str, Any]] = []

    def due(self, n: int) -> bool:
        """Whether the prefix of n episodes deserves a point."""
        return not self._points or n >= self._points[-1]["n"] * SPACING

    def add(self, estimate: Estimate) -> None:
        """Add the estimate of a prefix; a prefix that is already there is left alone."""
        if self._points and self._points[-1]["n"] == estimate.n_episodes:
            return
        self._points.append(
            {
                "n": estimate.n_episodes,
                "crash_rate": estimate.crash_rate,
                "ci_low": estimate.ci_low,
                "ci_high": estimate.ci_high,
                "rhw": estimate.precision,
                "n_crashes": estimate.n_crashes,
            }
        )

    def points(self) -> list[dict[str, Any]]:
        """All points in order, ready for JSON."""
        return [finite_json(point) for point in self._points]
