"""The hazard of lane changes, and the share of them that is carried out in front of a vehicle that closes in.

The hazard is the exponential of a sum of piecewise linear functions of v, R1 and R1dot. Its log-likelihood, Σ log h
over lane changes - Σ h Δt over all seconds at risk, is that of moments in which nobody closes in within `FREE_TTC_S`.
Below that, the accepted share follows from k lane changes where E = Σ h Δt are expected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from harness.families.cut_in.fitting.laws import FittedLaw, ObservedTraffic
from harness.families.cut_in.fitting.maximum import Prior, maximise
from harness.families.cut_in.sections import HAZARD_OF, SMALLEST_SHARE
from harness.vocabulary import FloatArray, IntArray, RecordArray

FREE_TTC_S = 8.0
TTC_EDGES_S = np.array([1.0, 2.0, 3.0, 5.0, FREE_TTC_S])
KNOTS = np.array([0.02, 0.2, 0.5, 0.8, 0.98])
"""Quantiles (means of those at lane changes and at risk) between which the log-hazard is straight."""
SMOOTH = 1.0, 3.0
"""Prior standard deviations of the log-hazard's bends (change over a quarter of the range) and steps [assumed]."""


@dataclass(frozen=True, eq=False)
class Hazard:
    """Hazard of a lane change where nobody closes in within `FREE_TTC_S`, by ``knots`` of each of `HAZARD_OF`.

    Coefficients are an intercept and effects at all knots but the middle one of each.
    """

    law: FittedLaw
    knots: list[FloatArray]

    def rate(self, rows: RecordArray) -> FloatArray:
        """Rate (1/s) in some states (n,)."""
        return np.exp(_design(self.knots, rows) @ self.law.maximum.theta)


def fit_hazard(traffic: ObservedTraffic) -> Hazard | None:
    """Fit the hazard; None if there is no lane change, or no maximum is found."""
    rows = traffic.at_risk[traffic.at_risk["ttc_s"] > FREE_TTC_S]
    n_changes = int(rows["changes"].sum())
    if not n_changes:
        return None
    knots = [_knots(rows, name) for name in HAZARD_OF]

    def log_likelihood(rows: RecordArray, eta: FloatArray) -> FloatArray:
        # Decided once a second (`cut_in.laws`); beyond a chance of 1/2 straight on, as a bend has no maximum.
        rate = -np.log1p(-np.minimum(np.exp(eta), 0.5)) + np.maximum(eta + math.log(2.0), 0.0)
        return np.asarray(np.where(rows["changes"], np.log(rate), 0.0) - rate * rows["duration_s"])

    effects = linalg.block_diag(*(_but_middle(np.eye(each.size)) for each in knots))

    def values(theta: FloatArray) -> FloatArray:
        out = theta[..., 1:] @ effects.T
        out[..., : knots[0].size] += theta[..., :1]  # of v, with the intercept
        return np.asarray(out)

    weights = linalg.block_diag(np.array([[0.01]]), *(_penalty(each) for each in knots))
    centre = np.zeros(weights.shape[1])
    centre[0] = math.log(n_changes / rows["duration_s"].sum())
    prior = Prior(centre, weights, smooths=True)
    maximum = maximise(log_likelihood, rows, [_design(knots, rows)], *traffic.members(rows), prior)
    axes = zip(HAZARD_OF.values(), knots, strict=True)
    names = tuple(f"hazard_table__{name}__{i}" for name, each in axes for i in range(each.size))
    return None if maximum is None else Hazard(FittedLaw(names, values, maximum), knots)


