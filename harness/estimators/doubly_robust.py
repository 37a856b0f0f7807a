"""`dr`: the mean of weighted crashes, less the part of its luck that a surrogate knows of.

Before control step t surrogate j predicts a crash with probability V_j, after it with C_j; W is the weight so far.

    D_j = Σ_t (W_t C_j,t - W_{t-1} V_j,t)

has mean 0, whatever surrogate and vehicle are (the method that draws sums it up: `martingale`), so that Y - D_j has
the mean of Y; where j crashes as the vehicle does, hardly more is left in it than the first V_j. It is an approximating
martingale used as a control variate (S. G. Henderson and P. W. Glynn, Mathematics of Operations Research 27, 2002,
253), with surrogates as the approximation. For sequences of decisions the same idea is known as the doubly robust
estimate (N. Jiang and L. Li, ICML 2016, 652), whose name it has.

How much of which D_j is taken off, the tests themselves say, in five folds: a fold's share β_j is from the others, so
that the mean of what is taken off stays 0. It lies between 0 and 1, and one surrogate alone has it, the one that leaves
least: a small share of a surrogate whose D_j is rarely huge would cost more than it brings, and is not seen to in the
tests that lack it (docs/estimators.md).
"""

from __future__ import annotations

import math

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, note
from harness.estimators.scv import with_cubes
from harness.estimators.weighted import FEW_EFFECTIVE, Nade
from harness.vocabulary import FloatArray

FOLDS = 5
WIDER = 1.5
"""Of residuals than of Y [assumed]. Less is left of Y than there was, but where a D_j is rarely huge: a path on which
crashes of large weight are due and none was drawn, so that Y varies more than is seen of it."""


class DoublyRobust(Nade):
    """Σ x_i x_j x_k over the tests of each fold, of x = [1, Y, D_1 … D_J]: episode e is in fold e modulo `FOLDS`."""

    def __init__(self) -> None:
        super().__init__()
        self._cubes: FloatArray = np.zeros((FOLDS, 1, 1, 1))

    def add(self, block: Block) -> None:
        super().add(block)
        rows = np.column_stack([np.ones(len(block)), block.weighted_crashes(), block.martingale])
        cubes = np.broadcast_to(self._cubes, (FOLDS, *[rows.shape[1]] * 3))
        firsts = [(fold - block.first_episode) % FOLDS for fold in range(FOLDS)]
        with np.errstate(over="ignore", invalid="ignore"):
            parts = [with_cubes(each, rows[k::FOLDS]) for each, k in zip(cubes, firsts, strict=True)]
        self._cubes = np.stack(parts)

    def result(self, confidence: float) -> Estimate:
        """Mean over all folds, with the spread of what is left; while few crashes count, as wide as the plain mean."""
        n, y, cubes = self.n, self.y, self._cubes
        if n == 1 or not np.isfinite(cubes).all():  # nothing can be fitted to weights whose cubes are no numbers
            return super().result(confidence)
        shares = np.array([share_of_one(np.delete(cubes, fold, axis=0).sum(axis=0)[0]) for fold in range(FOLDS)])
        taken = np.column_stack([np.zeros(FOLDS), np.ones(FOLDS), -shares])
        rate = float(np.sum(taken * cubes[:, 0, 0]) / n)
        taken[:, 0] = -rate
        squares = np.einsum("fi,fj,fij->", taken, taken, cubes[:, 0])
        third_moment = float(np.einsum("fi,fj,fk,fijk->", taken, taken, taken, cubes)) / n**3
        residual = std_error = math.sqrt(max(0.0, float(squares)) / (n - 1) / n)
        plain, warnings = y.std_error(n), []
        if self.n_crashes and y.n_effective < FEW_EFFECTIVE and residual < plain:
            std_error, third_moment = plain, y.third_moment(n)
            warnings.append(note("plain_width", least=FEW_EFFECTIVE))
        if residual > WIDER * plain:
            warnings.append(note("due_not_drawn", times=residual / plain))
        details = {"beta": shares.mean(axis=0).tolist(), "residual_std_error": residual}
        details |= {"plain_mean": y.mean(n), "plain_std_error": plain}
        return self.estimate(rate, std_error, third_moment, confidence, warnings=warnings, details=details)


def share_of_one(sums: FloatArray) -> FloatArray:
    """β (J,), 0 but for the surrogate whose D_j leaves least of the spread of Y, from Σ x_i x_j of [1, Y, D]."""
    n, y, squares = sums[0, 0], sums[0, 1], np.diagonal(sums)[2:]
    with_y = sums[1, 2:] - sums[0, 2:] * y / max(n, 1.0)
    beta = np.clip(np.divide(with_y, squares, out=np.zeros_like(squares), where=squares > 0.0), 0.0, 1.0)
    change = beta * (beta * squares - 2.0 * with_y)
    return np.where(np.arange(len(change)) == np.argmin(change), beta, 0.0)
