"""Control variates against an ordinary least-squares solver with explicit columns."""

import numpy as np
import pytest

from harness.estimators.limits import normal_half_width, skewed_distances
from harness.estimators.scv import MixtureCv
from studies.chains.chain import panel
from studies.chains.sampler import blocks, draw
from tests.chains.seed import SEED

from .small_blocks import block, fed

CHAIN = panel()[0]


def reference(parts) -> tuple[float, float]:
    """Intercept and its standard error, with one column left out instead of an SVD."""
    y = np.concatenate([part.weighted_crashes() for part in parts])
    h = np.concatenate([part.mixture_ratios() for part in parts])[:, 1:] - 1.0
    x = np.column_stack([np.ones(len(y)), h])
    coefficients, residual, rank, _ = np.linalg.lstsq(x, y, rcond=None)
    assert rank == x.shape[1]
    variance = residual[0] / (len(y) - rank) * np.linalg.inv(x.T @ x)[0, 0]
    return float(coefficients[0]), float(np.sqrt(variance))


def test_is_the_intercept_of_least_squares():
    parts = list(blocks(CHAIN, "episode_mixture", [4_000, 1_000, 3_000], SEED))
    estimate = fed(MixtureCv(), parts).result(0.9)
    rate, std_error = reference(parts)
    assert estimate.crash_rate == pytest.approx(rate, rel=1e-11)
    assert estimate.std_error == pytest.approx(std_error, rel=1e-9)
    assert estimate.details["rank"] == len(parts[0].drawn.alpha)
    assert estimate.crash_rate != estimate.details["plain_mean"]


def test_the_interval_is_as_skewed_as_the_residuals():
    parts = list(blocks(CHAIN, "episode_mixture", [400, 100], SEED))
    estimate = fed(MixtureCv(), parts).result(0.9)
    y = np.concatenate([part.weighted_crashes() for part in parts])
    h = np.concatenate([part.mixture_ratios() for part in parts]) - 1.0
    residuals = y - estimate.crash_rate - h @ estimate.details["beta"]
    below, above = skewed_distances(estimate.std_error, np.sum(residuals**3) / len(y) ** 3, 0.05)
    assert estimate.ci_high - estimate.crash_rate == pytest.approx(above, rel=1e-9)
    assert estimate.crash_rate - estimate.ci_low == pytest.approx(min(below, estimate.crash_rate), rel=1e-9)
    assert above > 1.01 * normal_half_width(estimate.std_error, 0.9)


def test_control_that_never_acted_leaves_the_plain_mean():
    state = fed(MixtureCv(), [block([True, False, False, True], method="episode_mixture", weight_cap=1.0)])
    estimate = state.result(0.9)
    assert estimate.crash_rate == pytest.approx(0.5, rel=1e-14)
    assert estimate.details["rank"] == 1
    assert estimate.std_error == pytest.approx(np.std([1, 0, 0, 1], ddof=1) / 2.0, rel=1e-12)


def test_fewer_tests_than_columns_claim_no_precision():
    one = draw(CHAIN, "episode_mixture", 1, np.random.default_rng(SEED))
    assert fed(MixtureCv(), [one]).result(0.9).std_error == np.inf
