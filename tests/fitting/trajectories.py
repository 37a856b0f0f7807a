"""Trajectories of a two-lane road with known motion, as a table of `harness.fitting.table`."""

import numpy as np
import pandas as pd

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
