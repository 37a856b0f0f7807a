"""What AV controllers outside of the kernels see, and the end of episodes whose controller failed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harness.arrays import FloatArray, IntArray, read_only
from harness.compiled import compiled
from harness.controllers.protocol import BatchObservation
from harness.episode.cells import Bench
from harness.episode.record import end_episode
from harness.outcomes import AV, BV, FAILED, LV
from harness.vehicles.kinematics import STEP_S, gap


def empty_observation(n_cells: int) -> BatchObservation:
    """Room for the observations of K cells: rows of one array of whole numbers and of one of floats."""
    return _rows(np.zeros((3, n_cells), np.int64), np.zeros((10, n_cells)))


def _rows(whole: IntArray, real: FloatArray) -> BatchObservation:
    cell, episode, bv_lane = whole
    return BatchObservation._make([cell, episode, *real[:8], bv_lane, *real[8:]])


def first(observation: BatchObservation, n: int) -> BatchObservation:
    """The first ``n`` entries of every array, as copies that a controller may keep, and that nobody can write into."""
    whole: Any = observation.cell.base
    real: Any = observation.time_s.base
    return _rows(read_only(whole[:, :n].copy()), read_only(real[:, :n].copy()))


@compiled
def observe(bench: Bench) -> int:
    """Write what the AVs that are to act see to ``bench.observation``; returns their number."""
    x, v, cells, out = bench.x, bench.v, bench.cells, bench.observation
    n = 0
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        followed = 0 <= cell.cut_step < cell.step
        if cell.row < 0 or not (followed or bench.acts_before_cut_in):
            continue
        out.cell[n], out.episode[n], out.time_s[n] = k, cell.episode, cell.step * STEP_S
        out.position_m[n], out.speed_mps[n] = x[k, AV], v[k, AV]
        out.acceleration_mps2[n] = cells.acceleration[k, AV]
        out.gap_m[n] = gap(x[k, BV], x[k, AV]) if followed else math.inf
        out.lead_speed_mps[n] = v[k, BV] if followed else math.nan
        out.bv_position_m[n], out.bv_speed_mps[n] = x[k, BV], v[k, BV]
        out.bv_lane[n] = 0 if followed else 1
        out.lv_position_m[n], out.lv_speed_mps[n] = x[k, LV], v[k, LV]
        n += 1
    return n


@compiled
def fail(bench: Bench, failed: IntArray) -> None:
    """End the episodes of the given cells as failed, with the weight they have so far."""
    for n in range(failed.size):
        end_episode(failed[n], FAILED, n, bench)
