"""Initial states of episodes: (v_BV, R1, R1dot, R2, R2dot) by inversion of five uniforms each."""

from __future__ import annotations

import numpy as np
from scipy import special

from harness.random_stream import INITIAL, uniforms
from harness.vocabulary import STATE_COLUMNS, FloatArray, Record, RecordArray, states_from

_SPEED_POINTS = 8001


class InitialStates:
    """Sampler of initial states; ``speed_cdf`` is P(v_BV ≤ v) on a grid over the fit range."""

    def __init__(self, numbers: Record) -> None:
        self._n = n = numbers
        self._speeds = np.linspace(n["fit_range__v_min_mps"], n["fit_range__v_max_mps"], _SPEED_POINTS)
        shape, location, scale = (float(n[f"initial_state__v_{k}"]) for k in ("shape", "location_mps", "scale_mps"))
        z = (self._speeds - location) / scale
        cdf = special.ndtr(z) - 2.0 * special.owens_t(z, shape)  # of the skew normal distribution
        self.speed_cdf: FloatArray = (cdf - cdf[0]) / (cdf[-1] - cdf[0])

    def draw(self, seed: int, first_episode: int, n_episodes: int) -> RecordArray:
        """States of consecutive episodes, shape (n_episodes,)."""
        return self.from_uniforms(uniforms(seed, first_episode, n_episodes, INITIAL, len(STATE_COLUMNS)))

    def from_uniforms(self, u: FloatArray) -> RecordArray:
        """States (n,) from uniforms (n, 5), one for each of their numbers."""
        n, of = self._n, states_from(u.T)
        v = np.interp(of["v_bv_mps"], self.speed_cdf, self._speeds)
        r1 = self._gap(of["r1_m"], v)
        r1dot = self._rate(of["r1dot_mps"], v, r1)
        r2 = n["initial_state__r2_min_m"] + of["r2_m"] * (n["initial_state__r2_max_m"] - n["initial_state__r2_min_m"])
        span = n["initial_state__r2dot_max_mps"] - n["initial_state__r2dot_min_mps"]
        r2dot = n["initial_state__r2dot_min_mps"] + of["r2dot_mps"] * span
        return states_from([v, r1, r1dot, r2, r2dot])

    def given_speed(self, speed: float, gap_u: FloatArray, rate_u: FloatArray) -> RecordArray:
        """States (n,) at a fixed v_BV (m/s) from uniforms for R1 and R1dot, each (n,); the AV is nowhere."""
        v = np.full(gap_u.size, speed)
        r1 = self._gap(gap_u, v)
        nowhere = np.full_like(v, np.nan)
        return states_from([v, r1, self._rate(rate_u, v, r1), nowhere, nowhere])

    def _u(self, v: FloatArray) -> FloatArray:
        u: FloatArray = (v - self._n["fit_range__v_centre_mps"]) / self._n["fit_range__v_scale_mps"]
        return u

    def _gap(self, probability: FloatArray, v: FloatArray) -> FloatArray:
        """R1 = shift + LogNormal, truncated to the fit range."""
        n = self._n
        u = self._u(v)
        shift = n["initial_state__r1_shift_m"] + n["initial_state__r1_shift_u_m"] * u
        mean = n["initial_state__r1_log_mean"] + n["initial_state__r1_log_mean_u"] * u
        sd = np.exp(n["initial_state__r1_log_sd"] + n["initial_state__r1_log_sd_u"] * u)
        with np.errstate(divide="ignore"):
            below = special.ndtr((np.log(np.maximum(n["fit_range__r1_min_m"] - shift, 0.0)) - mean) / sd)
            upto = special.ndtr((np.log(n["fit_range__r1_max_m"] - shift) - mean) / sd)
        gap: FloatArray = shift + np.exp(mean + sd * special.ndtri(below + probability * (upto - below)))
        return gap

    def _rate(self, probability: FloatArray, v: FloatArray, r1: FloatArray) -> FloatArray:
        """R1dot = location + scale t, given that R1 is not closed within the smallest time to collision."""
        n = self._n
        u = self._u(v)
        w = (r1 - n["fit_range__r1_centre_m"]) / n["fit_range__r1_scale_m"]
        location = (
            n["initial_state__r1dot_location_mps"]
            + n["initial_state__r1dot_location_u"] * u
            + n["initial_state__r1dot_location_w"] * w
            + n["initial_state__r1dot_location_uw"] * (u * w)
            + n["initial_state__r1dot_location_uu"] * (u * u)
        )
        scale = np.exp(
            n["initial_state__r1dot_log_scale"]
            + n["initial_state__r1dot_log_scale_u"] * u
            + n["initial_state__r1dot_log_scale_w"] * w
            + n["initial_state__r1dot_log_scale_ww"] * (w * w)
        )
        df = float(n["initial_state__r1dot_df"])
        slowest = special.stdtr(df, (-r1 / n["initial_state__r1dot_min_ttc_s"] - location) / scale)
        rate: FloatArray = location + scale * special.stdtrit(df, slowest + probability * (1.0 - slowest))
        return rate
