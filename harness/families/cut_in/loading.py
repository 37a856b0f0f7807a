"""Load an environment: a shipped parameter file or the user's own, validated, as kernels read it.

Even if each number is allowed, a law may give no probabilities: an exponent overflows, a range holds nothing of a
distribution, a share rounds to zero. So laws are evaluated once, on a grid over the fit range, before they are used.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from harness.campaign.models import read_model, shipped_or_own
from harness.campaign.sections import EnvironmentSettings
from harness.compiled import compiled_threads, unboxed
from harness.families.cut_in import laws
from harness.families.cut_in.lateral import constant_lead
from harness.families.cut_in.laws import Environment, InitialStates, Wish, build_environment
from harness.families.cut_in.parameters import DEFAULT, SHIPPED_FOLDER, EnvironmentParameters, parameter_record
from harness.families.cut_in.vocabulary import N_ACCELERATIONS, State
from harness.families.flow import PROBABILITIES, require
from harness.vocabulary import FloatArray

RARE = PROBABILITIES.size - 2
FASTEST_LV_MPS = 100.0
"""Speed limit of SUMO's lanes; LV may exceed it in one of a million tests."""
SCALES_MPS2 = (1e-3, 50.0)
"""Limits of the scale of noise: far below the 0.2 m/s² bins it is none; above 50 m/s² nearly all is beyond the grid."""
SMALLEST_CHANCE = 1e-200
"""Products of chances over a path must not round to zero: the forced cut-in divides by them."""
RATES_MPS = np.linspace(-40.0, 40.0, 9)
AV_GAPS_M = (0.1, 1.0, 10.0, 50.0, 300.0)
NO_APPROACHES = np.empty((0, 2))
_IN_STATE = " at v = {:.3g} m/s, R1 = {:.3g} m, R1dot = {:.3g} m/s"


def load_parameters(settings: EnvironmentSettings) -> EnvironmentParameters:
    """The numbers that a campaign's environment names.

    Raises `CampaignError`: the file is missing or wrong, every place being named, or its laws give no probabilities.
    """
    file = shipped_or_own(settings.named(DEFAULT), SHIPPED_FOLDER, "environment.parameters")
    parameters = read_model(file, EnvironmentParameters)
    require_sound_laws(load_environment(settings, parameters), str(file))
    return parameters


def load_environment(settings: EnvironmentSettings, parameters: EnvironmentParameters | None = None) -> Environment:
    """The environment of a campaign, with its tables; ``parameters`` are read unless they are given."""
    parameters = parameters or load_parameters(settings)
    level, hold_s = settings.lane_change_level, settings.acceleration_hold_s
    numbers = parameter_record(parameters, lane_change_level=level, hold_s=hold_s)
    lateral = constant_lead() if parameters.lateral is None else parameters.lateral.motion()
    if settings.cut_in_lead_s is not None:
        lateral = constant_lead(settings.cut_in_lead_s, lateral.distance_m)
    hazard, steps = parameters.hazard_table, parameters.acceptance_steps
    wish = hazard.wish() if hazard else Wish(*np.empty((3, 0, 2)))
    return build_environment(numbers, lateral, wish, steps.steps() if steps else np.empty((0, 2)))


