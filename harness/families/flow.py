"""Speeds and gaps in free traffic, by inversion of uniforms: where tests of any family begin."""

from __future__ import annotations

import numpy as np
from scipy import special

from harness import elementary
from harness.errors import CampaignError
from harness.vocabulary import BoolArray, FloatArray, Record

_SPEED_POINTS = 8001
PROBABILITIES = np.array([2.0**-53, 1e-6, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0 - 1e-6, 1.0 - 2.0**-53])
"""Where quantiles are evaluated; the ends are the smallest uniform above zero, and the largest, that can be drawn."""


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
        with np.errstate(invalid="ignore"):  # see `require_sound`
            self.speed_cdf: FloatArray = (cdf - cdf[0]) / (cdf[-1] - cdf[0])

    def u_of(self, v: FloatArray) -> FloatArray:
        """Scaled speeds u of the fits, from speeds (m/s)."""
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
        sd = elementary.exp(n["initial_state__r1_log_sd"] + n["initial_state__r1_log_sd_u"] * u)
        with np.errstate(divide="ignore", invalid="ignore"):
            below = special.ndtr((elementary.log(np.maximum(n["fit_range__r1_min_m"] - shift, 0.0)) - mean) / sd)
            upto = special.ndtr((elementary.log(n["fit_range__r1_max_m"] - shift) - mean) / sd)
        return np.asarray(shift + elementary.exp(mean + sd * special.ndtri(below + probability * (upto - below))))

    def require_sound(self, file: str) -> None:
        """Refuse laws that give no values within the fit range (`CampaignError`, naming the parameter ``file``)."""
        reaches = np.diff(self.speed_cdf) >= -1e-9  # rounding shows where next to nothing of the distribution is left
        where = f"initial_state.v_location_mps, v_scale_mps and v_shape ({file})"
        require(reaches, where, "no speed within the fit range", (), "a distribution of v_BV that reaches into it")
        least, most = self._n["fit_range__r1_min_m"], self._n["fit_range__r1_max_m"]
        for speed in np.linspace(self._speeds[0], self._speeds[-1], 9):
            r1 = self.gaps(PROBABILITIES, np.full(PROBABILITIES.size, speed))
            inside = (r1 >= least - 1e-6) & (r1 <= most + 1e-6)
            rises = np.append(r1[2:] > r1[:-2], [True, True])  # pairs, because the outermost two may agree
            found = f"R1 = {{:.3g}} m in the {{:.6g}} quantile at v = {speed:g} m/s"
            expected = f"gaps spread within the fit range, {least:g} to {most:g} m"
            require(inside & rises, f"initial_state.r1_* ({file})", found, (r1, PROBABILITIES), expected)


def require(sound: BoolArray, where: str, found: str, values: tuple[FloatArray, ...], expected: str) -> None:
    """Refuse a law that is not sound (n,) everywhere; ``found`` formats the ``values`` (n,) where it first fails."""
    if not sound.all():
        first = int(np.argmin(sound))
        mend = "The numbers are allowed one by one, but not together: correct those of this law."
        raise CampaignError(where, found.format(*(value[first] for value in values)), expected, mend)
