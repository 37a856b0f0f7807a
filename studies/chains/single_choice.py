"""One control step that decides everything: the world of Theorem 3, where step and episode mixture are the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.estimators.block import Block, Drawn
from harness.vocabulary import CRASH, TIMEOUT, BoolArray, FloatArray, IntArray, Method


@dataclass(frozen=True, eq=False)
class SingleChoice:
    """Maneuvers with exposure p (A,), which of them crash (A,), importance functions (M, A) and weights (M,)."""

    p: FloatArray
    crash: BoolArray
    q: FloatArray
    alpha: FloatArray

    @property
    def crash_rate(self) -> float:
        """μ."""
        return float(self.p @ self.crash)

    def draw(self, method: Method, n: int, rng: np.random.Generator) -> Block:
        """Episodes of exactly one control step each."""
        return self.block(method, self.maneuvers(n, rng))

    def maneuvers(self, n: int, rng: np.random.Generator) -> IntArray:
        """Drawn from the mixture."""
        return rng.choice(len(self.p), size=n, p=self.alpha @ self.q)

    def block(self, method: Method, maneuver: IntArray) -> Block:
        """Episodes with given maneuvers."""
        n = len(maneuver)
        with np.errstate(divide="ignore"):
            log_q = np.log(self.q[:, maneuver] / self.p[maneuver]).T
        log_weight = np.log(self.p / (self.alpha @ self.q))[maneuver]
        ratios = np.ones((n, 9, len(self.alpha)))
        ratios[:, 0] = np.exp(log_q + log_weight[:, None])
        columns = {"cut_in": np.ones(n, np.bool_), "log_q": log_q, "n_control_steps": np.ones(n, np.int64)}
        outcome = np.where(self.crash[maneuver], CRASH, TIMEOUT).astype(np.int8)
        return Block(0, outcome, log_weight, {**columns, "first_ratios": ratios}, Drawn(method, self.alpha))


def with_optimal_function(tilt: float = 1.0) -> SingleChoice:
    """Five maneuvers, two crash; q_1 is p given a crash, the others are p and one that is wholly wrong.

    A `tilt` other than 1 makes q_1 prefer one of the crashing maneuvers, so that it is only nearly optimal.
    """
    p = np.array([0.6, 0.39, 9.5e-3, 4e-4, 1e-4])
    crash = np.array([False, False, False, True, True])
    tilted = p * crash * np.array([1.0, 1.0, 1.0, 1.0, tilt])
    wrong = np.array([0.1, 0.5, 0.3, 0.02, 0.08])
    return SingleChoice(p, crash, np.stack([tilted / tilted.sum(), p, wrong]), np.array([0.4, 0.3, 0.3]))
