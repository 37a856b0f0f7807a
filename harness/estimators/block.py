"""The estimators' only input: a block of consecutive episodes as plain arrays.

A block is what a shard of records says about weights and outcomes, and nothing else. Exact Markov chains (in the
tests), the twin and SUMO all end here, so that an estimator cannot tell them apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.strata import ShellDesign
from harness.vocabulary import SAMPLING, BoolArray, FloatArray, IntArray, Method

MAX_CONTROL_STEPS = 9
"""Control steps that sparse control variates are built from, at most ([paper] section VI-E)."""


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive episodes ``first_episode … first_episode + n - 1``, in index order.

    Attributes
    ----------
    method : str
        How the episodes were drawn.
    crash, failed, cut_in, bv_lv_contact : (n,) bool
        Outcomes. A failed episode is a row like any other and never a crash.
    log_weight : (n,) float64
        log p(x_c) - log q_sampled(x_c); exactly 0 without control.
    log_q : (n, M) float64
        Per importance function, the sum over control steps of log(q_j/p); -inf where q_j cannot draw the episode.
    alpha : (M,) float64
        Mixture weights of the importance functions.
    n_control_steps : (n,) int
        Stratum l of each episode.
    first_ratios : (n, 9, J) float64 or None
        q_j(a_t|s_t)/q_alpha(a_t|s_t) of the first nine control steps, 1 beyond the last one; None when the campaign
        kept no moments.
    weight_cap : float or None
        Bound on Y = 1{crash}·weight that the design guarantees for every episode, seen or not; None if there is none.
    log_p_cut_in : (n,) float64 or None
        log P(cut-in | path), where the method draws the path ahead. Bounds Y of that episode alone.
    stratum, cell, cell_mass, shells : (n,) int, (n,) int, (n, C) float64, ShellDesign, or None
        Where tests are drawn from shells: stratum and cell of each, its path's probability of a cut-in of each cell,
        and what is known of the strata.
    ahead : (n,) bool or None
        Whether the vehicle was ever ahead of the boundary that a statement checks; None where none is.
    """

    first_episode: int
    method: Method
    crash: BoolArray
    failed: BoolArray
    cut_in: BoolArray
    bv_lv_contact: BoolArray
    log_weight: FloatArray
    log_q: FloatArray
    alpha: FloatArray
    n_control_steps: IntArray
    first_ratios: FloatArray | None = None
    weight_cap: float | None = None
    log_p_cut_in: FloatArray | None = None
    stratum: IntArray | None = None
    cell: IntArray | None = None
    cell_mass: FloatArray | None = None
    shells: ShellDesign | None = None
    ahead: BoolArray | None = None

    def __post_init__(self) -> None:
        n = len(self.crash)
        wide = {
            "log_q": (n, len(self.alpha)),
            "first_ratios": (n, MAX_CONTROL_STEPS, None),
            "cell_mass": (n, None),
        }
        for name, array in columns_of(self).items():
            if not _fits(array.shape, expected := wide.get(name, (n,))):
                raise ValueError(f"Block.{name} has shape {array.shape}, expected {expected}")
        if np.any(self.crash & self.failed):
            raise ValueError("Block: an episode is both crashed and failed")
        if np.isnan(self.log_weight).any():
            raise ValueError("Block.log_weight has NaN entries")

    def __len__(self) -> int:
        return len(self.crash)

    def weights(self) -> FloatArray:
        """Likelihood ratios p/q_sampled, shape (n,); infinite where they overflow."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_weight)

    def weighted_crashes(self) -> FloatArray:
        """Y = 1{crash}·weight, shape (n,)."""
        y = np.zeros(len(self))
        y[self.crash] = np.exp(self.log_weight[self.crash])
        return y

    def mixture_ratios(self) -> FloatArray:
        """q_j(x_c)/q_sampled(x_c) over whole episodes, shape (n, M); 0 where q_j cannot draw the episode."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_q + self.log_weight[:, None])

    @property
    def forced_share(self) -> float:
        """Share of forced cut-ins among what the method draws from."""
        sampling = SAMPLING[self.method]
        if not sampling.forces:
            return 0.0
        return float(self.alpha[0]) if sampling.mixes else 1.0  # the defensive component is the first

    def log_path_cap(self) -> float:
        """Log of the largest P(cut-in | path)/share of forced cut-ins, a bound on Y of these paths; inf if unknown."""
        if self.log_p_cut_in is None or not (share := self.forced_share):
            return math.inf
        return float(np.max(self.log_p_cut_in, initial=-math.inf)) - math.log(share)

    def failed_as_crashes(self) -> Block:
        """The same episodes had every failed one crashed, each with the weight that it has on record.

        That is the weight up to the step in which it failed. The step depends on nothing that comes after it, so that
        the mean of these weights is the probability to fail, whatever the episodes were drawn by.
        """
        if not self.failed.any():
            return self
        return _unchecked(self, crash=self.crash | self.failed, failed=np.zeros_like(self.failed))

    def take(self, rows: slice) -> Block:
        """Cut out the block of some consecutive rows, a slice with step 1."""
        start, stop, step = rows.indices(len(self))
        if step != 1:
            raise ValueError("a block holds consecutive episodes: the slice must have step 1")
        if (start, stop) == (0, len(self)):
            return self
        columns: dict[str, Any] = {name: column[start:stop] for name, column in columns_of(self).items()}
        return _unchecked(self, first_episode=self.first_episode + start, **columns)


def joined(blocks: Sequence[Block]) -> Block:
    """One block of consecutive ones of the same campaign."""
    if len(blocks) == 1:
        return blocks[0]
    parts = [columns_of(block) for block in blocks]
    return _unchecked(blocks[0], **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def columns_of(block: Block) -> dict[str, NDArray[Any]]:
    """All arrays that have a row for each test."""
    return {name: array for name, array in vars(block).items() if isinstance(array, np.ndarray) and name != "alpha"}


def _unchecked(block: Block, **columns: Any) -> Block:
    """The block with other columns; checking them again takes longer than all the rest."""
    other = copy(block)
    vars(other).update(columns)
    return other


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(n in (size, None) for size, n in zip(shape, expected, strict=True))
