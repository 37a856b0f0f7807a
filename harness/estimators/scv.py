"""Control variates: `mixture_cv`, whose columns have means that are known exactly, and `scv`, exactly as published.

`mixture_cv`. Under q_alpha(x) = Σ_j alpha_j q_j(x) over whole episodes, h_j(x) = q_j(x)/q_alpha(x) - 1 has mean exactly
0, whatever the AV does. Regressing Y on [1, h_1 … h_M], with the columns *not* centred by their sample means, makes the
intercept the estimate. Its variance is at most min_j σ²_j/(n alpha_j) up to the estimation of β ([paper] Lemma 1,
Theorem 2 of Owen and Zhou).

`scv` ([paper] Algorithm 1), with the warning that it needs. Episodes are stratified by their number of control steps l;
within each stratum Y is regressed by SVD on the products vec(Π_t q_{j_t}(a_t|s_t)/q_alpha(a_t|s_t)), centred by the
stratum's *sample* mean; the estimate is Σ_l n_l·intercept_l/n and its variance is that of the pooled residuals
Z = Y - H·β. Each j_t runs over 1 … J-1 (section IV-A would have J). Each l is a stratum of its own, also above nine:
there the columns come from the first nine control steps (section VI-E), but Algorithm 1 does not pool the strata.
Because sample-centred columns leave the intercept at the stratum's mean of Y, the estimate *is* that of `nade`, while
its claimed variance leaves out the error of the centring. See docs/scv-defect.md.

Both regressions rest on the triangular factor R of a tall matrix [1, H, Y] whose rows come in blocks (TSQR): factor the
old R with the new rows below it. Unlike a Gram matrix this never squares the condition number, and the centring of H
and Y by their means falls out of R for free: with the ones first, R without its first row and column is the factor of
the centred columns. Of fewer rows than columns it has as many.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from harness.estimators.block import MAX_CONTROL_STEPS, Block
from harness.estimators.estimate import Estimate, note
from harness.estimators.weighted import FEW_FOR_RESIDUALS, Nade
from harness.processes import side_by_side
from harness.vocabulary import FloatArray

MAX_COLUMNS = 729
"""Most columns of one stratum: J = 3 reaches 2^9 = 512, J = 4 3^6 = 729 at six steps, and uses no more steps then."""
CHUNK_ROWS = 2_048
_ROWS_AT_ONCE = 4096


class MixtureCv(Nade):
    """Triangular factor of [1, H, Y], and Σ x_i x_j x_k over its rows, for the skewness of any combination of them."""

    def __init__(self) -> None:
        super().__init__()
        self._factor: FloatArray | None = None
        self._cubes: FloatArray = np.zeros(())

    def add(self, block: Block) -> None:
        """Fold one block's rows into the factor, in index order."""
        super().add(block)
        rows = np.column_stack([np.ones(len(block)), block.mixture_ratios() - 1.0, block.weighted_crashes()])
        self._cubes = with_cubes(self._cubes, rows)
        self._factor = fold_rows(self._factor, rows)

    def result(self, confidence: float) -> Estimate:
        """Intercept of the regression, with the residual variance if crashes are many, else the plain mean's."""
        n, y = self.n, self.y
        assert self._factor is not None
        coefficients, rank, variance = _regression(self._factor, n)
        residual = std_error = math.sqrt(variance)
        of_residuals = np.array([*-coefficients, 1.0])
        squares = np.outer(of_residuals, of_residuals).ravel()
        third_moment = float(squares @ self._cubes.reshape(len(squares), -1) @ of_residuals) / n**3
        plain, warnings = y.std_error(n), []
        if self.n_crashes and y.n_effective < FEW_FOR_RESIDUALS and residual < plain:
            std_error, third_moment = plain, y.third_moment(n)
            warnings.append(note("plain_width", least=FEW_FOR_RESIDUALS))
        details = {"beta": coefficients[1:].tolist(), "rank": rank, "residual_std_error": residual}
        details |= {"plain_mean": y.mean(n), "plain_std_error": plain}
        rate = float(coefficients[0])
        return self.estimate(rate, std_error, third_moment, confidence, warnings=warnings, details=details)


def with_cubes(cubes: FloatArray, rows: FloatArray) -> FloatArray:
    """Σ x_i x_j x_k (k, k, k) with more ``rows`` (m, k); of no rows so far it is 0, of any shape."""
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        part = rows[start : start + _ROWS_AT_ONCE]
        products = (part[:, :, None] * part[:, None, :]).reshape(len(part), -1).T @ part
        cubes = cubes + products.reshape([part.shape[1]] * 3)
    return cubes