def _but_middle(by_knot: FloatArray) -> FloatArray:
    """Columns (n, knots) without that of the middle knot, which effects are relative to."""
    return np.delete(by_knot, by_knot.shape[1] // 2, axis=1)


def _design(knots: list[FloatArray], rows: RecordArray) -> FloatArray:
    """Design matrix (n, p) of the log-hazard in some states (n,)."""
    hats = [
        np.column_stack([np.interp(rows[name], axis_knots, hat) for hat in np.eye(axis_knots.size)])
        for name, axis_knots in zip(HAZARD_OF, knots, strict=True)
    ]
    return np.column_stack([np.ones(rows.size), *map(_but_middle, hats)])


def _knots(rows: RecordArray, name: str) -> FloatArray:
    """Rounded quantiles (means of those at crossings and at risk), at least a twentieth of their range apart."""
    quantiles = 0.5 * (np.quantile(rows[name], KNOTS) + np.quantile(rows[name][rows["changes"]], KNOTS))
    knots = [round(float(quantiles[0]), 1)]
    for knot in np.round(quantiles[1:], 1).tolist():
        if knot - knots[-1] > 0.05 * (quantiles[-1] - quantiles[0]):
            knots.append(knot)
    return np.array(knots)


def _penalty(knots: FloatArray) -> FloatArray:
    """Pseudo-observations, about 0, of bends and steps of an effect; the middle knot is left out."""
    if knots.size == 1:
        return np.empty((0, 0))
    identity = np.eye(knots.size)
    slopes = np.diff(identity, axis=0) / np.diff(knots)[:, None]
    bends = np.diff(slopes, axis=0) * (knots[-1] - knots[0]) / 4.0
    return _but_middle(np.vstack([bends / SMOOTH[0], np.diff(identity, axis=0) / SMOOTH[1]]))


@dataclass(frozen=True, eq=False)
class Acceptance:
    """Lane changes by time to collision with the vehicle behind, in bins with the edges `TTC_EDGES_S`.

    ``events`` (6,) are those seen, ``exposure`` (6,) those expected with nobody closing in: Σ h Δt. ``design``
    holds rows of the hazard (n, p) in all bins but the last, with ``bin`` and ``duration_s`` (n,).
    """

    events: IntArray
    exposure: FloatArray
    design: FloatArray
    bin: IntArray
    duration_s: FloatArray

    @classmethod
    def of(cls, traffic: ObservedTraffic, hazard: Hazard) -> Acceptance:
        """Count lane changes and what is expected."""
        rows = traffic.at_risk
        step = np.searchsorted(TTC_EDGES_S, rows["ttc_s"], side="right")
        n = TTC_EDGES_S.size + 1
        events = np.bincount(step[rows["changes"]], minlength=n).astype(np.int64)
        wished = hazard.rate(rows) * rows["duration_s"]
        near = step < n - 1
        exposure = np.bincount(step, wished, minlength=n).astype(np.float64)
        design = _design(hazard.knots, rows[near])
        return cls(events, exposure, design, step[near].astype(np.int64), rows["duration_s"][near])

    @property
    def shares(self) -> FloatArray:
        """Estimates (6,), at most 1. Without an event half of one is counted, up to the shares of longer times."""
        events, exposure = self.events[:-1], np.maximum(self.exposure[:-1], 1e-12)
        shares = np.append(np.minimum(np.maximum(events, 0.5) / exposure, 1.0), 1.0)
        for step in np.flatnonzero(events == 0)[::-1]:
            shares[step] = shares[step:].min()
        return shares

    def drawn(self, theta: FloatArray, random: np.random.Generator) -> FloatArray:
        """Shares (b, 5) drawn by the uncertainty of counts, for hazards with coefficients (b, p).

        Drivers accept a shorter time no more often than a longer one, but draws are not ordered like that. Where shares
        are equal, as for drivers who do not look, ordered draws would be too small at the shortest times.
        """
        hazard = np.exp(self.design @ theta.T) * self.duration_s[:, None]
        expected = np.stack([hazard[self.bin == j].sum(axis=0) for j in range(TTC_EDGES_S.size)], axis=1)
        counts = random.gamma(self.events[:-1] + 0.5, size=expected.shape)
        return np.asarray(np.clip(counts / np.maximum(expected, 1e-12), SMALLEST_SHARE, 1.0), np.float64)

    @property
    def std_errors(self) -> FloatArray:
        """Standard errors of the shares (6,), by counts; 0 of the last."""
        near = np.sqrt(self.events[:-1] + 0.5) / np.maximum(self.exposure[:-1], 1e-12)
        return np.append(np.minimum(near, 1.0), 0.0)
