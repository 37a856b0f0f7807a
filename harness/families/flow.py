"""Speeds and gaps in free traffic, by inversion of uniforms: where tests of any family begin."""

from __future__ import annotations

import numpy as np
from scipy import special

from harness.vocabulary import FloatArray, Record

_SPEED_POINTS = 8001


class Flow:
    """Speeds, and gaps to the vehicle ahead at a speed; ``speed_cdf`` is P(speed ≤ v) on a grid over the fit range.

    ``numbers`` have the sections ``fit_range``, and of ``initial_state`` those of ``v`` and ``r1``.
    """

    def __init__(self, numbers: Record) -> None:
        self._n = n = numbers
        self._speeds = np.linspace(n["fit_range__v_min_mps"], n["fit_range__v_max_mps"], _SPEED_POINTS)
        shape, location, scale = (float(n[f"initial_state__v_{k}"]) for k in ("shape", "location_mps", "scale_mps"))
        z = (self._speeds - location) / scale
        cdf = special.ndtr(z) - 2.0 * special.owens_t(z, shape)  # of the skew normal distribution
        self.speed_cdf: FloatArray = (cdf - cdf[0]) / (cdf[-1] - cdf[0])

    def u_of(self, v: FloatArray) -> FloatArray:
        """Speeds (m/s) as fits have them."""
        return np.asarray((v - self._n["fit_range__v_centre_mps"]) / self._n["fit_range__v_scale_mps"])

    def speeds(self, probability: FloatArray) -> FloatArray:
        """Speeds (m/s) of probabilities, (n,) each: a skew normal distribution, truncated to the fit range."""
        return np.asarray(np.interp(probability, self.speed_cdf, self._speeds))

    def gaps(self, probability: FloatArray, v: FloatArray) -> FloatArray:
        """Gaps (m) of probabilities at speeds (m/s), (n,) each: shift + LogNormal, truncated to the fit range."""
        n = self._n
        u = self.u_of(v)
        shift = n["initial_state__r1_shift_m"] + n["initial_state__r1_shift_u_m"] * u
        mean = n["initial_state__r1_log_mean"] + n["initial_state__r1_log_mean_u"] * u
        sd = np.exp(n["initial_state__r1_log_sd"] + n["initial_state__r1_log_sd_u"] * u)
        with np.errstate(divide="ignore"):
            below = special.ndtr((np.log(np.maximum(n["fit_range__r1_min_m"] - shift, 0.0)) - mean) / sd)
            upto = special.ndtr((np.log(n["fit_range__r1_max_m"] - shift) - mean) / sd)
        return np.asarray(shift + np.exp(mean + sd * special.ndtri(below + probability * (upto - below))))
