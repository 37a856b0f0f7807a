"""Cut-outs in trajectories: how often the vehicle ahead leaves the lane and reveals a slower one, and how late.

A cut-out is a lasting change of the lane, to either side, by a vehicle that somebody follows, where the next one ahead
on the lane that it leaves is slower, and as near as the law has it: at most 12 s of time to collision away. States are
those of the last row on that lane. Following counts where 100 m of the road ahead of the leader are in view.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize, special

from harness.campaign.sections import EnvironmentSettings
from harness.families.cut_out.family import CUT_OUT, TTC_EDGES_S
from harness.families.following.fitting import (
    FEWEST_OF_LAW,
    FollowingFitter,
    Numbers,
    Seen,
    fitted_number,
    followed,
    most_of_one,
)
from harness.fitting.recording import Recording
from harness.fitting.tracks import IN_VIEW_M, slope_weights
from harness.vocabulary import FloatArray, IntArray, RecordArray

SHIPPED = CUT_OUT.parameters(EnvironmentSettings()).values()
STANDS_MPS = 0.5
LEAST_DROP = 0.002
"""Least mean that is fitted, below which the exponentials overflow."""
PRIOR_LOG_SD = 0.5
"""How wide the prior of a time's median and log-sd is [assumed]."""
BOUNDS = [(math.log(low), math.log(high)) for low, high in ((0.1, 60.0), (0.01, 3.0))]
"""Logarithms of the limits of both in files."""
LEAST_LATERAL_MPS = 0.1
"""Slower ones are wrong lateral positions, or a drift."""
EVENT = np.dtype([("drop", np.float64), ("ttc_s", np.float64), ("lateral_mps", np.float64)])


class CutOutFitter(FollowingFitter):
    """See `FollowingFitter`."""

    family, events = CUT_OUT, f"cut-outs that reveal a slower vehicle within {TTC_EDGES_S[-1]:g} s"

    def seen(self, track: Recording) -> Seen:
        following = followed(track)
        ends = track.view[1, track.road]
        leader = following.ahead[following.follows]
        hours = float((track.s[leader] + IN_VIEW_M <= ends[leader]).sum()) / track.rate_hz / 3600.0
        leaves = track.crosses(-1) | track.crosses(1)
        row = np.flatnonzero(leaves & (following.behind >= 0) & (following.ahead >= 0) & (track.s + IN_VIEW_M <= ends))
        closing, gap = -track.rate(following.ahead[row], row), track.gap(following.ahead[row], row)
        events: RecordArray = np.empty(row.size, EVENT)
        events["drop"], events["ttc_s"] = closing / track.v[row], gap / np.maximum(closing, 1e-9)
        events["lateral_mps"] = np.abs(lateral_speeds(track, row))
        counts = (closing > 0.0) & (gap > 0.0) & (events["ttc_s"] <= TTC_EDGES_S[-1])
        return Seen(hours, events[counts], of_one=most_of_one(track.vehicle[row[counts]]))

    def share_counted(self, numbers: Numbers) -> float:
        fitted = {f"leaving__{name}": each["value"] for name, each in numbers.get("leaving", {}).items()}
        values = SHIPPED | fitted
        return share_within(*(values[f"leaving__{name}"] for name in ("ttc_median_s", "ttc_log_sd", "careless_share")))

    def numbers(self, events: RecordArray) -> Numbers:
        drops = events["drop"][events["drop"] < 1.0 - STANDS_MPS / 30.0]
        careless = [SHIPPED[f"leaving__careless_{name}"] for name in ("share", "least_s", "most_s")]
        (median, log_sd), errors = time_law(events["ttc_s"], *careless)
        law = {"drop_mean": fitted_number(*drop_law(drops))}
        law |= {"ttc_median_s": fitted_number(median, errors[0]), "ttc_log_sd": fitted_number(log_sd, errors[1])}
        logs = np.log(events["lateral_mps"][events["lateral_mps"] >= LEAST_LATERAL_MPS])
        if logs.size >= FEWEST_OF_LAW:
            lateral_median, sd = math.exp(logs.mean()), float(logs.std(ddof=1))
            law["lateral_median_mps"] = fitted_number(lateral_median, lateral_median * sd / math.sqrt(logs.size))
            law["lateral_log_sd"] = fitted_number(sd, sd / math.sqrt(2.0 * logs.size))
        return {"leaving": law}