def _regression(factor: FloatArray, n: int) -> tuple[FloatArray, int, float]:
    """Least squares of Y on [1, H] from the factor of ``n`` rows, of the smallest norm where columns depend.

    Gives intercept and β, (1 + M,), the rank of [1, H] (Σ_j alpha_j h_j = 0 costs one), and the intercept's variance.
    """
    left, singular, right = np.linalg.svd(factor[:, :-1])
    rank = int(np.count_nonzero(singular > max(n, len(right)) * np.finfo(np.float64).eps * singular[0]))
    projected, root = left.T @ factor[:, -1], right[:rank] / singular[:rank, None]
    coefficients = root.T @ projected[:rank]
    residual_squares = float(np.sum(projected[rank:] ** 2))
    leverage = float(np.sum(root[:, 0] ** 2))  # of the intercept, [(XᵀX)⁺]_00
    variance = residual_squares / (n - rank) * leverage if n > rank else math.inf
    return coefficients, rank, variance


class Scv(Nade):
    """One `Stratum` per number of control steps."""

    def __init__(self) -> None:
        super().__init__()
        self._strata: dict[int, Stratum] = {}

    def add(self, block: Block) -> None:
        """Hand each episode to its stratum, in index order."""
        first_ratios, n_control_steps = block.first_ratios, block.n_control_steps
        super().add(block)
        y = block.weighted_crashes()
        n_surrogates = first_ratios.shape[2]
        order = np.argsort(n_control_steps, kind="stable")
        levels, starts = np.unique(n_control_steps[order], return_index=True)
        parts = list(zip(levels.tolist(), np.split(order, starts[1:]), strict=True))
        for level in levels.tolist():
            self._strata.setdefault(level, Stratum(level))
        # The dearest first: else one thread would be left with it when the others have finished.
        parts.sort(key=lambda part: -len(part[1]) * n_columns(part[0], n_surrogates) ** 2)
        side_by_side(
            lambda part: self._strata[part[0]].add(first_ratios[part[1]], y[part[1]]),
            parts,
            worthwhile=len(block) >= CHUNK_ROWS,
        )

    def result(self, confidence: float) -> Estimate:
        """Algorithm 1's estimate and its published variance, and what its gain would be without the fit's optimism."""
        n, (levels, fits) = self.n, zip(*self.fits(), strict=True)
        rate = math.fsum(fit.n * fit.intercept for fit in fits) / n
        within = math.fsum(fit.residual_squares for fit in fits)
        between = math.fsum(fit.n * (fit.intercept - rate) ** 2 for fit in fits)
        var_z = (within + between) / (n - 1) if n > 1 else math.inf
        var_y = self.y.variance(n)
        gain = self._gain(levels, fits, between)
        details = {"var_z": var_z, "var_y": var_y, "nade_std_error": math.sqrt(var_y / n), "gain": gain}
        strata = [
            {"n_control_steps": level, "n": fit.n, "columns": fit.n_columns, "rank": fit.rank}
            for level, fit in zip(levels, fits, strict=True)
        ]
        saturated = []
        if gain["saturated"]:  # a gain is claimed there whatever the results are
            numbers = {"n": len(gain["saturated"]), "of": len(strata), "levels": gain["saturated"]}
            saturated = [note("saturated", **numbers, claimed=gain["claimed"], corrected=gain["degrees_of_freedom"])]
        return self.estimate(
            rate, math.sqrt(var_z / n), None, confidence, cautions=[note("published_scv")],
            warnings=saturated, details={**details, "strata": strata},
        )  # fmt: skip

    def _gain(self, levels: Sequence[int], fits: Sequence[StratumFit], between: float) -> dict[str, Any]:
        """NADE's variance over that of adjusted results, as claimed and as corrected, and saturated strata."""
        before = math.fsum(fit.total_squares for fit in fits) + between
        squares = [fit.squares() for fit in fits]
        return {
            **{key: _ratio(before, between + math.fsum(one[key] for one in squares)) for key in squares[0]},
            "saturated": [level for level, fit in zip(levels, fits, strict=True) if fit.is_saturated],
        }

    def fits(self, tests_each: Sequence[int] = (1,)) -> list[tuple[int, StratumFit]]:
        """Every number of control steps with its regression."""
        levels = sorted(self._strata)
        large = self.n >= CHUNK_ROWS
        fits = side_by_side(lambda level: self._strata[level].fit(tests_each), levels, worthwhile=large)
        return list(zip(levels, fits, strict=True))


