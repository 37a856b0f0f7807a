"""Control variates with coefficients from other tests: unbiased, whatever the coefficients are.

Y_i - βᵀ(H_i - μ) has the mean of Y for every fixed β when μ is the mean of H. A β fitted to the same tests is not
fixed; one fitted to *other* tests is, for them. So tests are dealt into folds by their index, and each fold gets the β
of all others. When μ itself is only known with an error of covariance Σ, the best β is (S_H/n + Σ)⁻¹ S_HY/n: columns
whose mean is poorly known drop out by themselves, and β̄ᵀΣβ̄ is added to the variance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from harness.arrays import FloatArray
from harness.estimators.third_moments import ThirdMoments
from harness.estimators.triangular_factor import empty_factor, fold_rows

FOLDS = 10


@dataclass(frozen=True)
class CrossFitted:
    """Mean of Y with control variates.

    Attributes
    ----------
    rate, std_error : float
    third_moment : float
        Third central moment of the sampling error of the rate.
    beta : (k,) float64
        Mean coefficients.
    known_share : float
        Share of the variance that comes from the error of μ.
    """

    rate: float
    std_error: float
    third_moment: float
    beta: FloatArray
    known_share: float


class CrossFit:
    """Triangular factors and third moments of [1, H, Y] for each fold: (k + 2)³ numbers times ten, however many tests.

    Parameters
    ----------
    n_columns : int
        Columns k of H.
    """

    def __init__(self, n_columns: int) -> None:
        self.n_columns = n_columns
        self.n = np.zeros(FOLDS, np.int64)
        self._factors = [empty_factor(n_columns + 2) for _ in range(FOLDS)]
        self._cubes = [ThirdMoments(n_columns + 2) for _ in range(FOLDS)]

    def add(self, first: int, h: FloatArray, y: FloatArray) -> None:
        """Add tests ``first … first + n - 1``.

        Parameters
        ----------
        first : int
            Index of the first test.
        h : (n, k) float64
            Control variates, not centred.
        y : (n,) float64
        """
        for fold in range(FOLDS):
            rows = slice((fold - first) % FOLDS, None, FOLDS)
            self.n[fold] += len(y[rows])
            design = _design(h[rows], y[rows])
            self._cubes[fold].add(_unjoined(design))
            fold_rows(self._factors[fold], design)

    def result(self, mean: FloatArray, covariance: FloatArray) -> CrossFitted:
        """Cross-fitted mean of Y.

        Parameters
        ----------
        mean : (k,) float64
            Known means of H.
        covariance : (k, k) float64
            Of their errors; 0 where they are exact.
        """
        n = int(self.n.sum())
        root = _root(covariance)
        total, squares, beta = 0.0, 0.0, np.zeros(len(mean))
        combinations = []
        for fold in range(FOLDS):
            fitted = self._fit(fold, n, root)
            factor = self._factors[fold]
            combinations.append(np.concatenate([[fitted @ mean], -fitted, [1.0]]))
            rows = factor @ combinations[-1]
            total += float(factor[0, 0] * rows[0])
            squares += float(rows @ rows)
            beta += fitted * (self.n[fold] / n)
        rate = total / n
        sampling = max(squares - n * rate * rate, 0.0) / (n - 1) / n if n > 1 else math.inf
        known = float(beta @ covariance @ beta)
        share = known / (sampling + known) if known > 0.0 else 0.0
        cubes = 0.0
        for moments, combination in zip(self._cubes, combinations, strict=True):
            combination[0] -= rate
            cubes += moments.of(combination)
        return CrossFitted(rate, math.sqrt(sampling + known), cubes / n**3, beta, share)

    def _fit(self, fold: int, n: int, root: FloatArray) -> FloatArray:
        """Coefficients β (k,) from all folds but one."""
        others = empty_factor(len(self._factors[0]))
        for k, factor in enumerate(self._factors):
            if k != fold:
                fold_rows(others, factor.copy(order="F"))
        n_others = n - int(self.n[fold])
        penalty = root * math.sqrt(float(n) * n_others)
        design = np.concatenate([others[1:, 1:-1], penalty])
        target = np.concatenate([others[1:, -1], np.zeros(len(penalty))])
        scale = np.sqrt((design * design).sum(axis=0))
        used = scale > 0.0
        beta = np.zeros(len(scale))
        if used.any():
            tolerance = max(n_others, len(design)) * np.finfo(np.float64).eps
            beta[used] = np.linalg.lstsq(design[:, used] / scale[used], target, rcond=tolerance)[0] / scale[used]
        return beta


def _design(h: FloatArray, y: FloatArray) -> FloatArray:
    """Rows [1, H, Y]; those in which H and Y are 0 are joined into one of the same length."""
    used = (y != 0.0) | (h != 0.0).any(axis=1)
    n_used = int(np.count_nonzero(used))
    rows = np.zeros((n_used + 1, h.shape[1] + 2), order="F")
    rows[:n_used, 0], rows[:n_used, 1:-1], rows[:n_used, -1] = 1.0, h[used], y[used]
    rows[n_used, 0] = math.sqrt(len(y) - n_used)
    return rows


def _unjoined(design: FloatArray) -> FloatArray:
    """Rows whose third moments are those of the tests: c equal rows [1, 0] have the cube c, not c^(3/2)."""
    rows = design.copy()
    rows[-1, 0] = np.cbrt(design[-1, 0] ** 2)
    return rows


def _root(covariance: FloatArray) -> FloatArray:
    """L with LᵀL = covariance, shape (k, k)."""
    values, vectors = np.linalg.eigh(covariance)
    root: FloatArray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return root
