"""Probability of BV's cut-in (its lane change): wish times acceptance, as a hazard per step.

Drivers decide about once a second with probability p_1s; a step of 0.1 s has p = 1 - (1 - p_1s)^0.1, so its cumulative
hazard is -0.1 ln(1 - p_1s). A cut-in time is drawn by one exponential clock: it happens in the first step whose
accumulated hazard exceeds -ln(1 - U). Given that no cut-in has happened before, this is the Bernoulli(p) draw of the
step, and the same clock runs unchanged under importance functions and under the forced cut-in. Those that draw a path
beforehand sum its hazards (`harness.episode.trajectory.weigh_cut_ins`); all others go step by step
(`harness.episode.critical_moment.choose_lane`).
"""

from __future__ import annotations

import math

from harness.compiled import compiled_inline
from harness.traffic.driving import Environment, clamp, fit_u
from harness.vocabulary import State


@compiled_inline
def opportunity(state: State, environment: Environment) -> float:
    """OL, the rate per one-second decision at which BV wants to leave its lane, times the campaign's level."""
    n = environment.numbers
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
    n = environment.numbers
    if r2 <= 0.0:
        return 0.0
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
