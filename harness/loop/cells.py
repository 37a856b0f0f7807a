"""State of the K episodes that run side by side, and the buffers that a shard's results are written to.

Scalars of a cell are fields of one record, so that a kernel touches one cache line; what has a length is an array with
the cell as first axis. Results are written to row ``episode − first`` of the shard: finishing order leaves no trace.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from harness.controllers.protocol import BatchObservation
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.functions import Importance
from harness.families.cut_in.path import Trajectory, empty_trajectory, lengths
from harness.vocabulary import (
    N_ACCELERATIONS,
    STATE_COLUMNS,
    FloatArray,
    Int8Array,
    IntArray,
    RecordArray,
    UInt64Array,
)

_f8, _i8 = np.float64, np.int64

CELL_DTYPE = np.dtype(
    [
        ("row", _i8),  # row of the shard, -1: idle
        ("episode", _i8),  # index in the campaign
        ("announced_index", _i8),  # index that the AV is told, and that its random stream follows from
        ("motion_hash", np.uint64),  # hash of the AV's motion, through the step of the onset
        ("step", _i8),  # t, in steps
        ("cut_step", _i8),  # -1 before the cut-in
        ("planned", _i8),  # step in which BV will cut in, if that is known before; else -1
        ("lead", _i8),  # steps from the onset of its lateral motion to overlap
        ("onset_step", _i8),  # from the step after it on the AV may act; -1: nobody knows of an onset yet
        ("component", _i8),  # episode mixture: importance function drawn; shells: the shell; else -1
        ("lv_maneuver", _i8),
        ("bv_maneuver", _i8),
        ("n_lv", _i8),  # draws so far
        ("n_bv", _i8),  # car-following draws so far
        ("n_bv_free", _i8),  # free-driving draws so far
        ("n_path", _i8),  # entries of BV's path, the cut-in included
        ("n_control", _i8),
        ("clock", _f8),  # hazard accumulated by the sampler
        ("target", _f8),  # hazard at which BV cuts in
        ("hazard", _f8),  # hazard accumulated under p
        ("hazard_total", _f8),  # hazard of the whole path without cut-in (methods that draw the path ahead)
        ("log_p_cut_in", _f8),
        ("log_sampled", _f8),  # log q_sampled/p so far, of all but the episode mixture: see likelihood_ratio
        ("min_ttc", _f8),
        *((name, _f8) for name in ("cut_r2", "cut_r2dot", "onset_r2", "onset_r2dot", "av_start")),
        ("cruises", _i8),  # whether the AV still keeps its speed, whatever it asks for but to brake
        ("set_speed", _f8),  # at which the AV cruises
        ("took_over_step", _i8),  # first step in which it did what it asked for; -1: none yet
        ("asked_to_speed_up", _i8),  # whether it asked for that while it was held
        ("danger", _f8),  # what a built-in AV remembers beside its acceleration
    ]
)

_STEPS = (
    *("n_steps", "cut_in_step", "lead_steps", "onset_step", "took_over_step", "n_control_steps"),
    *("n_lv", "n_bv"),
)
_AT_CUT_IN = ("cut_in_r2_m", "cut_in_r2dot_mps", "onset_r2_m", "onset_r2dot_mps")
_AT_END = ("crash_time_s", "impact_speed_mps", "min_ttc_s", "av_distance_m", "log_weight", "log_p_cut_in")
EPISODE_DTYPE = np.dtype(
    [(name, np.int8) for name in ("outcome", "component", "asked_to_speed_up")]
    + [(name, np.int16) for name in _STEPS]
    + [(name, _f8) for name in (*_AT_CUT_IN, *_AT_END)]
)

MOMENT_DTYPE = np.dtype(
    [("row", _i8), ("step", np.int16), ("maneuver", np.int8)]
    + [(name, _f8) for name in (*STATE_COLUMNS, "p", "q_sampled")]
)


class Cells(NamedTuple):
    """The K running episodes.

    ``cell`` (K,) are `CELL_DTYPE` records. ``log_ratio`` (K, M) is L_j, ``martingale`` (K, J). ``cut_challenge`` and
    ``stay_challenge`` (K, hold, J) look ahead to the end of the hold period. ``lv_path``, ``bv_path`` (K, draws) hold
    maneuver indices. ``acceleration`` and ``speed`` (K, 3) are the commands for the coming step, ``cut_in`` (K,) says
    whose BV changes lanes in it. ``trace`` (K, steps + 1, 3 vehicles, 3: x, v, a) is (K, 1, 3, 3) when not kept.
    ``placed`` (K,) begins with the cells that have been refilled for the coming step, ``ended`` and ``ended_row`` (K,)
    with those whose episode has ended, and its row.
    """

    cell: RecordArray
    log_ratio: FloatArray
    martingale: FloatArray
    cut_challenge: FloatArray
    stay_challenge: FloatArray
    lv_path: Int8Array
    bv_path: Int8Array
    acceleration: FloatArray
    speed: FloatArray
    cut_in: Int8Array
    trace: FloatArray
    placed: IntArray
    ended: IntArray
    ended_row: IntArray


def idle_cells(n_cells: int, environment: Environment, importance: Importance, *, keep_traces: bool) -> Cells:
    """K cells without an episode."""
    max_steps, hold_steps, draws = lengths(environment)
    cell, n_surrogates = np.zeros(n_cells, CELL_DTYPE), importance.n_surrogates
    cell["row"] = -1
    log_ratio, martingale = np.zeros((n_cells, importance.alpha.size)), np.zeros((n_cells, n_surrogates))
    cutting, staying = np.zeros((2, n_cells, hold_steps, n_surrogates))
    lv_path, bv_path = np.zeros((2, n_cells, draws), np.int8)
    acceleration, speed = np.zeros((2, n_cells, 3))
    trace = np.full((n_cells, max_steps + 1 if keep_traces else 1, 3, 3), np.nan)
    placed, ended, ended_row = np.zeros((3, n_cells), np.int64)
    drawn = cell, log_ratio, martingale, cutting, staying, lv_path, bv_path
    return Cells(*drawn, acceleration, speed, np.zeros(n_cells, np.int8), trace, placed, ended, ended_row)


class Results(NamedTuple):
    """Rows of a shard: ``episode`` (n,) `EPISODE_DTYPE`, and what has a length beside it.

    ``moment`` (capacity,) `MOMENT_DTYPE` with ``moment_q``, ``moment_v`` (capacity, J); ``moment_count`` (1,) says how
    many are used and ``moment_limit`` how many are kept of each episode.
    """

    episode: RecordArray
    log_q: FloatArray
    martingale: FloatArray
    lv_path: Int8Array
    bv_path: Int8Array
    moment: RecordArray
    moment_q: FloatArray
    moment_v: FloatArray
    moment_count: IntArray
    moment_limit: int


def empty_results(
    n_episodes: int, environment: Environment, importance: Importance, *, moment_limit: int, capacity: int
) -> Results:
    """Buffers for a shard of ``n_episodes`` with room for ``capacity`` control steps."""
    draws, n_surrogates = lengths(environment)[2], importance.n_surrogates
    episode, log_q = np.zeros(n_episodes, EPISODE_DTYPE), np.zeros((n_episodes, importance.alpha.size))
    lv_path, bv_path = np.zeros((2, n_episodes, draws), np.int8)
    tests = episode, log_q, np.zeros((n_episodes, n_surrogates)), lv_path, bv_path
    q, v = np.zeros((2, capacity, n_surrogates))
    return Results(*tests, np.zeros(capacity, MOMENT_DTYPE), q, v, np.zeros(1, np.int64), moment_limit)


def with_more_room(results: Results) -> Results:
    """The same results with room for twice as many control steps."""
    old = results.moment, results.moment_q, results.moment_v
    moment, moment_q, moment_v = (np.concatenate([each, np.zeros_like(each)]) for each in old)
    return results._replace(moment=moment, moment_q=moment_q, moment_v=moment_v)


class PrescribedTraffic(NamedTuple):
    """Episodes whose traffic is prescribed: what LV and BV do in each row of a shard; no rows if it is drawn.

    ``lv``, ``bv`` (rows, draws) int8 are maneuver indices as an episode records them, 31 in ``bv`` being the cut-in in
    step ``cut_step`` (rows,), which is -1 for a run without a cut-in, and in which BV begins to move sideways ``lead``
    (rows,) steps earlier. ``stratum`` (rows,) is a shell, or all that lie outside, and ``log_weight`` (rows,) its log
    probability. ``announced_index`` (rows,) are the indices that AVs are told, ``motion_hash`` (rows,) of what they
    must have done when the step of the onset is over: those of their baseline runs. Both are empty where an AV keeps
    its speed until then.
    """

    lv: Int8Array
    bv: Int8Array
    cut_step: IntArray
    stratum: IntArray
    log_weight: FloatArray
    announced_index: IntArray
    motion_hash: UInt64Array
    lead: IntArray


class PrescribedCutIns(NamedTuple):
    """Which cut-ins of a pool tests prescribe, and what the error of the pool is told by.

    ``row`` (n,) is the row in the pool, ``cell`` (n,) the cell of the campaign's design, ``cell_mass`` (n, C) the
    path's probability of a cut-in of each cell. Of vehicles that act before the cut-in ``shadow`` (n,) is the baseline
    run, and ``mass`` (n,) the probability of the cut-in itself; else empty.
    """

    row: IntArray
    cell: IntArray
    cell_mass: FloatArray
    shadow: IntArray
    mass: FloatArray


def drawn_traffic() -> PrescribedTraffic:
    """For episodes that draw their own traffic."""
    none, no_index = np.zeros((0, 1), np.int8), np.zeros(0, np.int64)
    return PrescribedTraffic(none, none, no_index, no_index, np.zeros(0), no_index, np.zeros(0, np.uint64), no_index)


class Scratch(NamedTuple):
    """Room for what a kernel works out at one moment of one cell; kernels allocate nothing.

    ``p`` (31,): exposure of the accelerations. ``q`` (J,) and ``q_acceleration`` (J, 31): importance functions;
    ``challenge`` (J,): V_j. ``ratio`` (M,): q_j/p of the maneuver taken; ``path``: what lies ahead of an episode.
    """

    p: FloatArray
    q: FloatArray
    q_acceleration: FloatArray
    challenge: FloatArray
    ratio: FloatArray
    path: Trajectory


def empty_scratch(environment: Environment, importance: Importance) -> Scratch:
    """Room for M importance functions and J surrogates."""
    n_importance, n_surrogates = importance.alpha.size, importance.n_surrogates
    return Scratch(
        p=np.zeros(N_ACCELERATIONS),
        q=np.zeros(n_surrogates),
        q_acceleration=np.zeros((n_surrogates, N_ACCELERATIONS)),
        challenge=np.zeros(n_surrogates),
        ratio=np.zeros(n_importance),
        path=empty_trajectory(environment),
    )


class KernelState(NamedTuple):
    """All that the episodes of a shard are run with, and written to.

    ``first_episode`` is the campaign index of row 0, ``states`` (rows,) are initial states. ``x``, ``v`` (K, 3) are the
    world's positions (m) and speeds (m/s) of LV, BV, AV. ``driver`` is (1,) for a built-in AV, else (0,). ``passed_m``
    is the R2 at which the AV has passed. ``asks_controller`` says whether one outside of the kernels decides for the
    AV: ``observation`` is what it sees, ``acts_before_cut_in`` whether from the start; else from the step after the
    onset. ``av_cruises`` says whether the AV then keeps its speed until it first asks to brake, or BV is on its lane.
    What may be so or not is 0 or 1.
    """

    seed: int
    first_episode: int
    states: RecordArray
    traffic: PrescribedTraffic
    x: FloatArray
    v: FloatArray
    cells: Cells
    results: Results
    scratch: Scratch
    environment: Environment
    importance: Importance
    driver: RecordArray
    passed_m: float
    keep_traces: int
    asks_controller: int
    observation: BatchObservation
    acts_before_cut_in: int
    av_cruises: int