def lateral_speeds(track: Recording, rows: IntArray) -> FloatArray:
    """Lateral speed (m/s) around the ends of some rows (m,), NaN where it is not known."""
    weights = slope_weights(track)
    around = rows[:, None] + np.arange(weights.size) - weights.size // 2
    inside = np.clip(around, 0, track.v.size - 1)
    known = (around == inside).all(axis=1) & (track.piece[inside[:, 0]] == track.piece[inside[:, -1]])
    return np.where(known, track.lateral[inside] @ weights, np.nan)


def drop_law(drops: FloatArray) -> tuple[float, float]:
    """Mean of the exponential law whose part below 1 has the mean of some drops (k,), and its standard error."""

    def below_one(mean: float) -> float:
        return mean - 1.0 / math.expm1(1.0 / mean)

    seen = min(max(float(drops.mean()), below_one(LEAST_DROP)), below_one(1.0))
    mean = optimize.brentq(lambda mean: below_one(mean) - seen, LEAST_DROP, 1.0)
    slope = 1.0 - math.exp(1.0 / mean) / (mean * math.expm1(1.0 / mean)) ** 2
    return mean, mean / math.sqrt(drops.size * slope)  # the drops' variance is mean² slope


def share_within(median_s: float, log_sd: float, careless: float) -> float:
    """Share of all times to collision that is counted: up to the law's last edge."""
    upto = float(special.ndtr((math.log(TTC_EDGES_S[-1]) - math.log(median_s)) / log_sd))
    return (1.0 - careless) * upto + careless


def time_law(ttc_s: FloatArray, share: float, least_s: float, most_s: float) -> tuple[FloatArray, FloatArray]:
    """Median and log-sd of times to collision (k,) up to the law's last edge, and their standard errors.

    Log-normal, but for a ``share`` of careless drivers between two times, who are too few to be fitted. If times are
    spread evenly up to the last edge, nothing but a prior about the shipped law says how long those beyond are.
    """
    log_t, shipped = np.log(ttc_s), np.log([SHIPPED["leaving__ttc_median_s"], SHIPPED["leaving__ttc_log_sd"]])
    careless = share / (most_s - least_s) * ((ttc_s >= least_s) & (ttc_s <= most_s))

    def loss(theta: FloatArray) -> float:
        log_sd = math.exp(theta[1])
        z = (log_t - theta[0]) / log_sd
        density = np.exp(-0.5 * z * z - log_t) / (log_sd * math.sqrt(2.0 * math.pi))
        likelihood = ((1.0 - share) * density + careless) / share_within(math.exp(theta[0]), log_sd, share)
        away = (theta - shipped) / PRIOR_LOG_SD
        return -float(np.log(likelihood + 1e-300).sum()) + 0.5 * float(away @ away)

    start = [log_t.mean(), math.log(log_t.std() + 1e-2)]
    best = optimize.minimize(loss, start, method="Nelder-Mead", bounds=BOUNDS).x
    steps = 1e-3 * np.eye(2)

    def second_difference(i: FloatArray, j: FloatArray) -> float:
        return sum(a * b * loss(best + a * i + b * j) for a in (-1, 1) for b in (-1, 1))

    hessian = np.array([[second_difference(i, j) for j in steps] for i in steps]) / 4e-6
    errors = np.sqrt(np.diag(np.linalg.inv(hessian)))
    values = np.exp(best)
    return values, values * errors
