"""What NADE keeps of the K tests that run side by side, and of those that are over.

Beside the loop's own `harness.loop.cells`, from whose records it takes a cell's row and step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.functions import Importance
from harness.families.cut_in.path import Trajectory, empty_trajectory, lengths
from harness.vocabulary import N_ACCELERATIONS, STATE_COLUMNS, FloatArray, Int8Array, IntArray, RecordArray

_f8, _i8 = np.float64, np.int64

CELL_DTYPE = np.dtype(
    [
        ("lv_maneuver", _i8),
        ("bv_maneuver", _i8),
        ("n_lv", _i8),  # draws so far
        ("n_bv", _i8),  # car-following draws so far
        ("n_bv_free", _i8),  # free-driving draws so far
        ("n_path", _i8),  # entries of BV's path, the cut-in included
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
"""Of a test, for which a shard has room at first; more is made where they are more."""


class Draws(NamedTuple):
    """What is drawn in the K running tests.

    ``cell`` (K,) are `CELL_DTYPE` records. ``log_ratio`` (K, M) is L_j, ``martingale`` (K, J). ``cut_challenge`` and
    ``stay_challenge`` (K, hold, J) look ahead to the end of the hold period. ``lv_path``, ``bv_path`` (K, draws) hold
    maneuver indices.
    """

    cell: RecordArray
    log_ratio: FloatArray
    martingale: FloatArray
    cut_challenge: FloatArray
    stay_challenge: FloatArray
    lv_path: Int8Array
    bv_path: Int8Array


def empty_draws(n_cells: int, environment: Environment, importance: Importance) -> Draws:
    """Room for K tests."""
    _, hold_steps, draws = lengths(environment)
    log_ratio, martingale = np.zeros((n_cells, importance.alpha.size)), np.zeros((n_cells, importance.n_surrogates))
    cutting, staying = np.zeros((2, n_cells, hold_steps, importance.n_surrogates))
    lv_path, bv_path = np.zeros((2, n_cells, draws), np.int8)
    return Draws(np.zeros(n_cells, CELL_DTYPE), log_ratio, martingale, cutting, staying, lv_path, bv_path)


class Drawn(NamedTuple):
    """What was drawn in the tests (n,) of a shard.

    ``n_lv``, ``n_bv`` (n,) are the lengths of ``lv_path``, ``bv_path`` (n, draws). ``moment`` (capacity,)
    `MOMENT_DTYPE` with ``moment_q``, ``moment_v`` (capacity, J) are control steps; ``moment_count`` (1,) says how many
    are used and ``moment_limit`` how many are kept of each test.
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


def nothing_drawn(
    n: int, environment: Environment, importance: Importance, *, moment_limit: int, capacity: int
) -> Drawn:
    """Room for ``n`` tests and ``capacity`` control steps."""
    draws, n_surrogates = lengths(environment)[2], importance.n_surrogates
    lv_path, bv_path = np.zeros((2, n, draws), np.int8)
    log_q, martingale = np.zeros((n, importance.alpha.size)), np.zeros((n, n_surrogates))
    q, v = np.zeros((2, capacity, n_surrogates))
    of_moments = np.zeros(capacity, MOMENT_DTYPE), q, v, np.zeros(1, np.int64), moment_limit
    return Drawn(np.zeros(n, np.int64), np.zeros(n, np.int64), log_q, martingale, lv_path, bv_path, *of_moments)


def with_more_room(drawn: Drawn) -> Drawn:
    """The same with room for twice as many control steps."""
    old = drawn.moment, drawn.moment_q, drawn.moment_v
    moment, moment_q, moment_v = (np.concatenate([each, np.zeros_like(each)]) for each in old)
    return drawn._replace(moment=moment, moment_q=moment_q, moment_v=moment_v)


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


def empty_scratch(environment: Environment, importance: Importance) -> Scratch:
    """Room for M importance functions and J surrogates."""
    n_surrogates = importance.n_surrogates
    q, challenge = np.zeros((2, n_surrogates))
    q_acceleration, ratio = np.zeros((n_surrogates, N_ACCELERATIONS)), np.zeros(importance.alpha.size)
    return Scratch(np.zeros(N_ACCELERATIONS), q, q_acceleration, challenge, ratio, empty_trajectory(environment))


class Nade(NamedTuple):
    """All that NADE's kernels need beside the loop's; ``states`` (n,) are the initial states of a shard's tests."""

    states: RecordArray
    draws: Draws
    drawn: Drawn
    scratch: Scratch
    environment: Environment
    importance: Importance
