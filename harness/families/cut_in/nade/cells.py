"""State of NADE: of the K tests that run side by side, and of those that are over.

The loop's own state is in `harness.loop.cells`; from its records come a cell's row and step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.functions import Importance
from harness.families.cut_in.path import Trajectory, empty_trajectory, lengths
from harness.families.cut_in.vocabulary import N_ACCELERATIONS, STATE_COLUMNS
from harness.vocabulary import FloatArray, Int8Array, IntArray, RecordArray

_f8, _i8 = np.float64, np.int64

CELL_DTYPE = np.dtype(
    [
        ("lv_maneuver", _i8),
        ("bv_maneuver", _i8),
        ("clock", _f8),  # hazard accumulated by the sampler
        ("target", _f8),  # hazard at which BV cuts in
        ("hazard", _f8),  # hazard accumulated under p
        ("hazard_total", _f8),  # hazard of the whole path without cut-in, where a cut-in may be forced
        ("log_sampled", _f8),  # log q_sampled/p so far, of all but the episode mixture: see likelihood_ratio
    ]
)

MOMENT_DTYPE = np.dtype(
    [("row", _i8), ("step", np.int16), ("maneuver", np.int8)]
    + [(name, _f8) for name in (*STATE_COLUMNS, "p", "q_sampled")]
)
CONTROL_STEPS = 16
"""Control steps of a test for which a shard has room at first; it is doubled when it is used up."""


class Drawn(NamedTuple):
    """What has been drawn in the tests (n,) of a shard.

    ``n_lv``, ``n_bv`` (n,) are the lengths of ``lv_path``, ``bv_path`` (n, draws), which hold maneuver indices.
    ``log_q`` (n, M) is L_j, ``martingale`` (n, J). ``moment`` (capacity,) `MOMENT_DTYPE` with ``moment_q``,
    ``moment_v`` (capacity, J) are control steps; ``moment_count`` (1,) says how many are used and ``moment_limit`` how
    many are kept of each test.
    """

    n_lv: IntArray
    n_bv: IntArray
    log_q: FloatArray
    martingale: FloatArray
    lv_path: Int8Array
    bv_path: Int8Array
    moment: RecordArray
    moment_q: FloatArray
    moment_v: FloatArray
    moment_count: IntArray
    moment_limit: int


class Scratch(NamedTuple):
    """Room for what a kernel works out at one moment of one cell; kernels allocate nothing.

    ``p`` (31,): exposure of the accelerations. ``q`` (J,) and ``q_acceleration`` (J, 31): importance functions;
    ``challenge`` (J,): V_j. ``ratio`` (M,): q_j/p of the maneuver taken; ``path``: what lies ahead of a test.
    """

    p: FloatArray
    q: FloatArray
    q_acceleration: FloatArray
    challenge: FloatArray
    ratio: FloatArray
    path: Trajectory


class NadeKernel(NamedTuple):
    """All that NADE's kernels need beside the loop's.

    ``states`` (n,) are the initial states of a shard's tests, ``cell`` (K,) `CELL_DTYPE` records of those that run, for
    which ``cut_challenge`` and ``stay_challenge`` (K, hold, J) look ahead to the end of the hold period.
    """

    states: RecordArray
    cell: RecordArray
    cut_challenge: FloatArray
    stay_challenge: FloatArray
    drawn: Drawn
    scratch: Scratch
    environment: Environment
    importance: Importance


def empty_nade(
    states: RecordArray, n_cells: int, environment: Environment, importance: Importance, moment_limit: int
) -> NadeKernel:
    """Room for the tests (n,) that begin in ``states``, of which K run side by side."""
    n, n_surrogates, n_functions = len(states), importance.n_surrogates, importance.alpha.size
    capacity = CONTROL_STEPS * n + n_cells
    _, hold_steps, n_draws = lengths(environment)
    n_lv, n_bv = np.zeros((2, n), np.int64)
    lv_path, bv_path = np.zeros((2, n, n_draws), np.int8)
    moment_q, moment_v = np.zeros((2, capacity, n_surrogates))
    log_q, martingale = np.zeros((n, n_functions)), np.zeros((n, n_surrogates))
    moments = np.zeros(capacity, MOMENT_DTYPE), moment_q, moment_v, np.zeros(1, np.int64), moment_limit
    drawn = Drawn(n_lv, n_bv, log_q, martingale, lv_path, bv_path, *moments)
    q, challenge = np.zeros((2, n_surrogates))
    p, ratio = np.zeros(N_ACCELERATIONS), np.zeros(n_functions)
    q_acceleration = np.zeros((n_surrogates, N_ACCELERATIONS))
    scratch = Scratch(p, q, q_acceleration, challenge, ratio, empty_trajectory(environment))
    cells = np.zeros(n_cells, CELL_DTYPE)
    cut_challenge, stay_challenge = np.zeros((2, n_cells, hold_steps, n_surrogates))
    return NadeKernel(states, cells, cut_challenge, stay_challenge, drawn, scratch, environment, importance)


def with_more_room(drawn: Drawn) -> Drawn:
    """The same with room for twice as many control steps."""
    arrays = drawn.moment, drawn.moment_q, drawn.moment_v
    moment, moment_q, moment_v = (np.concatenate([array, np.zeros_like(array)]) for array in arrays)
    return drawn._replace(moment=moment, moment_q=moment_q, moment_v=moment_v)
