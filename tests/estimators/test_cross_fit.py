"""Cross-fitted control variates against the same thing written out with explicit rows."""

from __future__ import annotations

import numpy as np
import pytest

from harness.estimators.cross_fit import FOLDS, CrossFit
from tests.chains.seed import SEED

N = 1_003
MEAN = np.array([0.5, -1.0])
SCALE = np.array([1e-3, 1e4])


def rows(n: int = N) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(SEED)
    h = (rng.normal(size=(n, 2)) + MEAN) * SCALE
    h[rng.random(n) < 0.3] = 0.0
    y = np.where(h[:, 0] == 0.0, 0.0, 1e-7 * (2.0 + h @ [2e3, -1e-4] + rng.normal(size=n)))
    return h, y


def feed(h, y, sizes, start: int = 0) -> CrossFit:
    fit = CrossFit(h.shape[1])
    first = start
    for size in sizes:
        part = slice(first - start, first - start + size)
        fit.add(first, h[part], y[part])
        first += size
    return fit


def reference(h, y, mean, covariance):
    """Rate, its standard error and mean β, test by test."""
    n, fold = len(y), np.arange(len(y)) % FOLDS
    z, beta = np.empty(n), np.zeros(h.shape[1])
    for k in range(FOLDS):
        inside = fold == k
        others = np.cov(np.column_stack([h, y])[~inside].T, bias=True)
        fitted = np.linalg.solve(others[:-1, :-1] / n + covariance, others[:-1, -1] / n)
        z[inside] = y[inside] - (h[inside] - mean) @ fitted
        beta += fitted * inside.mean()
    third_moment = np.sum((z - z.mean()) ** 3) / n**3
    return z.mean(), np.sqrt(z.var(ddof=1) / n + beta @ covariance @ beta), third_moment, beta


@pytest.mark.parametrize("error", [0.0, 0.02, 10.0])
def test_is_the_regression_on_the_other_folds(error):
    h, y = rows()
    mean, covariance = MEAN * SCALE, np.diag((error * SCALE) ** 2)
    found = feed(h, y, [N]).result(mean, covariance)
    rate, std_error, third_moment, beta = reference(h, y, mean, covariance)
    assert found.rate == pytest.approx(rate, rel=1e-10)
    assert found.std_error == pytest.approx(std_error, rel=1e-9)
    assert found.third_moment == pytest.approx(third_moment, rel=1e-6)
    np.testing.assert_allclose(found.beta, beta, rtol=1e-8)
    assert (found.known_share > 0.0) == (error > 0.0)


def test_a_column_of_unknown_mean_drops_out():
    h, y = rows()
    found = feed(h, y, [N]).result(MEAN * SCALE, np.diag((1e9 * SCALE) ** 2))
    assert found.rate == pytest.approx(y.mean(), rel=1e-9)
    assert found.std_error == pytest.approx(y.std(ddof=1) / np.sqrt(N), rel=1e-6)


def test_shards_do_not_matter():
    h, y = rows()
    whole = feed(h, y, [N]).result(MEAN * SCALE, np.zeros((2, 2)))
    result = feed(h, y, [1, 2, 500, 500]).result(MEAN * SCALE, np.zeros((2, 2)))
    assert result.rate == pytest.approx(whole.rate, rel=1e-11)
    assert result.std_error == pytest.approx(whole.std_error, rel=1e-11)


@pytest.mark.parametrize("n", [1, 2, 11])
def test_few_tests_give_a_finite_rate_and_claim_little(n):
    h, y = rows(n)
    found = feed(h, y, [n]).result(MEAN * SCALE, np.zeros((2, 2)))
    assert np.isfinite(found.rate)
    assert n > 1 or found.std_error == np.inf


def test_without_a_crash_everything_is_zero():
    h, _ = rows()
    found = feed(h, np.zeros(N), [N]).result(MEAN * SCALE, np.zeros((2, 2)))
    assert (found.rate, found.std_error) == (0.0, 0.0)
