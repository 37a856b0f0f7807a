"""What the numbers of an environment imply, evaluated once on a grid over the fit range before anything rests on it.

Each number may be in order and still a law give no probability: an exponent that overflows, a range that holds nothing
of a distribution, a share that rounds to zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product

import numpy as np

from harness.arrays import BoolArray, FloatArray
from harness.compiled import compiled_threads
from harness.environment.cut_in import acceptance, opportunity
from harness.environment.driving import (
    Environment,
    car_following_inverse_scale,
    car_following_pmf,
    free_driving_pmf,
    free_driving_shape,
)
from harness.environment.initial_state import InitialStates
from harness.errors import CampaignError
from harness.maneuvers import N_ACCELERATIONS
from harness.state import State

PROBABILITIES = np.array([2.0**-53, 1e-6, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0 - 1e-6, 1.0 - 2.0**-53])
"""Where quantiles are evaluated: the ends are the smallest and the largest uniform that is drawn, but zero."""
RARE = PROBABILITIES.size - 2
FASTEST_LV_MPS = 100.0
"""Speed limit of SUMO's lanes; LV may exceed it in one of a million tests."""
SCALES_MPS2 = (1e-3, 50.0)
"""Noise far below the 0.2 m/s² bins is none; above 50 m/s² nearly all of it lies beyond the grid of accelerations."""
SMALLEST_CHANCE = 1e-200
"""Products of chances over a path must not round to zero: the forced cut-in divides by them."""
RATES_MPS = np.linspace(-40.0, 40.0, 9)
AV_GAPS_M = (0.1, 1.0, 10.0, 50.0, 300.0)


def require_sound_laws(environment: Environment, file: str) -> None:
    """Refuse an environment whose laws give something else than probabilities and finite states.

    Parameters
    ----------
    environment : Environment
    file : str
        The parameter file, for messages.

    Raises
    ------
    CampaignError
        Names the law, and the state in which it fails.
    """
    n = environment.numbers
    speeds = np.linspace(n["fit_range__v_min_mps"], n["fit_range__v_max_mps"], 9)
    gaps = np.linspace(n["fit_range__r1_min_m"], n["fit_range__r1_max_m"], 9)
    _require_initial_states(environment, speeds, file)
    states = np.array(list(product(speeds, gaps, RATES_MPS)))
    approaches = np.array(list(product(AV_GAPS_M, RATES_MPS)))
    free, following = np.empty((len(states), N_ACCELERATIONS)), np.empty((len(states), N_ACCELERATIONS))
    scales, chance, accepted = np.empty((len(states), 2)), np.empty(len(states)), np.empty(len(approaches))
    _evaluate(states, approaches, environment, free, following, scales, chance, accepted)

    def require(sound: BoolArray, section: str, found: Callable[[int], str], expected: str) -> None:
        _require(sound, f"{section} ({file})", lambda i: f"{found(i)} at {_state(states[i])}", expected)

    for section, pmf, scale in (("free_driving", free, scales[:, 0]), ("car_following", following, scales[:, 1])):
        inside: BoolArray = (scale >= SCALES_MPS2[0]) & (scale <= SCALES_MPS2[1])
        limits = "a scale from {:g} to {:g} m/s²".format(*SCALES_MPS2)
        require(inside, section, lambda i, s=scale: f"noise of scale {s[i]:.3g} m/s²", limits)  # type: ignore[misc]
        whole: BoolArray = (pmf >= 0.0).all(axis=1) & (np.abs(pmf.sum(axis=1) - 1.0) < 1e-9)
        require(whole, section, lambda i, p=pmf: f"probabilities that sum to {p[i].sum():.12g}", "a sum of 1")  # type: ignore[misc]
    _require(
        (accepted > 0.0) & (accepted <= 1.0),
        f"cut_in.accept_scale_s and cut_in.ignore_share ({file})",
        lambda i: (
            f"a share of {accepted[i]:.3g} accepted at R2 = {approaches[i, 0]:g} m, R2dot = {approaches[i, 1]:g} m/s"
        ),
        "a share above 0 and at most 1",
    )
    possible = np.isfinite(chance) & (chance * accepted.min() > SMALLEST_CHANCE)
    require(possible, "cut_in", lambda i: f"a wish to change lanes of {chance[i]:.3g}", "a finite number above 0")


