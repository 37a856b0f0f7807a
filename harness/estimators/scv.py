"""`scv`: sparse control variates exactly as published ([paper] Algorithm 1), with the warning that they need.

Episodes are stratified by their number of control steps l; within each stratum Y is regressed by SVD on the products
vec(Π_t q_{j_t}(a_t|s_t)/q_alpha(a_t|s_t)), centred by the stratum's *sample* mean; the estimate is
Σ_l n_l·intercept_l/n and its variance is that of the pooled residuals Z = Y - H·β. Each j_t runs over 1 … J-1 (section
IV-A would have J). Each l is a stratum of its own, also above nine: there the columns come from the first nine control
steps (section VI-E), but Algorithm 1 does not pool the strata.

Because sample-centred columns leave the intercept at the stratum's mean of Y, the estimate *is* that of `nade`, while
its claimed variance leaves out the error of the centring. See docs/scv-defect.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.estimators.block import MAX_CONTROL_STEPS, Block
from harness.estimators.estimate import Estimate, require_episodes
from harness.estimators.nade import WeightedSums, weighted_estimate
from harness.estimators.triangular_factor import empty_factor, fold_rows
from harness.threads import side_by_side
from harness.vocabulary import FloatArray, IntArray

WARNING = (
    "this interval is known to be too narrow; use nade's (docs/scv-defect.md). The published variance is not that of "
    "this estimator: columns centred by their sample means leave the estimate equal to nade's, and var(Z) leaves out "
    "the error of those means"
)
MAX_COLUMNS = 729
"""Most columns of one stratum: J = 3 reaches 2^9 = 512, J = 4 3^6 = 729 at six steps, and uses no more steps then."""
CHUNK_ROWS = 2_048


class Scv:
    """One `Stratum` per number of control steps."""

    def __init__(self) -> None:
        self.sums = WeightedSums()
        self._strata: dict[int, Stratum] = {}

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Needs the step mixture and the ratios of its first control steps."""
        if block.method != "step_mixture":
            return f"is defined for the step mixture ([paper] section III-C), these tests were drawn by {block.method}"
        if block.first_ratios is None:
            return "needs the control steps of every episode: set records.moments to first_9 or all"
        return None

    def add(self, block: Block) -> None:
        """Hand each episode to its stratum, in index order."""
        first_ratios = block.first_ratios
        if first_ratios is None:
            raise ValueError("scv needs Block.first_ratios in every block")
        self.sums.add(block)
        y, n_surrogates = block.weighted_crashes(), first_ratios.shape[2]
        order = np.argsort(block.n_control_steps, kind="stable")
        levels, starts = np.unique(block.n_control_steps[order], return_index=True)
        parts = list(zip(levels.tolist(), np.split(order, starts[1:]), strict=True))
        for level in levels.tolist():
            self._strata.setdefault(level, Stratum(level))
        # The dearest first: else one thread would be left with it when the others have finished.
        parts.sort(key=lambda part: -len(part[1]) * n_columns(part[0], n_surrogates) ** 2)

        def add(part: tuple[int, IntArray]) -> None:
            level, rows = part
            self._strata[level].add(first_ratios[rows], y[rows])

        side_by_side(add, parts, worthwhile=len(block) >= CHUNK_ROWS)

    def result(self, confidence: float) -> Estimate:
        """Algorithm 1's estimate and its published variance."""
        n = self.sums.n
        require_episodes(n)
        levels, fits = zip(*self.fits(), strict=True)
        rate = math.fsum(fit.n * fit.intercept for fit in fits) / n
        within = math.fsum(fit.residual_squares for fit in fits)
        between = math.fsum(fit.n * (fit.intercept - rate) ** 2 for fit in fits)
        var_z = (within + between) / (n - 1) if n > 1 else math.inf
        var_y = self.sums.y.variance(n)
        return weighted_estimate(
            self.sums,
            rate,
            math.sqrt(var_z / n),
            confidence,
            third_moment=None,
            method="sparse control variates as published (Algorithm 1)",
            cautions=[WARNING],
            details={
                "basis": "reduced",
                "var_z": var_z,
                "var_y": var_y,
                "nade_std_error": math.sqrt(var_y / n),
                "strata": [
                    {"n_control_steps": level, "n": fit.n, "columns": fit.n_columns, "rank": fit.rank}
                    for level, fit in zip(levels, fits, strict=True)
                ],
            },
        )

    def fits(self) -> list[tuple[int, StratumFit]]:
        """Every number of control steps with its regression."""
        levels = sorted(self._strata)
        fits = side_by_side(lambda level: self._strata[level].fit(), levels, worthwhile=self.sums.n >= CHUNK_ROWS)
        return list(zip(levels, fits, strict=True))


class StratumFit(NamedTuple):
    """Regression of Y_l on H_l: episodes, columns, rank of the centred columns, η_l, Σ(Z - η_l)² and Σ(Y - η_l)²."""

    n: int
    n_columns: int
    rank: int
    intercept: float
    residual_squares: float
    total_squares: float


