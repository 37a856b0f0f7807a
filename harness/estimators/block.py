"""The estimators' only input: a block of consecutive episodes as plain arrays.

A block is what a shard of records says about weights and outcomes, and nothing else. Exact Markov chains (in the
tests), the twin and SUMO all end here, so that an estimator cannot tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray
from harness.methods import Method
from harness.strata import KnownRates, ShellDesign

MAX_CONTROL_STEPS = 9
"""Control steps that sparse control variates are built from, at most ([paper] section VI-E)."""


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive episodes ``first_episode … first_episode + n - 1``, in index order.

    Attributes
    ----------
    first_episode : int
        Index of the first row.
    method : {"nde", "forced", "step_mixture", "episode_mixture"}
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
    component : (n,) int or None
        Stratum of each test, where they are drawn from shells.
    shells : ShellDesign or None
        Those strata and their probabilities.
    surrogates_crash : (n, D) bool or None
        Which surrogates of a pool would have crashed on the same traffic; only where it was asked for.
    known_rates : KnownRates or None
        Their crash rates.
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
    component: IntArray | None = None
    shells: ShellDesign | None = None
    surrogates_crash: BoolArray | None = None
    known_rates: KnownRates | None = None

    def __post_init__(self) -> None:
        n = len(self.crash)
        expected = {
            "failed": (n,),
            "cut_in": (n,),
            "bv_lv_contact": (n,),
            "log_weight": (n,),
            "log_q": (n, len(self.alpha)),
            "n_control_steps": (n,),
            "log_p_cut_in": (n,),
            "component": (n,),
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"Block.{name} has shape {array.shape}, expected {shape}")
        if self.first_ratios is not None and self.first_ratios.shape[:2] != (n, MAX_CONTROL_STEPS):
            raise ValueError(f"Block.first_ratios has shape {self.first_ratios.shape}, expected ({n}, 9, J)")
        if self.surrogates_crash is not None and self.surrogates_crash.shape[:1] != (n,):
            raise ValueError(f"Block.surrogates_crash has shape {self.surrogates_crash.shape}, expected ({n}, D)")
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

    def failed_as_crashes(self) -> Block:
        """The same episodes had every failed one crashed, each with the weight that it has on record.

        That is the weight up to the step in which it failed. The step depends on nothing that comes after it, so that
        the mean of these weights is the probability to fail, whatever the episodes were drawn by.
        """
        return replace(self, crash=self.crash | self.failed, failed=np.zeros_like(self.failed))

    def mixture_ratios(self) -> FloatArray:
        """q_j(x_c)/q_sampled(x_c) over whole episodes, shape (n, M); 0 where q_j cannot draw the episode."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_q + self.log_weight[:, None])

    def take(self, rows: slice) -> Block:
        """Cut out the block of some consecutive rows.

        Parameters
        ----------
        rows : slice
            With step 1.
        """
        start, stop, step = rows.indices(len(self))
        if step != 1:
            raise ValueError("a block holds consecutive episodes: the slice must have step 1")
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, value in values.items():
            if name != "alpha" and isinstance(value, np.ndarray):
                values[name] = value[start:stop]
        return Block(**{**values, "first_episode": self.first_episode + start})