def require_sound_laws(environment: Environment, file: str) -> None:
    """Refuse an environment whose laws give something else than probabilities and finite states.

    Raises `CampaignError`: names the law and the parameter ``file``, and the state in which it fails.
    """
    n = environment.numbers
    speeds = np.linspace(n["fit_range__v_min_mps"], n["fit_range__v_max_mps"], 9)
    gaps = np.linspace(n["fit_range__r1_min_m"], n["fit_range__r1_max_m"], 9)
    with np.errstate(all="ignore"):
        _require_initial_states(environment, speeds, file)
    states = np.array(list(product(speeds, gaps, RATES_MPS)))
    approaches = np.array(list(product(AV_GAPS_M, RATES_MPS)))
    pmf, scale, chance, accepted = evaluate_laws(environment, states, approaches)
    for law, section in enumerate(("free_driving", "car_following")):
        where, total = f"{section} ({file})", pmf[law].sum(axis=1)
        limits = "a scale from {:g} to {:g} m/s²".format(*SCALES_MPS2)
        inside = (scale[law] >= SCALES_MPS2[0]) & (scale[law] <= SCALES_MPS2[1])
        require(inside, where, "noise of scale {:.3g} m/s²" + _IN_STATE, (scale[law], *states.T), limits)
        sums_to_1 = (pmf[law] >= 0.0).all(axis=1) & (np.abs(total - 1.0) < 1e-9)
        require(sums_to_1, where, "probabilities that sum to {:.12g}" + _IN_STATE, (total, *states.T), "a sum of 1")
    is_share = (accepted > 0.0) & (accepted <= 1.0)
    where = f"cut_in.accept_scale_s and cut_in.ignore_share ({file})"
    found = "a share of {:.3g} accepted at R2 = {:g} m, R2dot = {:g} m/s"
    require(is_share, where, found, (accepted, *approaches.T), "a share above 0 and at most 1")
    possible = np.isfinite(chance) & (chance * accepted.min() > SMALLEST_CHANCE)
    wish = "a wish to change lanes of {:.3g}" + _IN_STATE
    require(possible, f"cut_in ({file})", wish, (chance, *states.T), "a finite number above 0")


def _require_initial_states(environment: Environment, speeds: FloatArray, file: str) -> None:
    (initial := InitialStates(environment.numbers)).require_sound(file)
    for speed in speeds:
        states = initial.given_speed(speed, *(u.ravel() for u in np.meshgrid(PROBABILITIES, PROBABILITIES)))
        r1 = states["r1_m"][: PROBABILITIES.size]
        rate = states["r1dot_mps"].reshape(PROBABILITIES.size, -1)
        fast = np.where(np.isfinite(rate).all(axis=0), speed + rate[RARE], np.inf)
        found = f"LV at {{:.3g}} m/s in one of a million tests, at v = {speed:g} m/s, R1 = {{:.3g}} m"
        expected = f"rates that are finite, and an LV of at most {FASTEST_LV_MPS:g} m/s in all but one of a million"
        require(fast <= FASTEST_LV_MPS, f"initial_state.r1dot_* ({file})", found, (fast, r1), expected)


class LawValues(NamedTuple):
    """Accelerations by `FREE_DRIVING` and `CAR_FOLLOWING`: ``pmf`` (2, n, 31), ``scale`` (2, n); ``chance`` (n,) of a
    wish to change lanes, and shares ``accepted`` (m,).
    """  # noqa: D205

    pmf: FloatArray
    scale: FloatArray
    chance: FloatArray
    accepted: FloatArray


def evaluate_laws(environment: Environment, states: FloatArray, approaches: FloatArray = NO_APPROACHES) -> LawValues:
    """In states (n, 3) of v_BV, R1, R1dot and approaches (m, 2) of R2, R2dot, as kernels evaluate them."""
    n, m = len(states), len(approaches)
    out = LawValues(np.empty((2, n, N_ACCELERATIONS)), np.empty((2, n)), np.empty(n), np.empty(m))
    _evaluate(states, approaches, unboxed(environment), unboxed(out))
    return out


@compiled_threads
def _evaluate(states: FloatArray, approaches: FloatArray, environment: Environment, out: LawValues) -> None:
    for j in range(approaches.shape[0]):
        out.accepted[j] = laws.acceptance(approaches[j, 0], approaches[j, 1], environment)
    for i in range(states.shape[0]):
        speed, r1, r1dot = states[i]
        state = State(speed, r1, r1dot, math.nan, math.nan)
        free, following = laws.free_driving(speed, environment), laws.car_following(state, environment)
        laws.acceleration_pmf(free, environment, out.pmf[0, i])
        laws.acceleration_pmf(following, environment, out.pmf[1, i])
        out.scale[0, i], out.scale[1, i] = 1.0 / free.inverse_scale, 1.0 / following.inverse_scale
        out.chance[i] = laws.opportunity(state, environment)