class StratumFit(NamedTuple):
    """Regression of Y_l on H_l: episodes, columns, rank of the centred columns, η_l, Σ(Z - η_l)² and Σ(Y - η_l)².

    ``means`` (d,) are of the columns; ``beta`` (k, d) are fits on the largest principal components, one for each k.
    """

    n: int
    n_columns: int
    rank: int
    intercept: float
    residual_squares: float
    total_squares: float
    means: FloatArray
    beta: FloatArray

    @property
    def is_saturated(self) -> bool:
        """Whether any results would be fitted: as many independent columns as there are tests, but for their mean."""
        return 0 < self.rank >= self.n - 1

    def squares(self) -> dict[str, float]:
        """Σ(Z - η_l)² as claimed, and free of what a fit explains by chance.

        A saturated stratum says nothing of what columns explain: its results count as they are, with Σ(Y - η_l)².
        """
        free = self.n - self.rank - 1
        fair = self.residual_squares * (self.n - 1) / free if free > 0 else self.total_squares
        return {"claimed": self.residual_squares, "degrees_of_freedom": fair}


def _ratio(before: float, after: float) -> float | None:
    return before / after if before > 0.0 and after > 0.0 else None


class Stratum:
    """Episodes with `level` control steps: a triangular factor of [1, H, Y] and the rows that wait.

    They wait as compact rows (27 numbers for J = 3) until a chunk is full; only then are they expanded to up to 729
    columns and folded. Chunks are cut by the count of the stratum's episodes alone, so that how these came in blocks
    makes no difference, and small strata never hold a large factor.
    """

    def __init__(self, level: int) -> None:
        self._level, self._n = level, 0
        self._factor: FloatArray | None = None
        self._rows: list[tuple[FloatArray, FloatArray]] = []

    def add(self, first_ratios: FloatArray, y: FloatArray) -> None:
        """Add episodes of this stratum: ratios, shape (m, 9, J), and Y, shape (m,)."""
        chunks = range(CHUNK_ROWS - self._n % CHUNK_ROWS, len(y), CHUNK_ROWS)
        for part in zip(np.split(first_ratios, chunks), np.split(y, chunks), strict=True):
            self._rows.append(part)
            self._n += len(part[1])
            if self._n % CHUNK_ROWS == 0:
                self._factor, self._rows = self._folded(), []

    def _folded(self) -> FloatArray:
        """Triangular factor with all rows that wait: [1, H, Y], shape (m, d + 2), in Fortran order."""
        if not self._rows and self._factor is not None:
            return self._factor
        first_ratios, y = map(np.concatenate, zip(*self._rows, strict=True))
        rows = np.empty((len(first_ratios), n_columns(self._level, first_ratios.shape[2]) + 2), order="F")
        rows[:, 0], rows[:, -1] = 1.0, y
        fill_product_columns(first_ratios, self._level, rows[:, 1:-1])
        return fold_rows(self._factor, rows)

    def fit(self, tests_each: Sequence[int] = (1,)) -> StratumFit:
        """Solve the regression by SVD of the centred columns' triangular factor.

        The tolerance for the rank is machine epsilon times the larger dimension times the largest singular value, as
        is customary, or times √n_l·|(1, means of the columns)| if larger, the norm of what centring has taken away:
        else rounding errors of columns that never vary would be fitted.
        """
        factor = self._folded()
        intercept, means = float(factor[0, -1] / factor[0, 0]), factor[0, 1:-1] / factor[0, 0]
        last = factor.shape[1] - 1
        centred, target = factor[1:last, 1:last], factor[1:last, last]
        residual_squares = float(factor[last, last] ** 2) if len(factor) > last else 0.0
        total_squares = residual_squares + float(np.sum(target**2))
        rank = 0
        beta = np.zeros((len(tests_each), last - 1))
        if centred.size:
            left, singular, right = np.linalg.svd(centred, full_matrices=False)
            largest = max(singular[0], np.linalg.norm(factor[0, :-1]))
            used = singular > max(self._n, last - 1) * np.finfo(np.float64).eps * largest
            rank = int(np.count_nonzero(used))
            residual_squares += float(np.sum((left[:, ~used].T @ target) ** 2))
            root, explained = right[used].T / singular[used], left[:, used].T @ target
            most = [self._n // n for n in tests_each]
            beta = np.array([root[:, :k] @ explained[:k] for k in most])
        return StratumFit(self._n, last - 1, rank, intercept, residual_squares, total_squares, means, beta)


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
    """Write the columns of m episodes of one stratum, not yet centred; the last step's j runs fastest.

    ``first_ratios`` (m, 9, J) are q_j/q_alpha per control step, ``out`` (m, `n_columns`) is in Fortran order.
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


def fold_rows(factor: FloatArray | None, rows: FloatArray) -> FloatArray:
    """Triangular factor of the matrix behind a ``factor``, None of no rows, with more ``rows`` (m, k) below it."""
    return np.asarray(np.linalg.qr(rows if factor is None else np.concatenate([factor, rows]), mode="r"))
