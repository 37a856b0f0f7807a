"""Trajectories of known motion, as tables of `harness.fitting.table`: overtaking, and drivers who follow."""

import numpy as np
import pandas as pd

from harness.fitting.recording import Recording, recording_of

RATE_HZ = 10


def overtaking(hours: float, seed: int = 1, *, noise: float = 0.0) -> pd.DataFrame:
    """Recordings of up to 60 s with LV and BV on the left, and three vehicles that come from behind on the right.

    BV cuts in once where there is room, at a lateral speed of 0.5 to 1 m/s over 1.8 m; the recording ends a second
    after. Accelerations of BV and LV are held for a second: -0.2, 0 or 0.2 m/s², taken back in the next.
    """
    rng = np.random.default_rng(seed)
    n = max(round(hours * 3600 / 60 / 5), 1)
    time = np.arange(601) / RATE_HZ
    pairs = rng.choice([-0.2, 0.0, 0.2], (n, 2, 30))
    held = np.repeat(np.stack([pairs, -pairs], axis=3).reshape(n, 2, 60), RATE_HZ, axis=2)
    speed = np.empty((n, 5, time.size))
    speed[:, :2, 0] = rng.uniform(27, 30, (n, 1)) + np.array([0.0, 0.5])
    speed[:, :2, 1:] = speed[:, :2, :1] + np.cumsum(held, axis=2) / RATE_HZ
    speed[:, 2:] = (speed[:, 1, 0] + rng.uniform(4, 6, n))[:, None, None]
    position = np.zeros_like(speed)
    position[:, :, 1:] = np.cumsum(0.5 * (speed[:, :, 1:] + speed[:, :, :-1]), axis=2) / RATE_HZ
    position += np.array([60.0, 0.0, -40.0, -120.0, -200.0])[:, None]
    room = np.abs(position[:, 2:] - position[:, 1:2]).min(axis=1) > 12.0
    cut = np.array([rng.choice(np.flatnonzero(each[20:590])) + 20 for each in room])
    lateral_speed = rng.uniform(0.5, 1.0, n)
    come = np.clip(1.8 + (np.arange(601) - cut[:, None] - 0.5) / RATE_HZ * lateral_speed[:, None], 0.0, 3.6)
    lateral = np.zeros_like(speed)
    lateral[:, :2] = 3.6
    lateral[:, 1] -= come
    length = np.broadcast_to(rng.uniform(4.0, 5.5, (n, 5))[:, :, None], speed.shape)
    shape = speed.shape
    columns = {
        "recording_id": np.broadcast_to(np.arange(n)[:, None, None], shape),
        "vehicle_id": np.broadcast_to(np.arange(5)[None, :, None], shape),
        "time_s": np.broadcast_to(time, shape),
        "s_m": position + noise * rng.standard_normal(shape),
        "speed_mps": speed + noise * rng.standard_normal(shape),
        "lane": (lateral > 1.8).astype(int),
        "length_m": length,
        "lateral_m": lateral + noise * rng.standard_normal(shape),
    }
    rows = pd.DataFrame({name: values.ravel() for name, values in columns.items()})
    return rows[rows.time_s <= (cut[rows.recording_id] + RATE_HZ) / RATE_HZ + 1e-9].reset_index(drop=True)


# -- drivers who follow --


SPEED_MPS, LENGTH_M, LANE_M = 32.0, 4.5, 3.6
SLOT_S = 60
"""In which at most one event happens."""


def table(vehicle: int, s: np.ndarray, v: np.ndarray, lane=0, lateral=0.0) -> pd.DataFrame:
    """Rows of one vehicle."""
    columns = {"vehicle_id": str(vehicle), "time_s": np.arange(s.size) / RATE_HZ, "s_m": s, "speed_mps": v}
    return pd.DataFrame(columns | {"lane": lane, "length_m": LENGTH_M, "lateral_m": lateral})


def recording(rows: pd.DataFrame) -> Recording:
    """As `harness.fitting.table` makes it."""
    whole = {"row": np.arange(len(rows)), "road": 0, "fitted": True}
    return recording_of("0", "rows", rows.assign(**whole), 1.0)


