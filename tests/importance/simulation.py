"""BV and a surrogate simulated directly with numpy: no kernel, no table, no grid, numbers as published.

Accelerations are drawn by rounding t noise to the grid instead of by inverting tabulated probabilities.
"""

import numpy as np
from scipy import special

BRAKES = np.linspace(-4.0, -1.0, 16)
BRAKE_SHARES = np.exp(0.18 * BRAKES) / np.exp(0.18 * BRAKES).sum()
SURROGATES = ("SM-I", "SM-II", "SM-III")


def free_driving(v, rng):
    """Accelerations (m/s²) of vehicles that drive freely at speeds v."""
    u = (np.clip(v, 20.0, 40.0) - 30.0) / 10.0
    noise = 0.061 + np.exp(-1.416 - 0.262 * u + 0.423 * u**2) * rng.standard_t(16, v.size)
    gentle = np.clip(np.round(noise / 0.2) * 0.2, -4.0, 2.0)
    return np.where(
        rng.random(v.size) < special.expit(-4.80 - 1.57 * u), rng.choice(BRAKES, v.size, p=BRAKE_SHARES), gentle
    )


def surrogate_acceleration(name, v, v_lead, gap):
    s = np.maximum(gap, 0.1)
    if name == "SM-I":
        wanted = 2.0 + np.maximum(0.0, v + v * (v - v_lead) / (2.0 * np.sqrt(2.0 * 3.0)))
        return np.clip(2.0 * (1.0 - (v / 40.0) ** 4 - (wanted / s) ** 2), -4.0, 2.0)
    optimal = 40.0 * (6.75 + 7.91 * np.tanh(0.13 * s - 1.57)) / (6.75 + 7.91)
    low = -1.0 if name == "SM-II" else -6.0
    return np.clip(0.85 * (optimal - v) + 0.5 * (v_lead - v), low, 2.0)


def advance(name, v, r2, rate, a):
    """One step of 0.1 s: BV with accelerations a, the surrogate by its model."""
    follower = v - rate
    follower_after = np.maximum(follower + 0.1 * surrogate_acceleration(name, follower, v, r2), 0.0)
    v_after = np.maximum(v + 0.1 * a, 0.0)
    return v_after, r2 + 0.05 * (v + v_after - follower - follower_after), v_after - follower_after


def crash_shares(name, state, seconds, n, rng, hold_steps=10):
    """Share of n roll-outs from (v_BV, R2, R2dot) in which the surrogate has crashed after each second: (seconds,)."""
    v, r2, rate = (np.full(n, float(value)) for value in state)
    crashed = np.zeros(n, bool)
    shares = []
    for step in range(10 * seconds):
        if step % hold_steps == 0:
            a = free_driving(v, rng)
        v, r2, rate = advance(name, v, r2, rate, a)
        crashed |= r2 < -0.001
        if step % 10 == 9:
            shares.append(crashed.mean())
    return np.array(shares)


def smallest_gap(name, states, accelerations, hold_steps=10, seconds=12):
    """Smallest gap (m) when BV takes an acceleration for a hold period and then keeps its speed; states (n, 3).

    It goes on below zero, as if the vehicles could overlap.
    """
    v, r2, rate = np.asarray(states, float).T
    smallest = np.full(v.size, np.inf)
    for step in range(10 * seconds):
        v, r2, rate = advance(name, v, r2, rate, accelerations if step < hold_steps else np.zeros(v.size))
        smallest = np.minimum(smallest, r2)
    return smallest


def states_near_the_edge(n, rng):
    """States (n, 3) whose gap is 0.5 to 1.6 times what braking with 1 to 6 m/s² needs: neither safe nor lost."""
    rate = rng.uniform(-14.0, -2.0, n)
    needed = rate**2 / (2.0 * rng.choice([1.0, 4.0, 6.0], n))
    return np.column_stack([rng.uniform(20.0, 40.0, n), np.clip(needed * rng.uniform(0.5, 1.6, n), 0.2, 85.0), rate])
