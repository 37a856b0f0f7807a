"""The laws of traffic: where a test begins, how LV and BV choose accelerations, and the hazard of BV's cut-in.

Initial states (v_BV, R1, R1dot, R2, R2dot) are an inversion of five uniforms each.

Accelerations come from free driving, or from car following within the guard that keeps BV off LV. Both are
distributions over the 31 accelerations, given as cumulative probabilities P(A ≤ a_k); the tails beyond the grid
belong to its end points. Sampling inverts the same function that the probabilities are differences of.

Student's t is a table: cubic Hermite interpolation of scipy's exact values and densities on a grid of 1/32 (absolute
error below 1e-8, tested), so that a recorded probability *is* the probability that was sampled from.

The probability of BV's cut-in (its lane change) is wish times acceptance, as a hazard per step. Drivers decide about
once a second with probability p_1s; a step of 0.1 s has p = 1 - (1 - p_1s)^0.1, so its cumulative hazard is -0.1 ln(1
- p_1s). A cut-in time is drawn by one exponential clock: it happens in the first step whose accumulated hazard
exceeds -ln(1 - U). Given that no cut-in has happened before, this is the Bernoulli(p) draw of the step, and the same
clock runs unchanged under importance functions and under the forced cut-in. Those that draw a path beforehand sum its
hazards (`weigh_cut_ins` in `path`), pools of shells too (`harness.pool.aim`); all others go step by step
(`choose_lane` in `nade.decide`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from harness import elementary
from harness.compiled import compiled_inline
from harness.families.cut_in.lateral import LateralMotion
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2, N_ACCELERATIONS, State, states_from
from harness.families.flow import Flow
from harness.random_stream import INITIAL, uniforms
from harness.vocabulary import FloatArray, Record, RecordArray

FREE_DRIVING, CAR_FOLLOWING = 0, 1
"""Which table of noise a law has."""
_T_LIMIT = 64.0
_T_PER_UNIT = 32.0
_BELOW_ONE = 1.0 - 2.0**-53


class Wish(NamedTuple):
    """Logarithm of the wish to change lanes (per second): a sum of functions of v_BV, R1 and R1dot.

    Each (n, 2) has knots and values, between which it is linear, and outside of which it is constant. Where they are
    empty the wish has a formula.
    """

    v: FloatArray
    r1: FloatArray
    r1dot: FloatArray


class Environment(NamedTuple):
    """All that kernels need of the environment.

    ``numbers`` is the parameter record; ``noise_t`` (2, 4097, 2) are the tables of Student's t for free driving and car
    following; ``brake_cumulative`` (31,) is the cumulative distribution of braking in free driving; ``lateral`` says
    how long cut-ins show themselves. ``wish`` and ``accepted`` (n, 2), upper ends of times to collision and shares, are
    tables in place of formulas, or empty.
    """

    numbers: Record
    noise_t: FloatArray
    brake_cumulative: FloatArray
    lateral: LateralMotion
    wish: Wish
    accepted: FloatArray

    def content(self) -> dict[str, Any]:
        """All numbers but those of the lateral motion, for a hash; tables only where they are."""
        tables = {**self.wish._asdict(), "accepted": self.accepted}
        numbers = {name: self.numbers[name].item() for name in self.numbers.dtype.names or ()}
        return numbers | {name: table.tolist() for name, table in tables.items() if table.size}


class AccelerationLaw(NamedTuple):
    """P(A ≤ a_k) = (1 − b) T((e_k − mean) · inverse_scale) + b B_k for k < ``cap``, else 1; e_k is a bin's upper edge.

    ``mean`` in m/s², ``inverse_scale`` in s²/m; T and B are ``noise_t[noise]`` and ``brake_cumulative`` of the
    environment, ``brake_share`` is b.
    """

    noise: int
    cap: int
    mean: float
    inverse_scale: float
    brake_share: float


def build_environment(numbers: Record, lateral: LateralMotion, wish: Wish, accepted: FloatArray) -> Environment:
    """Tables of an environment from its parameter record."""
    powers = elementary.exp(numbers["free_driving__brake_slope_s2pm"] * ACCELERATIONS_MPS2)
    braking = np.where(numbers["free_driving__brake_max_mps2"] + 1e-9 >= ACCELERATIONS_MPS2, powers, 0.0)
    cumulative = np.cumsum(braking) / braking.sum()
    cumulative[-1] = 1.0
    noise_t = np.stack([t_table(float(numbers[name])) for name in ("free_driving__df", "car_following__df")])
    return Environment(numbers, noise_t, cumulative, lateral, wish, accepted)


def t_table(df: float) -> FloatArray:
    """Distribution function of Student's t on [-64, 64], and its derivative times the grid step: shape (4097, 2)."""
    z = np.arange(-_T_LIMIT * _T_PER_UNIT, _T_LIMIT * _T_PER_UNIT + 1) / _T_PER_UNIT
    peak = special.poch(0.5 * df, 0.5) / np.sqrt(df * np.pi)
    density = peak * elementary.exp(-0.5 * (df + 1.0) * elementary.log1p(z * z / df))
    return np.column_stack([special.stdtr(df, z), density / _T_PER_UNIT])


