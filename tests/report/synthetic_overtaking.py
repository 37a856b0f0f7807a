"""A small vectorised overtaking simulation that fills the record schemas with rows that could have happened.

It is not the harness's environment (no guard, a plain hazard, two made-up importance functions): it only keeps the
relations that a reader of the records may rely on, such as weights that follow from the recorded log_q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEP_S = 0.1
N_STEPS = 200
LENGTH_M = 5.0
N_COMPONENTS = 4
ALPHA = np.array([0.1, 0.3, 0.3, 0.3])
"""Of the campaign's default mixture: forced cut-ins, then three surrogates."""


@dataclass
class Episodes:
    """Arrays over n episodes; ``x_m`` and ``v_mps`` are (n, steps + 1, 3) in the order LV, BV, AV."""

    columns: dict[str, np.ndarray]
    log_q: np.ndarray
    lv_maneuvers: np.ndarray
    bv_maneuvers: np.ndarray
    x_m: np.ndarray
    v_mps: np.ndarray


def idm(v: np.ndarray, gap: np.ndarray, v_lead: np.ndarray) -> np.ndarray:
    wanted = 2.0 + np.maximum(0.0, v + v * (v - v_lead) / (2.0 * np.sqrt(6.0)))
    return np.clip(2.0 * (1.0 - (v / 40.0) ** 4 - (wanted / np.maximum(gap, 0.1)) ** 2), -4.0, 2.0)


def hazards(r2: np.ndarray, r2dot: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut-in probability per step under the NDE (n,) and under each importance function (n, components)."""
    ttc = np.where(r2dot < 0.0, r2 / np.maximum(-r2dot, 1e-9), np.inf)
    accept = 1.0 / (1.0 + np.exp(-np.clip((ttc - 8.0) / 0.5, -50.0, 50.0)))
    p_1s = np.minimum(level * 1e-5 * (0.01 + 0.99 * accept), 0.5)
    p = np.where(r2 > 0.0, 1.0 - (1.0 - p_1s) ** 0.1, 0.0)
    ttc = np.minimum(ttc, 60.0)
    surrogates = [0.08 / (1.0 + np.exp((ttc - at_s) / (0.13 * at_s))) for at_s in (3.0, 3.7, 4.5)]
    q = np.stack([np.full_like(p, 0.01), *(0.9 * challenge + 0.1 * p for challenge in surrogates)], axis=1)
    return p, np.where(p[:, None] > 0.0, q, 0.0)


def simulate(n: int, *, seed: int, level: float, controlled: bool) -> Episodes:
    """Simulate n tests, drawing cut-ins from the episode mixture or, uncontrolled, from the NDE."""
    rng = np.random.default_rng(seed)
    v_bv = np.clip(rng.normal(30.0, 3.4, n), 20.0, 40.0)
    r1, r1dot = np.clip(rng.lognormal(3.4, 0.5, n), 5.0, 115.0), rng.normal(0.3, 1.3, n)
    r2, r2dot = rng.uniform(20.0, 100.0, n), rng.uniform(-10.0, -5.0, n)
    component = rng.choice(N_COMPONENTS, n, p=ALPHA)
    x = np.zeros((n, N_STEPS + 1, 3))
    v = np.zeros_like(x)
    v[:, 0] = np.stack([v_bv + r1dot, v_bv, v_bv - r2dot], axis=1)
    x[:, 0, 2] = 100.0
    x[:, 0, 1] = x[:, 0, 2] + r2 + LENGTH_M
    x[:, 0, 0] = x[:, 0, 1] + r1 + LENGTH_M
    maneuvers = np.clip(np.rint(20.0 + rng.standard_t(8, (2, n, 20)) * 1.5), 0, 30).astype(np.int64)
    accelerations = -4.0 + 0.2 * maneuvers
    cut_in, end = np.full(n, -1), np.full(n, N_STEPS)
    cut_r2, cut_r2dot = np.full(n, np.nan), np.full(n, np.nan)
    outcome = np.full(n, "timeout", dtype="<U16")
    log_q, n_control = np.zeros((n, N_COMPONENTS)), np.zeros(n, dtype=int)
    min_ttc, active = np.full(n, np.inf), np.ones(n, dtype=bool)
    for t in range(N_STEPS):
        gap = x[:, t, 1] - LENGTH_M - x[:, t, 2]
        rate = v[:, t, 1] - v[:, t, 2]
        p, q = hazards(gap, rate, level)
        decides = active & (cut_in < 0) & (p > 0.0)
        drawn = q[np.arange(n), component] if controlled else p
        cuts = decides & (rng.random(n) < drawn)
        if controlled:
            ratio = np.where(cuts[:, None], q / np.maximum(p, 1e-300)[:, None], (1.0 - q) / (1.0 - p)[:, None])
            log_q[decides] += np.log(ratio[decides])
            n_control[decides] += 1
        cut_in[cuts], cut_r2[cuts], cut_r2dot[cuts] = t, gap[cuts], rate[cuts]
        a = np.stack([accelerations[0, :, t // 10], accelerations[1, :, t // 10], np.zeros(n)], axis=1)
        following = (cut_in >= 0) & (cut_in < t)
        a[following, 2] = idm(v[following, t, 2], gap[following], v[following, t, 1])
        v[:, t + 1] = np.maximum(v[:, t] + a * STEP_S, 0.0)
        x[:, t + 1] = x[:, t] + 0.5 * (v[:, t] + v[:, t + 1]) * STEP_S
        gap, rate = x[:, t + 1, 1] - LENGTH_M - x[:, t + 1, 2], v[:, t + 1, 1] - v[:, t + 1, 2]
        closing = active & (cut_in >= 0) & (rate < 0.0)
        min_ttc[closing] = np.minimum(min_ttc[closing], np.maximum(gap[closing], 0.0) / -rate[closing])
        for name, ends in (
            ("crash", active & (cut_in >= 0) & (gap < -0.001)),
            ("passed", active & (cut_in < 0) & (gap <= 0.0)),
        ):
            outcome[ends], end[ends] = name, t + 1
            active &= ~ends
    crash = outcome == "crash"
    impact = np.where(crash, v[np.arange(n), end, 2] - v[np.arange(n), end, 1], np.nan)
    mixture = np.log(np.exp(log_q) @ ALPHA)
    columns = {
        "v_bv_mps": v_bv, "r1_m": r1, "r1dot_mps": r1dot, "r2_m": r2, "r2dot_mps": r2dot,
        "outcome": outcome, "n_steps": end, "cut_in_step": cut_in, "cut_in_r2_m": cut_r2, "cut_in_r2dot_mps": cut_r2dot,
        "crash_time_s": np.where(crash, end * STEP_S, np.nan), "impact_speed_mps": impact,
        "min_ttc_s": np.where(np.isfinite(min_ttc), min_ttc, np.nan),
        "av_distance_m": x[np.arange(n), end, 2] - 100.0, "n_control_steps": n_control,
        "component": component if controlled else np.full(n, -1), "log_weight": -mixture if controlled else np.zeros(n),
    }  # fmt: skip
    return Episodes(columns, log_q, maneuvers[0], maneuvers[1], x, v)
