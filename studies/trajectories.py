"""Trajectories of an environment's own traffic, to try `harness fit` on: what was put in is known.

Vehicles drive in triples, one after the other, over a road of two lanes: LV and BV on the left, a third on the right
that comes from behind and is faster as a rule. BV follows LV until it changes lanes by the environment's hazard and
acceptance, with its lead; the others drive freely, BV after its lane change, too. Accelerations are drawn in whole
seconds of ``time_s``. Each of the laws holds in every step, since a triple ends by what was there before: after
`TRIPLE_S`, or when BV is too close to LV or further away than the fit range. The third vehicle ends within a second of
BV's lane change, as nothing is known of how it gives way.

Where vehicles differ, each has a hazard, a mean acceleration and a spread of its own, and each recording a hazard.
Measured positions and speeds are off by errors that a smoothing filter would leave: they change slowly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter1d

from harness.compiled import compiled_threads, unboxed
from harness.families.cut_in import laws
from harness.families.cut_in.lateral import draw_lead
from harness.families.cut_in.laws import AccelerationLaw, Environment, InitialStates
from harness.families.cut_in.vocabulary import State
from harness.files import write_atomically
from harness.random_stream import BV_DRAWS, EVENT, LV_DRAWS, uniform
from harness.vehicles.kinematics import STEP_S, next_position, next_speed
from harness.vocabulary import FloatArray, IntArray, RecordArray

TRIPLE_S, PAUSE_S = 20, 5
RECORDING_H = 0.5
"""Vehicle-hours of a recording."""
LANE_WIDTH_M = 3.4
"""Twice the distance to overlap of the shipped laws of the lead: the centre is at the marking then."""
CLOSING_MPS = -2.0, 10.0
BEHIND_M = 10.0, 120.0
LENGTH_M = 4.2, 5.2
LEAVES_AFTER = 9
"""Steps that the third vehicle is seen after BV's lane change."""
CLOSEST_M = 0.5
LV, BV, AV = range(3)


Arrays = tuple[Any, ...]


@dataclass(frozen=True)
class Differences:
    """Standard deviations of what vehicles, and recordings, have of their own, and of what is measured.

    Hazards and spreads of acceleration are multiplied by log-normal numbers of mean 1.
    """

    hazard: float = 0.3
    recording_hazard: float = 0.15
    acceleration_mps2: float = 0.05
    spread: float = 0.1
    position_m: float = 0.1
    speed_mps: float = 0.1
    smoothed_s: float = 2.0