def positions(v: np.ndarray, start_m: float = 0.0) -> np.ndarray:
    """Where a vehicle of some speeds is."""
    return start_m + np.append(0.0, np.cumsum(0.5 * (v[1:] + v[:-1]))) / RATE_HZ


def braked(v: np.ndarray, at: int, peak: float, held_s: float, jerk: float) -> None:
    """Brake from a row on, and speed up again with 1.5 m/s²."""
    usual, a, held, releases = v[at], 0.0, 0, False
    for i in range(at, v.size - 1):
        a = a + jerk / RATE_HZ if releases else max(-peak, a - jerk / RATE_HZ)
        held += a == -peak
        releases = releases or held >= max(held_s * RATE_HZ, 1)
        v[i + 1] = min(max(v[i] + min(a, 1.5) / RATE_HZ, 0.0), usual)
        a = min(a, 1.5)


def led(v: np.ndarray, n_followers: int = 1, headway_s: float = 1.5) -> pd.DataFrame:
    """A vehicle of some speeds, and drivers who do what it did a headway ago, one behind the other."""
    vehicles = []
    for i in range(n_followers + 1):
        late = round(headway_s * i * RATE_HZ)
        own = np.append(np.full(late, v[0]), v[: v.size - late])
        vehicles.append(table(i, positions(own, -late / RATE_HZ * v[0] - 6.0 * i), own))
    return pd.concat(vehicles)


def braking(hours: float, per_hour: float, seed: int, *, scale: float = 0.7, noise: float = 0.0) -> list[pd.DataFrame]:
    """Ten minutes each of a vehicle that brakes by the shipped law, but to no standstill, and a follower."""
    random, found = np.random.default_rng(seed), []
    for _ in range(round(6 * hours)):
        v = np.full(600 * RATE_HZ, SPEED_MPS)
        for slot in np.flatnonzero(random.random(10) < per_hour * SLOT_S / 3600):
            at, end = round((slot * SLOT_S + random.uniform(5, 20)) * RATE_HZ), (slot + 1) * SLOT_S * RATE_HZ
            peak, held_s = 3.0 + random.exponential(scale), 1.5 * np.exp(0.6 * random.standard_normal())
            braked(v[:end], at, peak, min(held_s, 4.0), random.choice([8.0, 16.0]))
        rows = led(v)
        found.append(rows.assign(speed_mps=rows.speed_mps + noise * random.standard_normal(len(rows))))
    return found


def leaving(n: int, share: float, seed: int) -> list[pd.DataFrame]:
    """A minute each, in a ``share`` of which the vehicle ahead leaves the lane by the shipped law; a car far ahead."""
    random, found = np.random.default_rng(seed), []
    for leaves in random.random(n) < share:
        v = np.full(SLOT_S * RATE_HZ, SPEED_MPS)
        drop, crossing = min(random.exponential(0.12), 0.9), (SLOT_S - 2) * RATE_HZ
        ttc_s, sideways = 5.0 * np.exp(0.45 * random.standard_normal()), 0.867 * np.exp(0.3 * random.standard_normal())
        lateral, s = np.zeros(v.size), positions(v, 60.0)
        vehicles = [table(0, positions(v), v), table(3, positions(v, 2500.0), v)]
        if leaves:
            since = (np.arange(v.size) - crossing - 0.5) / RATE_HZ
            lateral = np.clip(0.5 * LANE_M + sideways * since, 0.0, LANE_M)
            slow = (1.0 - drop) * SPEED_MPS
            gap = ttc_s * (SPEED_MPS - slow) + LENGTH_M
            revealed = s[crossing] + gap - slow * crossing / RATE_HZ
            vehicles.append(table(2, positions(np.full(v.size, slow), revealed), np.full(v.size, slow)))
        lane = (lateral > 0.5 * LANE_M).astype(int)
        found.append(pd.concat([*vehicles, table(1, s, v, lane, lateral)]))
    return found
