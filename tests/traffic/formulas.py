"""The environment's formulas written out a second time, with numpy and scipy and the published numbers themselves.

Nothing here reads the parameter file or calls a kernel: agreement means that file, kernels and description agree.
"""

import numpy as np
from scipy import special, stats

ACCELERATIONS = np.linspace(-4.0, 2.0, 31)
EDGES = np.concatenate([[-np.inf], (ACCELERATIONS[1:] + ACCELERATIONS[:-1]) / 2, [np.inf]])


def fit_u(v):
    return (np.clip(v, 20.0, 40.0) - 30.0) / 10.0


def free_driving_pmf(v):
    """Probabilities of the 31 accelerations at a speed."""
    u = fit_u(v)
    weight = special.expit(-4.80 - 1.57 * u)
    noise = np.diff(stats.t.cdf(EDGES, 16, 0.061, np.exp(-1.416 - 0.262 * u + 0.423 * u**2)))
    brake = np.where(ACCELERATIONS <= -1.0 + 1e-9, np.exp(0.18 * ACCELERATIONS), 0.0)
    return (1.0 - weight) * noise + weight * brake / brake.sum()


def guard_room(a, r1, r1dot):
    """Gap (m) left to BV, should LV brake with 1 m/s² for a second and BV then stop closing at 3 m/s²."""
    gap_later = r1 + r1dot - (a + 1.0) / 2.0
    closing_later = np.maximum(0.0, -r1dot + a + 1.0)
    return gap_later - closing_later**2 / 6.0


def guard_caps(r1, r1dot):
    """Indices that may be the largest acceleration leaving a metre (0 when none does): several only within rounding."""
    room = guard_room(ACCELERATIONS, r1, r1dot)
    surely, perhaps = (np.flatnonzero(room >= 1.0 + rounding).max(initial=0) for rounding in (1e-9, -1e-9))
    return range(surely, perhaps + 1)


def car_following_mean(v, r1, r1dot):
    clamped = np.clip(v, 20.0, 40.0)
    mean = 0.16 * r1dot + 0.002 * (np.clip(r1, 0.0, 115.0) - (0.084 * clamped**2 - 3.605 * clamped + 65.59))
    needed = r1dot**2 / (2.0 * max(r1 - 2.0, 0.5))
    if r1dot < 0.0 and needed > 0.3:
        mean = -1.2 * needed
    return min(mean, -1.0) if r1 < 5.0 else mean


def car_following_pmf(v, r1, r1dot, cap):
    """Probabilities of the 31 accelerations of BV behind LV, what the guard forbids moved to its cap."""
    scale = np.exp(-1.849 + 0.248 * min(abs(r1dot), 4.0))
    wanted = np.diff(stats.t.cdf(EDGES, 3.39, car_following_mean(v, r1, r1dot), scale))
    allowed = np.where(np.arange(31) <= cap, wanted, 0.0)
    allowed[cap] += wanted[cap + 1 :].sum()
    return allowed


def opportunity(v, r1, r1dot, level):
    u, q = fit_u(v), np.clip(r1dot, -10.0, 10.0) / 5.0
    gap = np.clip(r1, 0.0, 115.0)
    wish = -8.744 - 0.318 * u - 0.727 * np.log(gap + 1.0) + 0.159 * q + 0.451 * q**2 + 0.618 * u**2
    return level * np.exp(wish)


def acceptance(r2, r2dot):
    if r2 <= 0.0:
        return 0.0
    accept = 1.0 if r2dot >= 0.0 else special.expit((r2 / -r2dot - 8.0) / 0.5)
    return 0.01 + 0.99 * accept


def step_probability(p_1s):
    return 1.0 - (1.0 - np.minimum(p_1s, 0.5)) ** 0.1