def _require_initial_states(environment: Environment, speeds: FloatArray, file: str) -> None:
    n = environment.numbers
    with np.errstate(all="ignore"):
        initial = InitialStates(environment.numbers)
        steps = np.diff(initial.speed_distribution)
        _require(
            steps >= -1e-9,  # rounding shows where next to nothing of the distribution is left
            f"initial_state.v_location_mps, v_scale_mps and v_shape ({file})",
            lambda _: "no speed within the fit range",
            "a distribution of v_BV that reaches into it",
        )
        for speed in speeds:
            states = initial.given_speed(speed, *(u.ravel() for u in np.meshgrid(PROBABILITIES, PROBABILITIES)))
            r1 = states["r1_m"][: PROBABILITIES.size]
            rate = states["r1dot_mps"].reshape(PROBABILITIES.size, -1)
            inside = (r1 >= n["fit_range__r1_min_m"] - 1e-6) & (r1 <= n["fit_range__r1_max_m"] + 1e-6)
            rises = np.append(r1[2:] > r1[:-2], [True, True])  # pairs, because the outermost two may agree
            _require(
                inside & rises,
                f"initial_state.r1_* ({file})",
                lambda i, r1=r1, v=speed: f"R1 = {r1[i]:.3g} m in the {PROBABILITIES[i]:.6g} quantile at v = {v:g} m/s",  # type: ignore[misc]
                f"gaps spread within the fit range, {n['fit_range__r1_min_m']:g} to {n['fit_range__r1_max_m']:g} m",
            )
            fast = np.where(np.isfinite(rate).all(axis=0), speed + rate[RARE], np.inf)
            _require(
                fast <= FASTEST_LV_MPS,
                f"initial_state.r1dot_* ({file})",
                lambda i, f=fast, v=speed, r1=r1: (
                    f"LV at {f[i]:.3g} m/s in one of a million tests, at v = {v:g} m/s, R1 = {r1[i]:.3g} m"
                ),  # type: ignore[misc]
                f"rates that are finite, and an LV of at most {FASTEST_LV_MPS:g} m/s in all but one of a million",
            )


def _require(sound: BoolArray, where: str, found: Callable[[int], str], expected: str) -> None:
    if not sound.all():
        raise CampaignError(
            where,
            found=found(int(np.argmin(sound))),
            expected=expected,
            mend="The numbers are allowed one by one, but not together: correct those of this law.",
        )


def _state(state: FloatArray) -> str:
    return "v = {:.3g} m/s, R1 = {:.3g} m, R1dot = {:.3g} m/s".format(*state)


@compiled_threads
def _evaluate(
    states: FloatArray,
    approaches: FloatArray,
    environment: Environment,
    free: FloatArray,
    following: FloatArray,
    scales: FloatArray,
    chance: FloatArray,
    accepted: FloatArray,
) -> None:
    """All laws in states (n, 3) of v_BV, R1, R1dot and approaches (m, 2) of R2, R2dot, as kernels evaluate them."""
    for j in range(approaches.shape[0]):
        accepted[j] = acceptance(approaches[j, 0], approaches[j, 1], environment)
    for i in range(states.shape[0]):
        speed, r1, r1dot = states[i]
        state = State(speed, r1, r1dot, math.nan, math.nan)
        free_driving_pmf(speed, environment, free[i])
        car_following_pmf(state, environment, following[i])
        scales[i, 0] = 1.0 / free_driving_shape(speed, environment)[1]
        scales[i, 1] = 1.0 / car_following_inverse_scale(r1dot, environment)
        chance[i] = opportunity(state, environment)