@compiled_inline
def acceleration(maneuver: int) -> float:
    """Acceleration (m/s²) of maneuver index 0 … 30."""
    return (maneuver - 20) / 5.0


@compiled_inline
def t_cdf(z: float, table: FloatArray) -> float:
    """P(T ≤ z); 0 and 1 outside of the table."""
    position = (z + _T_LIMIT) * _T_PER_UNIT
    if not position > 0.0:
        return 0.0
    if position >= table.shape[0] - 1:
        return 1.0
    i = int(position)
    s = position - i
    y0, y1 = table[i, 0], table[i + 1, 0]
    d0, d1 = table[i, 1], table[i + 1, 1]
    rise = y1 - y0
    return float(y0 + s * (d0 + s * ((3.0 * rise - 2.0 * d0 - d1) + s * (d0 + d1 - 2.0 * rise))))


@compiled_inline
def cumulative_probability(k: int, law: AccelerationLaw, environment: Environment) -> float:
    """P(A ≤ a_k)."""
    if k >= law.cap:
        return 1.0
    upper_edge = acceleration(k) + 0.1  # m/s², of the 0.2-wide bin; the last one has none
    noise = t_cdf((upper_edge - law.mean) * law.inverse_scale, environment.noise_t[law.noise])
    return float((1.0 - law.brake_share) * noise + law.brake_share * environment.brake_cumulative[k])


@compiled_inline
def draw_acceleration(u: float, law: AccelerationLaw, environment: Environment) -> int:
    """Acceleration index by inversion of a uniform (bisection on the cumulative probabilities)."""
    low, high = 0, law.cap
    while low < high:
        middle = (low + high) // 2
        if cumulative_probability(middle, law, environment) > u:
            high = middle
        else:
            low = middle + 1
    return low


@compiled_inline
def acceleration_pmf(law: AccelerationLaw, environment: Environment, out: FloatArray) -> None:
    """Probabilities of the 31 accelerations, written to ``out`` (31,)."""
    below = 0.0
    for k in range(N_ACCELERATIONS):
        upto = cumulative_probability(k, law, environment)
        out[k] = max(upto - below, 0.0)
        below = upto


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
def free_driving(speed: float, environment: Environment) -> AccelerationLaw:
    """Accelerations of LV, and of BV after its cut-in, at a speed."""
    n = environment.numbers
    u = fit_u(speed, environment)
    log_scale = n.free_driving__log_scale + n.free_driving__log_scale_u * u + n.free_driving__log_scale_uu * (u * u)
    brake_share = 1.0 / (1.0 + math.exp(-(n.free_driving__brake_logit + n.free_driving__brake_logit_u * u)))
    mean = n.free_driving__location_mps2
    return AccelerationLaw(FREE_DRIVING, N_ACCELERATIONS - 1, mean, math.exp(-log_scale), brake_share)


@compiled_inline
def drive_freely(u: float, speed: float, environment: Environment) -> int:
    """Acceleration index of a vehicle that drives freely, from a uniform."""
    return draw_acceleration(u, free_driving(speed, environment), environment)


@compiled_inline
def car_following(state: State, environment: Environment) -> AccelerationLaw:
    """Accelerations of BV behind LV: what the guard forbids is moved to its cap."""
    n = environment.numbers
    rate = min(abs(state.r1dot_mps), n.car_following__rate_cap_mps)
    inverse_scale = math.exp(-(n.car_following__log_scale + n.car_following__log_scale_rate * rate))
    cap, mean = guard_cap(state, environment), car_following_mean(state, environment)
    return AccelerationLaw(CAR_FOLLOWING, cap, mean, inverse_scale, 0.0)


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
        needed_mps2 = (r1dot * r1dot) / (2.0 * room)
        if needed_mps2 > n.car_following__closing_threshold_mps2:
            mean = -n.car_following__closing_gain * needed_mps2
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
def piecewise_linear(x: float, table: FloatArray) -> float:
    """Value at ``x`` of a function that is linear between the knots of ``table`` (n, 2), and constant beyond them."""
    last = table.shape[0] - 1
    if x >= table[last, 0]:
        return float(table[last, 1])
    i = 0
    while i < last and table[i, 0] <= x:
        i += 1
    if i == 0:
        return float(table[0, 1])
    x0, y0 = table[i - 1, 0], table[i - 1, 1]
    return float(y0 + (x - x0) * (table[i, 1] - y0) / (table[i, 0] - x0))


