"""The published estimator: equal to an independent solution, equal to nade, and warned of."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from harness.estimators.nade import Nade
from harness.estimators.scv import WARNING, Scv
from harness.estimators.scv_columns import n_columns, product_columns, steps_used
from harness.estimators.scv_stratum import CHUNK_ROWS, Stratum
from harness.studies.chains.named import frequent_decisive, overtaking, panel
from harness.studies.chains.sampler import blocks
from tests.chains.seed import SEED

from .scv_reference import algorithm_1
from .small_blocks import block

SMALL = overtaking("short", skill=0.5, surrogates=[0.5, 0.2, 0.8], level=0.02, horizon=5)


def feed(parts, **settings) -> Scv:
    state = Scv(**settings)
    for part in parts:
        state.add(part)
    return state


@pytest.mark.parametrize(
    ("chain", "basis"),
    [(SMALL, "reduced"), (SMALL, "full"), (frequent_decisive(), "reduced"), (panel()[1], "reduced")],
    ids=["reduced", "full", "decisive", "two surrogates"],
)
def test_equals_an_independently_solved_regression_and_nade(chain, basis):
    parts = list(blocks(chain, "step_mixture", [5_000, 2_000], SEED))
    estimate = feed(parts, basis=basis).result(0.9)
    rate, var_z, strata = algorithm_1(parts, chain.n_surrogates - (basis == "reduced"))
    plain = Nade()
    for part in parts:
        plain.add(part)
    nade = plain.result(0.9)
    assert rate == pytest.approx(nade.crash_rate, rel=1e-12)
    assert estimate.crash_rate == pytest.approx(nade.crash_rate, rel=1e-12)
    assert estimate.details["var_z"] == pytest.approx(var_z, rel=1e-8)
    assert estimate.details["nade_std_error"] == pytest.approx(nade.std_error, rel=1e-12)
    found = {s["n_control_steps"]: (s["n"], s["columns"], s["rank"]) for s in estimate.details["strata"]}
    assert {level: fit[:2] for level, fit in found.items()} == {level: fit[:2] for level, fit in strata.items()}
    assert all(abs(found[level][2] - strata[level][2]) <= 1 for level in found)


def test_the_claimed_variance_is_below_nades_by_the_fit_alone():
    estimate = feed(blocks(SMALL, "step_mixture", [5_000], SEED)).result(0.9)
    assert estimate.details["var_z"] < estimate.details["var_y"]
    assert estimate.std_error < estimate.details["nade_std_error"]


def test_always_carries_its_warning():
    assert WARNING in feed(blocks(SMALL, "step_mixture", [100], SEED)).result(0.9).warnings


def test_how_blocks_are_cut_does_not_matter():
    (whole,) = blocks(SMALL, "step_mixture", [3 * CHUNK_ROWS], SEED)
    cuts = [0, 7, 1_000, CHUNK_ROWS, CHUNK_ROWS + 1, 3 * CHUNK_ROWS]
    parts = [whole.take(slice(a, b)) for a, b in itertools.pairwise(cuts)]
    one, cut = feed([whole]).result(0.9), feed(parts).result(0.9)
    assert (cut.crash_rate, cut.std_error, cut.details["strata"]) == (
        one.crash_rate,
        one.std_error,
        one.details["strata"],
    )
    assert cut.n_effective == pytest.approx(one.n_effective, rel=1e-12)


def test_asking_leaves_the_state_as_it_is():
    parts = list(blocks(SMALL, "step_mixture", [3_000, 3_000], SEED))
    asked = feed(parts[:1])
    asked.result(0.9)
    asked.add(parts[1])
    assert asked.result(0.9) == feed(parts).result(0.9)


def test_more_than_nine_control_steps_keep_their_stratum_and_use_nine():
    parts = list(blocks(panel()[1], "step_mixture", [2_000], SEED))
    strata = {s["n_control_steps"]: s for s in feed(parts, basis="full").result(0.9).details["strata"]}
    assert max(strata) > 9
    assert strata[max(strata)]["columns"] == 2**9


def test_fewer_episodes_than_columns_leave_no_residual_but_the_same_estimate():
    parts = list(blocks(panel()[3], "step_mixture", [200], SEED))
    estimate = feed(parts, basis="full").result(0.9)
    assert all(s["rank"] < max(1, s["n"]) for s in estimate.details["strata"])
    assert estimate.crash_rate == pytest.approx(np.mean(parts[0].weighted_crashes()), rel=1e-12, abs=1e-300)


def test_columns_that_never_vary_explain_nothing():
    """What centring rounds away must not be fitted as if it were data."""
    rng = np.random.default_rng(1)
    stratum = Stratum(9, "reduced")
    y = rng.exponential(size=20)
    stratum.add(np.full((20, 9, 3), [1.0 / 0.7, 0.1 / 0.7, 1.0 / 0.7]), y)
    fit = stratum.fit()
    assert (fit.n_columns, fit.rank) == (512, 0)
    assert fit.residual_squares == pytest.approx(np.sum((y - y.mean()) ** 2), rel=1e-12)


@pytest.mark.parametrize("n", [2, 31, 33, 34, 35, 100])
def test_a_factor_of_few_rows_fits_as_the_square_one_does(n):
    rng = np.random.default_rng(n)
    ratios, y = rng.uniform(0.5, 1.5, size=(n, 9, 3)), rng.exponential(size=n)
    stratum = Stratum(5, "reduced")
    stratum.add(ratios, y)
    fit = stratum.fit()
    whole = block([True] * n, list(np.log(y)), first_ratios=ratios, n_control_steps=np.full(n, 5))
    _, var_z, strata = algorithm_1([whole], 2)
    assert (fit.n, fit.n_columns, fit.rank) == strata[5]
    assert fit.intercept == pytest.approx(np.mean(y), rel=1e-12)
    assert fit.residual_squares == pytest.approx(var_z * (n - 1), rel=1e-8, abs=1e-15)


def test_one_episode_is_its_own_mean_with_nothing_left():
    stratum = Stratum(5, "reduced")
    stratum.add(np.full((1, 9, 3), 1.2), np.array([0.25]))
    fit = stratum.fit()
    assert (fit.n, fit.n_columns, fit.rank, fit.residual_squares) == (1, 32, 0, 0.0)
    assert fit.intercept == pytest.approx(0.25, rel=1e-12)


def test_large_blocks_on_threads_give_the_bits_of_small_ones():
    parts = list(blocks(panel()[1], "step_mixture", [9_000], SEED))
    assert len(parts) == 1
    pieces = [parts[0].take(slice(start, start + 500)) for start in range(0, 9_000, 500)]
    one, cut = feed(parts).result(0.9), feed(pieces).result(0.9)
    assert (cut.crash_rate, cut.std_error, cut.details["strata"]) == (
        one.crash_rate,
        one.std_error,
        one.details["strata"],
    )


def test_columns_are_products_in_the_order_of_vec():
    ratios = np.arange(1.0, 2 * 9 * 3 + 1).reshape(2, 9, 3)
    columns = product_columns(ratios, 2, "reduced")
    expected = [[r[0, i] * r[1, j] for i in range(2) for j in range(2)] for r in ratios]
    np.testing.assert_array_equal(columns, expected)
    assert product_columns(ratios, 0, "full").shape == (2, 0)


@pytest.mark.parametrize(
    ("level", "surrogates", "basis", "steps", "columns"),
    [
        (0, 3, "full", 0, 0),
        (6, 3, "full", 6, 729),
        (9, 3, "full", 6, 729),
        (30, 3, "reduced", 9, 512),
        (9, 4, "reduced", 6, 729),
        (9, 2, "reduced", 9, 1),
        (9, 1, "reduced", 9, 0),
        (3, 10, "reduced", 3, 729),
        (3, 10, "full", 2, 100),
    ],
)
def test_columns_stay_within_729(level, surrogates, basis, steps, columns):
    assert steps_used(level, surrogates, basis) == steps
    assert n_columns(level, surrogates, basis) == columns


def test_is_refused_without_moments_or_for_other_methods():
    assert "first_9" in (Scv.refusal(block([True])) or "")
    assert "step mixture" in (Scv.refusal(block([True], method="forced")) or "")
    with pytest.raises(ValueError, match="first_ratios"):
        Scv().add(block([True]))