class Stratum:
    """Episodes with `level` control steps: a triangular factor of [1, H, Y] and the rows that wait.

    Episodes wait as compact rows (27 numbers for J = 3) until a chunk is full; only then are they expanded to up to 729
    columns and folded into the factor. Chunks are cut by the count of the stratum's episodes alone, so the result does
    not depend on how the episodes came in blocks, and small strata never hold a large factor.
    """

    def __init__(self, level: int) -> None:
        self._level = level
        self._n = self._n_waiting = 0
        self._factor: FloatArray | None = None
        self._ratios: list[FloatArray] = []
        self._y: list[FloatArray] = []

    def add(self, first_ratios: FloatArray, y: FloatArray) -> None:
        """Add episodes of this stratum: ratios, shape (m, 9, J), and Y, shape (m,)."""
        start = 0
        while start < len(y):
            stop = min(len(y), start + CHUNK_ROWS - self._n_waiting)
            self._ratios.append(first_ratios[start:stop])
            self._y.append(y[start:stop])
            self._n_waiting += stop - start
            if self._n_waiting == CHUNK_ROWS:
                self._factor = self._folded(self._factor)
                self._ratios, self._y, self._n_waiting = [], [], 0
            start = stop
        self._n += len(y)

    def _folded(self, factor: FloatArray | None) -> FloatArray:
        """Fold the waiting rows into `factor`, which is changed, or into a new one."""
        rows = self._waiting_rows()
        factor = empty_factor(rows.shape[1]) if factor is None else factor
        fold_rows(factor, rows)
        return factor

    def _waiting_rows(self) -> FloatArray:
        """Rows [1, H, Y] that wait, shape (m, d + 2), in Fortran order."""
        first_ratios = np.concatenate(self._ratios)
        rows = np.empty((self._n_waiting, n_columns(self._level, first_ratios.shape[2]) + 2), order="F")
        rows[:, 0], rows[:, -1] = 1.0, np.concatenate(self._y)
        fill_product_columns(first_ratios, self._level, rows[:, 1:-1])
        return rows

    def _with_waiting_rows(self) -> FloatArray:
        """Triangular factor of all rows so far; the state stays as it is.

        Fewer rows than columns have a factor of as many rows; the square one would be filled up with zeros, and its
        decomposition would take hundreds of times as long.
        """
        if self._factor is not None:
            return self._folded(self._factor.copy(order="F")) if self._ratios else self._factor
        rows = self._waiting_rows()
        return np.asarray(np.linalg.qr(rows, mode="r")) if rows.shape[0] < rows.shape[1] else self._folded(None)

    def fit(self) -> StratumFit:
        """Solve the regression by SVD of the centred columns' triangular factor.

        The tolerance for the rank is the customary one of least-squares solvers, the larger dimension times machine
        epsilon times the largest singular value; but never below what centring has rounded away, which grows with the
        columns' means. Else columns that never vary would be fitted as if their rounding errors were data.
        """
        factor = self._with_waiting_rows()
        intercept = float(factor[0, -1] / factor[0, 0])
        last = factor.shape[1] - 1
        centred, target = factor[1:last, 1:last], factor[1:last, last]
        residual_squares = float(factor[last, last] ** 2) if len(factor) > last else 0.0
        total_squares = residual_squares + float(np.sum(target**2))
        rank = 0
        if centred.size:
            left, singular, _ = np.linalg.svd(centred, full_matrices=False)
            largest = max(singular[0], np.linalg.norm(factor[0, :-1]))
            kept = singular > max(self._n, last - 1) * np.finfo(np.float64).eps * largest
            rank = int(np.count_nonzero(kept))
            residual_squares += float(np.sum((left[:, ~kept].T @ target) ** 2))
        return StratumFit(self._n, last - 1, rank, intercept, residual_squares, total_squares)


def steps_used(n_control_steps: int, n_surrogates: int) -> int:
    """Control steps that a stratum's columns are built from: nine at most, and no more than `MAX_COLUMNS` allow."""
    steps = min(n_control_steps, MAX_CONTROL_STEPS)
    while steps and (n_surrogates - 1) ** steps > MAX_COLUMNS:
        steps -= 1
    return steps


def n_columns(n_control_steps: int, n_surrogates: int) -> int:
    """Columns of a stratum: (J - 1)^steps, and none where nothing was controlled."""
    steps = steps_used(n_control_steps, n_surrogates)
    return int((n_surrogates - 1) ** steps) if steps else 0


def fill_product_columns(first_ratios: FloatArray, n_control_steps: int, out: FloatArray) -> None:
    """Write the columns of episodes of one stratum, not yet centred; the last step's j runs fastest.

    Parameters
    ----------
    first_ratios : (m, 9, J) float64
        q_j/q_alpha per control step.
    n_control_steps : int
        Stratum l of all m episodes.
    out : (m, d) float64
        In Fortran order, d = `n_columns`.
    """
    n_rows, _, n_surrogates = first_ratios.shape
    if out.shape[1] == 0:
        return
    used = first_ratios[:, : steps_used(n_control_steps, n_surrogates), : n_surrogates - 1]
    by_step = np.ascontiguousarray(np.moveaxis(used, 0, 2))
    products: FloatArray = np.ones((1, n_rows))
    for ratios in by_step[:-1]:
        products = (products[:, None, :] * ratios[None, :, :]).reshape(-1, n_rows)
    np.multiply(products[:, None, :], by_step[-1][None, :, :], out=out.T.reshape(len(products), -1, n_rows))
