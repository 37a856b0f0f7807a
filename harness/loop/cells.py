"""State of the K tests that run side by side, and the buffers that a shard's results are written to.

Scalars of a cell are fields of one record, so that a kernel touches one cache line; the rest are arrays with the cell
as first axis. Results are written to row ``episode − first`` of the shard, whatever the order in which tests end.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.controllers.protocol import BatchObservation
from harness.families.script import Script
from harness.vocabulary import FloatArray, Int8Array, IntArray, RecordArray

_f8, _i8 = np.float64, np.int64

CELL_DTYPE = np.dtype(
    [
        ("row", _i8),  # row of the shard, -1: idle
        ("episode", _i8),  # index in the campaign
        ("announced_index", _i8),  # index that the AV is told, and that its random stream follows from
        ("motion_hash", np.uint64),  # hash of the AV's motion, through the step of the onset
        ("step", _i8),  # t, in steps
        ("event_step", _i8),  # step of the event, -1 before it
        ("planned", _i8),  # step in which the event will be, if that is known before; else -1
        ("lead", _i8),  # steps from the onset to the event
        ("onset_step", _i8),  # -1: nobody knows of an onset yet
        ("acts_from", _i8),  # first step in which the AV may act
        ("cruises", _i8),  # whether the AV still keeps its speed, unless it asks to brake
        ("set_speed", _f8),  # speed at which the AV cruises
        ("av_speed", _f8),  # of the AV before the step
        ("danger", _f8),  # a built-in AV's memory beside its acceleration
    ]
)

_STEPS = "n_steps", "event_step", "lead_steps", "onset_step", "took_over_step", "braked_step", "n_control_steps"
_AT_EVENT = "event_gap_m", "event_rate_mps", "onset_gap_m", "onset_rate_mps"
_AT_END = "crash_time_s", "impact_speed_mps", "min_ttc_s", "end_ttc_s", "hardest_braking_mps2", "av_distance_m"
_DRAWN = "log_weight", "log_p_event"
EPISODE_DTYPE = np.dtype(
    [(name, np.int8) for name in ("outcome", "component", "asked_to_speed_up", "braked_before", "fell_behind")]
    + [(name, np.int16) for name in _STEPS]
    + [(name, _f8) for name in (*_AT_EVENT, *_AT_END, *_DRAWN)]
)
"""Result of a test. ``component`` is the stratum or importance function that it was drawn from, -1 for none;
``took_over_step`` the first in which the AV did what it asked for, ``braked_step`` that after the onset in which it
braked by `BRAKED_MPS2`, -1 for none; ``asked_to_speed_up`` whether it asked to speed up while its speed was held;
``braked_before`` whether it asked to brake at the end of its warm-up; ``fell_behind`` whether it was more than
`FAR_BEHIND_S` behind the vehicle ahead when the event began."""
BRAKED_MPS2 = 1.0
"""Who never brakes so hard, in many tests, seems not to see the other vehicle [assumed]."""
FAR_BEHIND_S = 5.0
"""Headway beyond which the AV no longer follows the vehicle ahead [assumed]."""


class Cells(NamedTuple):
    """The K running tests, of V vehicles each, the AV last.

    ``cell`` (K,) are `CELL_DTYPE` records. ``speed`` (K, V) and ``lane`` (K, V) are the commands for the coming step,
    ``lane_before`` (K, V) the lanes before it, ``acceleration`` (K,) the AV's. ``trace`` (K, steps + 1, V, 4: x, v,
    acceleration, lane) is (K, 1, V, 4) when not kept. ``placed`` (K,) begins with the cells that were refilled for the
    coming step; ``ended`` and ``ended_row`` (K,) begin with the cells whose test has ended, and its row.
    """

    cell: RecordArray
    acceleration: FloatArray
    speed: FloatArray
    lane: Int8Array
    lane_before: Int8Array
    trace: FloatArray
    placed: IntArray
    ended: IntArray
    ended_row: IntArray


def idle_cells(n_cells: int, n_vehicles: int, max_steps: int, *, keep_traces: bool) -> Cells:
    """K cells without a test."""
    cell = np.zeros(n_cells, CELL_DTYPE)
    cell["row"] = -1
    lane, lane_before = np.zeros((2, n_cells, n_vehicles), np.int8)
    trace = np.full((n_cells, max_steps + 1 if keep_traces else 1, n_vehicles, 4), math.nan)
    placed, ended, ended_row = np.zeros((3, n_cells), np.int64)
    speed = np.zeros((n_cells, n_vehicles))
    return Cells(cell, np.zeros(n_cells), speed, lane, lane_before, trace, placed, ended, ended_row)


class PrescribedEvents(NamedTuple):
    """Events of a pool that tests prescribe, and what estimates of the pool's own error need.

    ``row`` (n,) is the row in the pool, ``cell`` (n,) the cell of the campaign's design, ``cell_mass`` (n, C) the
    path's probability of an event of each cell. Of vehicles that act before the event ``shadow`` (n,) is the baseline
    run, and ``mass`` (n,) the probability of the events that it stands for; else empty.
    """

    row: IntArray
    cell: IntArray
    cell_mass: FloatArray
    shadow: IntArray
    mass: FloatArray


class KernelState(NamedTuple):
    """What the tests of a shard are run with, and written to; truth values are 0 or 1.

    ``first_episode`` is the campaign index of row 0. ``x``, ``v`` (K, V) are the world's positions (m) and speeds
    (m/s). ``episode`` (n,) are the results, `EPISODE_DTYPE`. ``principal`` is the place of the vehicle that the event
    is about, ``ahead`` that of the one ahead of it, -1 without one; ``sideways_m`` is the way from its first lateral
    motion to overlap. ``driver`` is (1,) for a built-in AV, else (0,). ``observation`` is what a controller outside of
    the kernels sees; ``acts_early`` is whether the AV acts from the start, whatever the script says. If it does not,
    ``av_cruises`` is whether it keeps its speed until it first asks to brake, or somebody is ahead on its lane.
    """

    seed: int
    first_episode: int
    script: Script
    x: FloatArray
    v: FloatArray
    cells: Cells
    episode: RecordArray
    principal: int
    ahead: int
    sideways_m: float
    driver: RecordArray
    keep_traces: int
    observation: BatchObservation
    acts_early: int
    av_cruises: int