@compiled_inline
def opportunity(state: State, environment: Environment) -> float:
    """OL, the rate per one-second decision at which BV wants to leave its lane, times the campaign's level."""
    n, table = environment.numbers, environment.wish
    if table.v.shape[0] > 0:
        log_wish = piecewise_linear(state.v_bv_mps, table.v) + piecewise_linear(state.r1_m, table.r1)
        return float(n.level * math.exp(log_wish + piecewise_linear(state.r1dot_mps, table.r1dot)))
    u = fit_u(state.v_bv_mps, environment)
    gap = clamp(state.r1_m, n.fit_range__r1_min_m, n.fit_range__r1_max_m)
    q = clamp(state.r1dot_mps, -n.cut_in__rate_clamp_mps, n.cut_in__rate_clamp_mps) / n.cut_in__rate_scale_mps
    exponent = (
        n.cut_in__intercept
        + n.cut_in__u * u
        + n.cut_in__log_gap * math.log(gap + 1.0)
        + n.cut_in__rate * q
        + n.cut_in__rate_squared * (q * q)
        + n.cut_in__u_squared * (u * u)
    )
    return float(n.level * math.exp(exponent))


@compiled_inline
def acceptance(r2: float, r2dot: float, environment: Environment) -> float:
    """Share of wished lane changes carried out in front of an AV that closes from R2 at -R2dot."""
    n, steps = environment.numbers, environment.accepted
    if r2 <= 0.0:
        return 0.0
    if steps.shape[0] > 0:
        step = 0
        while r2 >= -r2dot * steps[step, 0] and step < steps.shape[0] - 1:
            step += 1
        return float(steps[step, 1])
    accept = 1.0
    if r2dot < 0.0:
        ttc = r2 / (-r2dot)
        accept = 1.0 / (1.0 + math.exp(-(ttc - n.cut_in__accept_ttc_s) / n.cut_in__accept_scale_s))
    return float(n.cut_in__ignore_share + (1.0 - n.cut_in__ignore_share) * accept)


@compiled_inline
def cut_in_hazard(opportunity_1s: float, accepted: float, environment: Environment) -> float:
    """Cumulative hazard -ln(1 - p) of one step."""
    n = environment.numbers
    p_1s = min(opportunity_1s * accepted, n.cut_in__max_probability_1s)
    return float(-n.scenario__step_s * math.log1p(-p_1s))


class InitialStates(Flow):
    """Sampler of initial states."""

    def draw(self, seed: int, first_episode: int, n_episodes: int) -> RecordArray:
        """States of consecutive episodes, shape (n_episodes,)."""
        return self.from_uniforms(uniforms(seed, first_episode, n_episodes, INITIAL, len(State._fields)))

    def from_uniforms(self, u: FloatArray) -> RecordArray:
        """States (n,) from uniforms (n, 5), one for each of their numbers."""
        n = self._n
        probability = states_from(u.T)
        v = self.speeds(probability["v_bv_mps"])
        r1 = self.gaps(probability["r1_m"], v)
        r1dot = self._rate(probability["r1dot_mps"], v, r1)
        low, high = n["initial_state__r2_min_m"], n["initial_state__r2_max_m"]
        r2 = low + probability["r2_m"] * (high - low)
        span = n["initial_state__r2dot_max_mps"] - n["initial_state__r2dot_min_mps"]
        r2dot = n["initial_state__r2dot_min_mps"] + probability["r2dot_mps"] * span
        return states_from([v, r1, r1dot, r2, r2dot])

    def given_speed(self, speed: float, gap_u: FloatArray, rate_u: FloatArray) -> RecordArray:
        """States (n,) at a fixed v_BV (m/s) from uniforms for R1 and R1dot, each (n,); the AV is nowhere."""
        v = np.full(gap_u.size, speed)
        r1 = self.gaps(gap_u, v)
        nowhere = np.full_like(v, np.nan)
        return states_from([v, r1, self._rate(rate_u, v, r1), nowhere, nowhere])

    def _rate(self, probability: FloatArray, v: FloatArray, r1: FloatArray) -> FloatArray:
        """R1dot = location + scale t, given that R1 is not closed within the smallest time to collision."""
        n = self._n
        u = self.u_of(v)
        w = (r1 - n["fit_range__r1_centre_m"]) / n["fit_range__r1_scale_m"]

        def c(name: str) -> float:
            return float(n[f"initial_state__r1dot_{name}"])

        location = c("location_mps") + c("location_u") * u + c("location_w") * w + c("location_uw") * (u * w)
        location = location + c("location_uu") * (u * u)
        scale = elementary.exp(
            c("log_scale") + c("log_scale_u") * u + c("log_scale_w") * w + c("log_scale_ww") * (w * w)
        )
        df = float(n["initial_state__r1dot_df"])
        slowest = special.stdtr(df, (-r1 / n["initial_state__r1dot_min_ttc_s"] - location) / scale)
        below = np.minimum(slowest + probability * (1.0 - slowest), _BELOW_ONE)  # at 1 it is inf
        return np.asarray(location + scale * special.stdtrit(df, below))
