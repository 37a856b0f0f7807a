"""Fit a driver to an AV: the intelligent driver model with a reaction delay, a braking limit and perhaps a jerk limit.

Least squares between the accelerations that the AV showed and those of the driver in the same situations. The delay is
a whole number of steps, so every delay is tried: roughly first, and the best few to the end. A jerk limit and a delay
look alike at first sight, so both are tried together; the jerk limit is kept only where it helps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from harness.campaign.vehicle import IDMParameters, Reflexes
from harness.pool.library import LibraryIDM
from harness.pool.observed import Observed
from harness.vehicles.models import driver_records
from harness.vehicles.reaction import expected_accelerations
from harness.vocabulary import FloatArray

MOST_DELAY_STEPS = 20
ROUGH_EVALUATIONS, LAST_EVALUATIONS = 6, 60
FINALISTS = 3
JERK_STARTS_MPS3 = ((3.0,), (8.0,), (20.0,))
_NO_JERK_LIMIT = ((),)
JERK_GAIN = 0.9
"""A jerk limit is kept if it brings the error down to this share, or below."""
USUAL_DIFFERENCE_MPS2 = 0.5
"""Larger differences count less than by their square: a vehicle that now and then does not look is fitted when it
does."""
NOISE_FLOOR_MPS2 = 0.005
"""Errors below this are as good as none."""

_BOUNDS = {
    "acceleration_mps2": (0.2, 10.0),
    "comfortable_deceleration_mps2": (0.3, 12.0),
    "time_headway_s": (0.0, 4.0),
    "minimum_gap_m": (0.0, 15.0),
    "desired_speed_mps": (15.0, 60.0),
    "min_acceleration_mps2": (-15.0, -0.1),
}
_JERK_BOUNDS_MPS3 = (0.5, 100.0)


@dataclass(frozen=True)
class FittedDriver:
    """A driver, and how well its accelerations are those in the cut-ins that it was fitted to.

    ``rms_mps2`` is the root mean square difference, ``explained`` the share of the variance of the observed
    accelerations that it explains: negative where their mean does better.
    """

    driver: LibraryIDM
    rms_mps2: float
    explained: float
    n_cut_ins: int


def expected(driver: LibraryIDM, observed: Observed) -> FloatArray:
    """Accelerations (m/s²) of a driver in the situations observed, shape (n,)."""
    out = np.empty(observed.acceleration.size)
    record = driver_records([driver.parameters], [driver.reaction])
    expected_accelerations(record, observed.begin, observed.speed, observed.lead_speed, observed.gap, out)
    return out


def agreement(driver: LibraryIDM, observed: Observed) -> tuple[float, float]:
    """Root mean square difference of accelerations (m/s²), and the share of variance explained."""
    difference = expected(driver, observed) - observed.acceleration
    mean_square = float(np.mean(difference * difference))
    variance = float(np.var(observed.acceleration))
    explained = 1.0 - mean_square / variance if variance > 0.0 else float(mean_square == 0.0)
    return math.sqrt(mean_square), explained


def fit_driver(observed: Observed, max_acceleration_mps2: float) -> FittedDriver:
    """The driver that is closest to what was observed; it may accelerate as hard as a library's envelope at most."""
    plain, smooth = (_best(observed, max_acceleration_mps2, starts) for starts in (_NO_JERK_LIMIT, JERK_STARTS_MPS3))
    plain_rms, smooth_rms = agreement(plain, observed)[0], agreement(smooth, observed)[0]
    driver = smooth if plain_rms > NOISE_FLOOR_MPS2 and smooth_rms < JERK_GAIN * plain_rms else plain
    return FittedDriver(driver, *agreement(driver, observed), observed.episode.size)


def _best(observed: Observed, most: float, jerk_starts: Sequence[Sequence[float]]) -> LibraryIDM:
    """The best driver with a jerk limit, or without one."""
    starts = [[*_start(observed), *jerk] for jerk in jerk_starts]
    rough = [
        _fit(observed, most, delay, start, ROUGH_EVALUATIONS)
        for delay, start in product(range(MOST_DELAY_STEPS + 1), starts)
    ]
    finalists = sorted(rough, key=attrgetter("rms_mps2"))[:FINALISTS]
    last = [_fit(observed, most, fit.delay, fit.numbers, LAST_EVALUATIONS) for fit in finalists]
    return min(last, key=attrgetter("rms_mps2")).driver


class _Fit(NamedTuple):
    rms_mps2: float
    delay: int
    numbers: list[float]
    driver: LibraryIDM


def _start(observed: Observed) -> list[float]:
    """SM-I's numbers, with the hardest braking that was seen now and then."""
    hardest = float(np.clip(np.quantile(observed.acceleration, 0.02), -14.0, -0.2))
    defaults = IDMParameters(min_acceleration_mps2=hardest)
    return [getattr(defaults, name) for name in _BOUNDS]


def _fit(observed: Observed, most: float, delay: int, start: list[float], evaluations: int) -> _Fit:
    """The driver after some evaluations from a start."""
    low, high = np.array([*_BOUNDS.values(), _JERK_BOUNDS_MPS3][: len(start)]).T

    def difference(numbers: FloatArray) -> FloatArray:
        return expected(_driver(numbers.tolist(), most, delay), observed) - observed.acceleration

    result = least_squares(
        difference,
        np.clip(start, low + 1e-6, high - 1e-6),
        bounds=(low, high),
        tr_solver="lsmr",  # an exact decomposition of thousands of rows takes a hundred times longer
        loss="soft_l1",
        f_scale=USUAL_DIFFERENCE_MPS2,
        x_scale=np.maximum(np.abs(start), 0.1),
        diff_step=np.full(low.size, 1e-4),
        max_nfev=evaluations,
    )
    numbers = [float(f"{number:.4g}") for number in result.x]
    driver = _driver(numbers, most, delay)
    return _Fit(agreement(driver, observed)[0], delay, numbers, driver)


def _driver(numbers: list[float], most: float, delay: int) -> LibraryIDM:
    parameters = dict(zip(_BOUNDS, numbers, strict=False), max_acceleration_mps2=most)
    jerk = numbers[len(_BOUNDS)] if len(numbers) > len(_BOUNDS) else None
    reaction = Reflexes(delay_s=delay / 10.0, max_jerk_mps3=jerk)
    return LibraryIDM(model="idm", parameters=IDMParameters(**parameters), reaction=reaction)
