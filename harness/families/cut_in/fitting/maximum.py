"""Maximum likelihood of laws with few predictors, and the influence of each cluster.

A row's log-likelihood depends on predictors (location, log scale …); each is a design matrix times coefficients of its
own. Derivatives by predictors are differences, those by coefficients follow from the designs. So Newton's method needs
few evaluations, whatever the number of coefficients.

A weak prior (*pseudo-observations*, ``weights · (θ - centre)`` standard normal) keeps directions that the data do not
determine near a known law. It counts as data: its share of the curvature is part of the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from harness.vocabulary import BoolArray, FloatArray, IntArray, RecordArray

LogLikelihood = Callable[..., FloatArray]
"""Log-likelihood of rows (n,) by their data, a structured array (n,), and one array (n,) per predictor."""
MOSTLY_PRIOR = 0.5
"""Prior's share of a number's information above which the data do not determine it [assumed]."""
EXCLUDES = 2.0
"""Loss of log-likelihood above which the data exclude the base's value, so that it is not kept, even if they do not
determine another [assumed]: a share without a single event is small, whatever the base says."""
MOST_LEVERAGE = 0.5
"""Largest leverage that counts. Influences are divided by 1 - leverage, as in HC3: few rows would look too precise."""
_STEP = 1e-3
_MOST_ROUNDS = 200
_ROWS_AT_FIRST = 20_000
_FIXED = 1e4


@dataclass(frozen=True, eq=False)
class Prior:
    """Pseudo-observations ``weights @ (θ - centre)``, each standard normal: weights (m, p), centre (p,).

    Where it ``smooths``, it is part of the law, and numbers do not fall back to its centre.
    """

    centre: FloatArray
    weights: FloatArray
    smooths: bool = False

    def fixed(self, kept: BoolArray) -> Prior:
        """The same, with coefficients (p,) that are ``kept`` fixed."""
        return replace(self, weights=self.weights * np.where(kept, _FIXED, 1.0))

    @property
    def precision(self) -> FloatArray:
        """Inverse of its covariance, (p, p)."""
        return self.weights.T @ self.weights

    @classmethod
    def of(cls, centre: Sequence[float], spread: Sequence[float]) -> Prior:
        """Independent coefficients with these standard deviations."""
        return cls(np.asarray(centre, np.float64), np.diag(1.0 / np.asarray(spread, np.float64)))


@dataclass(frozen=True, eq=False)
class Maximum:
    """The maximum of a likelihood.

    ``theta`` (p,); ``influence`` (clusters, p): how far it moves if a cluster is seen once more, to first order;
    ``noise`` (p, m): the same for a standard normal change of each pseudo-observation. Numbers that the data do not
    determine keep the prior's centre and do not move.
    """

    theta: FloatArray
    influence: FloatArray
    noise: FloatArray

    def covariance(self) -> FloatArray:
        """Sandwich covariance by clusters, (p, p)."""
        n = max(len(self.influence), 2)
        return self.influence.T @ self.influence * (n / (n - 1.0)) + self.noise @ self.noise.T


def maximise(
    log_likelihood: LogLikelihood,
    rows: RecordArray,
    designs: Sequence[FloatArray],
    members: sparse.csr_array,
    clusters: IntArray,
    prior: Prior,
    starts: Sequence[FloatArray] = (),
    *,
    kept: BoolArray | None = None,
) -> Maximum | None:
    """Maximum of Σ counts · log-likelihood + prior; None if it is not found.

    ``rows`` (n,) are the data; ``designs`` are (n, p_k), one per predictor, their coefficients one after the other in
    θ; ``members`` (vehicles, n) counts rows by vehicle, and ``clusters`` (vehicles,) is the cluster of each. The best
    of the prior's centre and other starts counts. Coefficients that are ``kept`` (p,) stay at the centre.
    """
    kept = np.zeros(prior.centre.size, np.bool_) if kept is None else kept.copy()
    full = _Sum(log_likelihood, rows, designs, members, prior.fixed(kept))
    thinned = full.thinned() if rows.size > 2 * _ROWS_AT_FIRST else full
    climbed = [thinned.climb(start) for start in (prior.centre, *starts)]
    best = max((each for each in climbed if each is not None), key=lambda each: each[1], default=None)
    if best is not None and thinned is not full:
        best = full.climb(best[0])
    while best is not None:
        theta, _ = best
        scores, curvature = full.derivatives(theta)
        inverse = linalg.inv(curvature)
        silent = ~kept & (np.diag(inverse) * np.diag(prior.precision) > MOSTLY_PRIOR)
        simpler = None
        if silent.any() and not prior.smooths:
            full.prior = prior.fixed(kept | silent)
            simpler = full.climb(np.where(kept | silent, prior.centre, theta))
        if simpler is None or best[1] - simpler[1] > EXCLUDES:
            weights = prior.weights * ~kept
            moves = scores @ inverse
            leverage = np.minimum((moves * scores).sum(axis=1), MOST_LEVERAGE)
            moves *= ~kept / (1.0 - leverage[:, None])
            influence = np.zeros((int(clusters.max()) + 1, theta.size))
            np.add.at(influence, clusters, moves)
            return Maximum(theta, influence, (inverse @ weights.T) * ~kept[:, None])
        kept, best = kept | silent, simpler
    return None


@dataclass(eq=False)
class _Sum:
    log_likelihood: LogLikelihood
    rows: RecordArray
    designs: Sequence[FloatArray]
    members: sparse.csr_array
    prior: Prior

    def __post_init__(self) -> None:
        self._counts = np.asarray(self.members.sum(axis=0)).ravel()
        self._ends = np.cumsum([design.shape[1] for design in self.designs])

    def thinned(self) -> _Sum:
        """The sum over a part of the rows, weighted to stand for all."""
        n = self.rows.size
        sample = np.arange(0, n, n // _ROWS_AT_FIRST)
        designs = [design[sample] for design in self.designs]
        members = self.members[:, sample] * (n / sample.size)
        return replace(self, rows=self.rows[sample], designs=designs, members=members)

    def _predictors(self, theta: FloatArray) -> list[FloatArray]:
        parts = np.split(theta, self._ends[:-1])
        return [design @ part for design, part in zip(self.designs, parts, strict=True)]

    def value(self, theta: FloatArray) -> float:
        """Penalised log-likelihood; -inf where it is not defined."""
        with np.errstate(all="ignore"):
            value = self._counts @ self.log_likelihood(self.rows, *self._predictors(theta))
            off = self.prior.weights @ (theta - self.prior.centre)
            value -= 0.5 * float(off @ off)
        return float(value) if np.isfinite(value) else -np.inf

    def derivatives(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scores of vehicles (v, p), without the prior, and minus the second derivative (p, p), with it."""
        eta = self._predictors(theta)
        k = len(eta)

        def at(*moves: int) -> FloatArray:
            predictors = list(eta)
            for move in moves:  # ±(predictor + 1)
                predictors[abs(move) - 1] = predictors[abs(move) - 1] + np.sign(move) * _STEP
            return self.log_likelihood(self.rows, *predictors)

        with np.errstate(all="ignore"):
            middle, up, down = at(), [at(j + 1) for j in range(k)], [at(-j - 1) for j in range(k)]
            first = [(up[j] - down[j]) / (2.0 * _STEP) for j in range(k)]
            second = [[middle] * k for _ in range(k)]
            for i in range(k):
                second[i][i] = (up[i] + down[i] - 2.0 * middle) / _STEP**2
                for j in range(i):
                    diagonal = at(i + 1, j + 1) + at(-i - 1, -j - 1) + 2.0 * middle
                    second[i][j] = second[j][i] = (diagonal - up[i] - up[j] - down[i] - down[j]) / (2.0 * _STEP**2)
        scores = np.hstack([self.members @ (self.designs[j] * first[j][:, None]) for j in range(k)])
        blocks = [
            [-self.designs[i].T @ (self.designs[j] * (self._counts * second[i][j])[:, None]) for j in range(k)]
            for i in range(k)
        ]
        return scores, np.block(blocks) + self.prior.precision

    def climb(self, theta: FloatArray) -> tuple[FloatArray, float] | None:
        """Newton's method, damped where the likelihood is not concave: the maximum and its value, None if not found."""
        value, damping = self.value(theta), 0.0
        if not np.isfinite(value):
            return None
        scale = self.prior.precision
        for _ in range(_MOST_ROUNDS):
            scores, curvature = self.derivatives(theta)
            slope = scores.sum(axis=0) - scale @ (theta - self.prior.centre)
            while True:
                try:
                    step = linalg.cho_solve(linalg.cho_factor(curvature + damping * scale), slope)
                except (linalg.LinAlgError, ValueError):
                    step = None
                if step is not None and (risen := self.value(theta + step)) >= value - 1e-9 * abs(value):
                    break
                damping = max(4.0 * damping, 1e-2)
                if damping > 1e12:
                    return None
            gain, theta, value = slope @ step, theta + step, risen
            if gain < 1e-6 and damping == 0.0:
                return theta, value
            damping = 0.0 if damping < 0.1 else damping / 16.0
        return None