ALIKE = Differences(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Vehicles that are alike, measured without error."""


def simulate(environment: Environment, hours: float, seed: int, differences: Differences = ALIKE) -> pd.DataFrame:
    """Trajectories of so many vehicle-hours (rounded up to whole triples) as a table for `harness fit`.

    One row per vehicle and 0.1 s; lateral positions are there if cut-ins of the environment take time.
    """
    n = math.ceil(hours * 3600.0 / (3 * TRIPLE_S))
    random = np.random.default_rng(seed)
    recording = np.arange(n) // round(RECORDING_H * 3600.0 / (3 * TRIPLE_S))
    of_recording = _mean_one(random, differences.recording_hazard, recording[-1] + 1)
    hazard = of_recording[recording] * _mean_one(random, differences.hazard, n)
    bias = differences.acceleration_mps2 * random.standard_normal((n, 3))
    spread = _mean_one(random, differences.spread, (n, 3))
    length = random.uniform(*LENGTH_M, (n, 3)).round(2)
    start = InitialStates(environment.numbers).from_uniforms(random.random((n, 5)))
    start["r2_m"], start["r2dot_mps"] = random.uniform(*BEHIND_M, n), -random.uniform(*CLOSING_MPS, n)

    n_steps = round(TRIPLE_S / STEP_S) - 1
    x, v = np.zeros((2, n, 3, n_steps + 1))
    cut, lead = np.full((2, n), -1)
    upto = np.zeros((n, 3), np.int64)
    drive(start, (length, bias, spread), hazard, seed, unboxed(environment), (x, v), (cut, lead, upto))
    seen, lateral = (recording, length, x, v, cut, upto), _lateral(cut, lead, environment, n_steps)
    return _table(seen, lateral, random, differences)


def _mean_one(random: np.random.Generator, log_sd: float, shape: int | tuple[int, ...]) -> FloatArray:
    return np.asarray(np.exp(log_sd * random.standard_normal(shape) - 0.5 * log_sd**2))


@compiled_threads
def drive(
    start: RecordArray, vehicles: Arrays, hazard: FloatArray, seed: int, environment: Environment,
    motion: Arrays, changes: Arrays,
) -> None:  # fmt: skip
    """Drive triples from initial states (n,): centres and speeds (n, 3, steps + 1).

    Lengths, biases and spreads of ``vehicles`` are (n, 3). ``changes`` receive the state in which BV is on the right
    first (n,), -1 for never, the steps from onset to it (n,), and the number of states of each vehicle (n, 3).
    """
    (length, bias, spread), (x, v), (cut, lead, upto) = vehicles, motion, changes
    n_steps, held = x.shape[2] - 1, round(1.0 / STEP_S)
    a = np.zeros(3)
    for i in range(start.size):
        v[i, BV, 0], x[i, BV, 0] = start[i].v_bv_mps, 0.0
        v[i, LV, 0] = max(start[i].v_bv_mps + start[i].r1dot_mps, 0.0)
        v[i, AV, 0] = max(start[i].v_bv_mps - start[i].r2dot_mps, 0.0)
        x[i, LV, 0] = start[i].r1_m + 0.5 * (length[i, LV] + length[i, BV])
        x[i, AV, 0] = -start[i].r2_m - 0.5 * (length[i, AV] + length[i, BV])
        clock = -math.log(1.0 - uniform(seed, i, EVENT, 0))
        cut[i], lead[i], upto[i, AV] = -1, 0, -1
        t = 0
        while True:
            r1 = x[i, LV, t] - x[i, BV, t] - 0.5 * (length[i, LV] + length[i, BV])
            r2 = x[i, BV, t] - x[i, AV, t] - 0.5 * (length[i, AV] + length[i, BV])
            if upto[i, AV] < 0 and cut[i] >= 0:
                beside = -(length[i, AV] + length[i, BV] + CLOSEST_M) < r2 < CLOSEST_M
                if beside or t > cut[i] + LEAVES_AFTER:
                    upto[i, AV] = t
            apart = CLOSEST_M < r1 < environment.numbers.fit_range__r1_max_m
            if t == n_steps or (cut[i] < 0 and not apart):
                break
            state = State(v[i, BV, t], r1, v[i, LV, t] - v[i, BV, t], r2, v[i, BV, t] - v[i, AV, t])
            if t % held == 0:
                for vehicle in range(3):
                    law = laws.free_driving(v[i, vehicle, t], environment)
                    if vehicle == BV and cut[i] < 0:
                        law = laws.car_following(state, environment)
                    mean, inverse_scale = law.mean + bias[i, vehicle], law.inverse_scale / spread[i, vehicle]
                    own = AccelerationLaw(law.noise, law.cap, mean, inverse_scale, law.brake_share)
                    u = uniform(seed, i, LV_DRAWS if vehicle == LV else BV_DRAWS, 4 * t + vehicle)
                    a[vehicle] = laws.acceleration(laws.draw_acceleration(u, own, environment))
            beside = -(length[i, AV] + length[i, BV]) < r2 <= 0.0
            if cut[i] < 0 and not beside:
                accepted = laws.acceptance(r2, state.r2dot_mps, environment) if r2 > 0.0 else 1.0
                wished = hazard[i] * laws.opportunity(state, environment)
                clock -= laws.cut_in_hazard(wished, accepted, environment)
                if clock < 0.0:
                    cut[i], lead[i] = t + 1, draw_lead(t, seed, i, environment.lateral)
            for vehicle in range(3):
                v[i, vehicle, t + 1] = next_speed(v[i, vehicle, t], a[vehicle])
                x[i, vehicle, t + 1] = next_position(x[i, vehicle, t], v[i, vehicle, t], v[i, vehicle, t + 1])
            t += 1
        upto[i, LV], upto[i, BV] = t + 1, t + 1
        if upto[i, AV] < 0:
            upto[i, AV] = t + 1


def _lateral(cut: IntArray, lead: IntArray, environment: Environment, n_steps: int) -> FloatArray | None:
    """BV's distance to the right edge (m), (n, steps + 1): at even speed to the middle of the other lane.

    It is at the marking half a step before the first state in which it is on the right.
    """
    if not environment.lateral.present:
        return None
    since_onset = np.arange(n_steps + 1) - (cut - 0.5 - lead)[:, None]
    moved = environment.lateral.distance_m * since_onset / np.maximum(lead, 1)[:, None]
    moved = np.where((cut >= 0)[:, None], np.clip(moved, 0.0, LANE_WIDTH_M), 0.0)
    return np.asarray(1.5 * LANE_WIDTH_M - moved)


def _table(
    of: Arrays, lateral: FloatArray | None, random: np.random.Generator, differences: Differences
) -> pd.DataFrame:
    recording, length, x, v, cut, upto = of
    n, n_states = len(x), x.shape[2]
    smoothed = differences.smoothed_s / STEP_S

    def measured(true: FloatArray, sd: float) -> FloatArray:
        if sd == 0.0:
            return true
        error = gaussian_filter1d(random.standard_normal(true.shape, np.float32), smoothed, mode="wrap")
        return np.asarray(true + error * (sd * math.sqrt(2.0 * smoothed * math.sqrt(math.pi))))

    seen = np.arange(n_states) < upto[:, :, None]
    in_recording = np.arange(n) - np.searchsorted(recording, recording)
    begins = in_recording * (TRIPLE_S + PAUSE_S)
    lane = np.zeros(x.shape, np.int8)
    lane[:, LV] = 1
    lane[:, BV] = (np.arange(n_states) < cut[:, None]) | (cut < 0)[:, None]
    vehicle = 3 * in_recording[:, None] + np.arange(3)
    columns = {
        "recording_id": np.broadcast_to(recording[:, None, None], x.shape),
        "vehicle_id": np.broadcast_to(vehicle[:, :, None], x.shape),
        "time_s": np.broadcast_to((begins[:, None] + np.arange(n_states) / 10.0)[:, None, :], x.shape),
        "s_m": measured(x, differences.position_m) + 200.0,
        "speed_mps": np.maximum(measured(v, differences.speed_mps), 0.0),
        "lane": lane,
        "length_m": np.broadcast_to(length[:, :, None], x.shape),
    }
    if lateral is not None:
        across = np.broadcast_to(np.array([1.5, 1.5, 0.5])[:, None] * LANE_WIDTH_M, x.shape).copy()
        across[:, BV] = lateral
        columns["lateral_m"] = measured(across, 0.3 * differences.position_m)
    table = pd.DataFrame({name: values[seen] for name, values in columns.items()})
    return table.round({"time_s": 1, "s_m": 3, "speed_mps": 3, "lateral_m": 3})


def write(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV or Parquet, as the path ends."""
    if path.suffix == ".csv":
        write_atomically(path, lambda temporary: table.to_csv(temporary, index=False))
    else:
        write_atomically(path, lambda temporary: table.to_parquet(temporary, index=False, compression="zstd"))
