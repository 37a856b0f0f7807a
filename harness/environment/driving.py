"""How LV and BV choose accelerations: free driving, car following, and the guard that keeps BV off LV.

Both are distributions over the 31 accelerations. They are given as cumulative probabilities P(A ≤ a_k); the tails
beyond the grid belong to its end points. Sampling inverts the same function that the probabilities are differences of.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.arrays import FloatArray, Record
from harness.compiled import compiled_inline
from harness.environment.student_t import t_cdf, t_table
from harness.maneuvers import ACCELERATIONS_MPS2, N_ACCELERATIONS, acceleration, upper_edge
from harness.state import State


class Environment(NamedTuple):
    """All that kernels need of the environment.

    ``numbers`` is the parameter record; ``free_t`` and ``following_t`` are tables of Student's t;
    ``brake_cumulative`` (31,) is the cumulative brake component of free driving.
    """

    numbers: Record
    free_t: FloatArray
    following_t: FloatArray
    brake_cumulative: FloatArray


def build_environment(numbers: Record) -> Environment:
    """Tables of an environment from its parameter record."""
    braking = np.where(
        numbers["free_driving__brake_max_mps2"] + 1e-9 >= ACCELERATIONS_MPS2,
        np.exp(numbers["free_driving__brake_slope_s2pm"] * ACCELERATIONS_MPS2),
        0.0,
    )
    cumulative = np.cumsum(braking) / braking.sum()
    cumulative[-1] = 1.0
    free_t, following_t = (t_table(float(numbers[name])) for name in ("free_driving__df", "car_following__df"))
    return Environment(numbers, free_t, following_t, cumulative)


@compiled_inline
def clamp(x: float, low: float, high: float) -> float:
    """X limited to [low, high]."""
    return min(max(x, low), high)


@compiled_inline
def fit_u(speed: float, environment: Environment) -> float:
    """U = (v - 30)/10 with v clamped to the fit range."""
    n = environment.numbers
    v = clamp(speed, n.fit_range__v_min_mps, n.fit_range__v_max_mps)
    return float((v - n.fit_range__v_centre_mps) / n.fit_range__v_scale_mps)


@compiled_inline
def free_driving_shape(speed: float, environment: Environment) -> tuple[float, float]:
    """Weight of the brake component, and 1/scale of the t component, at a speed."""
    n = environment.numbers
    u = fit_u(speed, environment)
    log_scale = n.free_driving__log_scale + n.free_driving__log_scale_u * u + n.free_driving__log_scale_uu * (u * u)
    weight = 1.0 / (1.0 + math.exp(-(n.free_driving__brake_logit + n.free_driving__brake_logit_u * u)))
    return weight, math.exp(-log_scale)


@compiled_inline
def free_driving_cdf(k: int, weight: float, inverse_scale: float, environment: Environment) -> float:
    """P(A ≤ a_k) in free driving."""
    if k >= N_ACCELERATIONS - 1:
        return 1.0
    z = (upper_edge(k) - environment.numbers.free_driving__location_mps2) * inverse_scale
    return float((1.0 - weight) * t_cdf(z, environment.free_t) + weight * environment.brake_cumulative[k])


@compiled_inline
def draw_free_driving(u: float, speed: float, environment: Environment) -> int:
    """Acceleration index by inversion of a uniform (bisection on the cumulative probabilities)."""
    weight, inverse_scale = free_driving_shape(speed, environment)
    low, high = 0, N_ACCELERATIONS - 1
    while low < high:
        middle = (low + high) // 2
        if free_driving_cdf(middle, weight, inverse_scale, environment) > u:
            high = middle
        else:
            low = middle + 1
    return low


@compiled_inline
def free_driving_pmf(speed: float, environment: Environment, out: FloatArray) -> None:
    """Probabilities of the 31 accelerations in free driving, written to ``out`` (31,)."""
    weight, inverse_scale = free_driving_shape(speed, environment)
    below = 0.0
    for k in range(N_ACCELERATIONS):
        upto = free_driving_cdf(k, weight, inverse_scale, environment)
        out[k] = max(upto - below, 0.0)
        below = upto


@compiled_inline
def car_following_mean(state: State, environment: Environment) -> float:
    """Mean acceleration (m/s²) of BV behind LV."""
    n = environment.numbers
    r1, r1dot = state.r1_m, state.r1dot_mps
    v = clamp(state.v_bv_mps, n.fit_range__v_min_mps, n.fit_range__v_max_mps)
    gap = clamp(r1, n.fit_range__r1_min_m, n.fit_range__r1_max_m)
    median = (
        n.car_following__median_gap_m + n.car_following__median_gap_v * v + n.car_following__median_gap_vv * (v * v)
    )
    mean = n.car_following__gain_rate_per_s * r1dot + n.car_following__gain_gap_per_s2 * (gap - median)
    if r1dot < 0.0:
        room = max(r1 - n.car_following__standstill_m, n.car_following__smallest_gap_m)
        needed = (r1dot * r1dot) / (2.0 * room)
        if needed > n.car_following__closing_threshold_mps2:
            mean = -n.car_following__closing_gain * needed
    if r1 < n.car_following__near_gap_m:
        mean = min(mean, n.car_following__near_mean_max_mps2)
    return float(mean)


@compiled_inline
def guard_cap(state: State, environment: Environment) -> int:
    """Largest acceleration index that the guard allows.

    The largest a with R1 + R1dot h - (a + b_L) h²/2 - max(0, -R1dot + (a + b_L) h)²/(2 b) ≥ margin, or -4 m/s².
    """
    n = environment.numbers
    h = n.guard__horizon_s
    k = N_ACCELERATIONS - 1
    while k > 0:
        closing_acceleration = acceleration(k) + n.guard__lead_braking_mps2
        gap = state.r1_m + state.r1dot_mps * h - 0.5 * closing_acceleration * (h * h)
        closing = max(0.0, closing_acceleration * h - state.r1dot_mps)
        if gap - (closing * closing) / (2.0 * n.guard__own_braking_mps2) >= n.guard__margin_m:
            break
        k -= 1
    return k


@compiled_inline
def car_following_cdf(k: int, cap: int, mean: float, inverse_scale: float, environment: Environment) -> float:
    """P(A ≤ a_k) of BV behind LV: what the guard forbids is moved to its cap."""
    if k >= cap:
        return 1.0
    return t_cdf((upper_edge(k) - mean) * inverse_scale, environment.following_t)


@compiled_inline
def car_following_inverse_scale(r1dot: float, environment: Environment) -> float:
    """1/scale (s²/m) of the car-following noise."""
    n = environment.numbers
    rate = min(abs(r1dot), n.car_following__rate_cap_mps)
    return math.exp(-(n.car_following__log_scale + n.car_following__log_scale_rate * rate))


@compiled_inline
def draw_car_following(u: float, state: State, environment: Environment) -> int:
    """Acceleration index of BV behind LV by inversion of a uniform."""
    mean = car_following_mean(state, environment)
    inverse_scale = car_following_inverse_scale(state.r1dot_mps, environment)
    cap = guard_cap(state, environment)
    low, high = 0, cap
    while low < high:
        middle = (low + high) // 2
        if car_following_cdf(middle, cap, mean, inverse_scale, environment) > u:
            high = middle
        else:
            low = middle + 1
    return low


@compiled_inline
def car_following_pmf(state: State, environment: Environment, out: FloatArray) -> None:
    """Probabilities of the 31 accelerations of BV behind LV, written to ``out`` (31,)."""
    mean = car_following_mean(state, environment)
    inverse_scale = car_following_inverse_scale(state.r1dot_mps, environment)
    cap = guard_cap(state, environment)
    below = 0.0
    for k in range(N_ACCELERATIONS):
        upto = car_following_cdf(k, cap, mean, inverse_scale, environment)
        out[k] = max(upto - below, 0.0)
        below = upto
