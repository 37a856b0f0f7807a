"""Control variates: equal to independent solutions; the published ones, to nade too."""

import itertools

import numpy as np
import pytest

from harness.estimators.block import Block
from harness.estimators.likelihood import Level
from harness.estimators.limits import skewed_distances
from harness.estimators.scv import CHUNK_ROWS, MixtureCv, Scv, Stratum, n_columns, steps_used
from harness.estimators.weighted import Nade
from harness.report.notes import note_words
from studies.chains.chain import DECISIVE, PANEL, overtaking
from tests.chains import SEED
from tests.estimators.small_blocks import block, blocks, fed

SMALL = overtaking("short", skill=0.5, surrogates=[0.5, 0.2, 0.8], level=0.02, horizon=5)
LONG = overtaking("long", skill=0.5, surrogates=[0.5, 0.2, 0.8], level=0.02, horizon=12)
MANY = PANEL[0]


def algorithm_1(parts: list[Block]) -> tuple[float, float, dict[int, tuple[int, int, int]]]:
    """Estimate, var(Z) and per stratum (n, columns, rank), from the paper: explicit columns, explicit centring."""
    y = np.concatenate([part.weighted_crashes() for part in parts])
    ratios = np.concatenate([part.first_ratios for part in parts])
    levels = np.concatenate([part.n_control_steps for part in parts])
    n, estimate, z, strata = len(y), 0.0, [], {}
    for level in np.unique(levels):
        rows = levels == level
        steps, functions = min(int(level), 9), ratios.shape[2] - 1
        choices = itertools.product(range(functions), repeat=steps) if steps else ()
        products = [ratios[rows][:, range(steps), js].prod(axis=1) for js in choices]
        columns = np.column_stack(products) if products else np.empty((rows.sum(), 0))
        centred = columns - columns.mean(axis=0)
        x = np.column_stack([np.ones(rows.sum()), centred])
        coefficients = np.linalg.lstsq(x, y[rows], rcond=None)[0]
        estimate += rows.sum() * coefficients[0] / n
        z.append(y[rows] - centred @ coefficients[1:])
        rank = int(np.linalg.matrix_rank(centred)) if products else 0
        strata[int(level)] = (int(rows.sum()), len(products), rank)
    return estimate, float(np.var(np.concatenate(z), ddof=1)) if n > 1 else 0.0, strata


@pytest.mark.parametrize("chain", [SMALL, DECISIVE[0], PANEL[1]], ids=lambda chain: chain.name)
def test_equals_an_independently_solved_regression_and_nade(chain):
    parts = list(blocks(chain, "step_mixture", [5_000, 2_000], SEED))
    estimate, nade = fed(Scv(), parts).result(0.9), fed(Nade(), parts).result(0.9)
    rate, var_z, strata = algorithm_1(parts)
    assert rate == pytest.approx(nade.crash_rate, rel=1e-12)
    assert estimate.crash_rate == pytest.approx(nade.crash_rate, rel=1e-12)
    assert estimate.details["var_z"] == pytest.approx(var_z, rel=1e-8)
    assert estimate.details["nade_std_error"] == pytest.approx(nade.std_error, rel=1e-12)
    found = {s["n_control_steps"]: (s["n"], s["columns"], s["rank"]) for s in estimate.details["strata"]}
    assert {level: fit[:2] for level, fit in found.items()} == {level: fit[:2] for level, fit in strata.items()}
    assert all(abs(found[level][2] - strata[level][2]) <= 1 for level in found)


@pytest.mark.parametrize(
    ("chain", "cuts"),
    [
        (SMALL, [0, 7, 1_000, CHUNK_ROWS, CHUNK_ROWS + 1, 3 * CHUNK_ROWS]),
        (PANEL[1], range(0, 9_001, 500)),  # the whole on threads, the pieces without
    ],
    ids=["few strata", "many strata"],
)
def test_how_blocks_are_cut_does_not_matter(chain, cuts):
    (whole,) = blocks(chain, "step_mixture", [cuts[-1]], SEED)
    parts = [whole.take(slice(a, b)) for a, b in itertools.pairwise(cuts)]
    asked = Scv()
    for part in parts:
        asked.add(part)
        cut = asked.result(0.9)  # asking leaves the state as it is
    one = fed(Scv(), [whole]).result(0.9)
    assert (cut.crash_rate, cut.std_error) == (one.crash_rate, one.std_error)
    assert cut.details["strata"] == one.details["strata"]
    assert cut.n_effective == pytest.approx(one.n_effective, rel=1e-12)


def test_strata_above_nine_control_steps_use_nine_and_may_have_more_columns_than_episodes():
    parts = list(blocks(LONG, "step_mixture", [200], SEED))
    estimate = fed(Scv(), parts).result(0.9)
    levels, n, columns, rank = np.array([list(s.values()) for s in estimate.details["strata"]]).T
    assert np.all(columns[levels > 9] == 2**9)
    assert levels[columns > n].max() > 9
    expected = [(9, 0), (9, 1), (9, 512), (6, 729), (3, 729)]
    assert [(steps_used(9, j), n_columns(9, j)) for j in (1, 2, 3, 4, 10)] == expected
    assert np.all(rank < np.maximum(1, n))
    assert estimate.crash_rate == pytest.approx(np.mean(parts[0].weighted_crashes()), rel=1e-12, abs=1e-300)


def test_columns_that_never_vary_explain_nothing():
    """What centring rounds away must not be fitted as if it were data."""
    stratum, y = Stratum(9), np.random.default_rng(1).exponential(size=20)
    stratum.add(np.full((20, 9, 3), [1.0 / 0.7, 0.1 / 0.7, 1.0 / 0.7]), y)
    fit = stratum.fit()
    assert (fit.n_columns, fit.rank) == (512, 0)
    assert fit.residual_squares == pytest.approx(np.sum((y - y.mean()) ** 2), rel=1e-12)


def test_mixture_cv_is_the_intercept_of_least_squares():
    """With one column left out instead of an SVD."""
    parts = list(blocks(MANY, "episode_mixture", [4_000, 1_000, 3_000], SEED))
    estimate = fed(MixtureCv(), parts).result(0.9)
    y = np.concatenate([part.weighted_crashes() for part in parts])
    h = np.concatenate([part.mixture_ratios() for part in parts])[:, 1:] - 1.0
    x = np.column_stack([np.ones(len(y)), h])
    coefficients, residual, rank, _ = np.linalg.lstsq(x, y, rcond=None)
    variance = residual[0] / (len(y) - rank) * np.linalg.inv(x.T @ x)[0, 0]
    assert estimate.details["rank"] == rank == len(parts[0].drawn.alpha)
    assert estimate.crash_rate == pytest.approx(coefficients[0], rel=1e-11)
    assert estimate.std_error == pytest.approx(np.sqrt(variance), rel=1e-9)
    assert estimate.crash_rate != estimate.details["plain_mean"]


def test_the_interval_is_as_skewed_as_the_residuals():
    parts = list(blocks(MANY, "episode_mixture", [400, 100], SEED))
    estimate = fed(MixtureCv(), parts).result(0.9)
    y = np.concatenate([part.weighted_crashes() for part in parts])
    h = np.concatenate([part.mixture_ratios() for part in parts]) - 1.0
    residuals = y - estimate.crash_rate - h @ estimate.details["beta"]
    below, above = skewed_distances(estimate.std_error, np.sum(residuals**3) / len(y) ** 3, 0.05)
    assert estimate.ci_high - estimate.crash_rate == pytest.approx(above, rel=1e-9)
    assert estimate.crash_rate - estimate.ci_low == pytest.approx(min(below, estimate.crash_rate), rel=1e-9)
    assert above > 1.01 * Level.two_sided(0.9).z * estimate.std_error


@pytest.mark.slow
def test_results_that_columns_do_not_explain_have_no_gain_once_corrected():
    """512 columns of noise fit half of 1,000 results of noise: a claimed gain of 2."""
    rng, stratum = np.random.default_rng(SEED), Stratum(9)
    stratum.add(rng.uniform(0.5, 1.5, (1_000, 9, 3)), rng.normal(size=1_000))
    fit = stratum.fit()
    claimed, fair = (fit.total_squares / left for left in fit.squares().values())
    assert (fit.rank, fit.is_saturated) == (512, False)
    assert 1.7 < claimed < 2.4
    assert 0.7 < fair < 1.35


@pytest.mark.parametrize(("times", "rank"), [(0.5, 1), (2.0, 2)])
def test_the_tolerance_of_ranks_is_the_documented_one(times, rank):
    """Two columns around means of 3 and 40; the second varies by a multiple of the tolerance (docs/scv-defect.md)."""
    n, ratios = 400, np.ones((400, 9, 3))
    tolerance = n * np.finfo(np.float64).eps * np.sqrt(n) * np.sqrt(1.0 + 3.0**2 + 40.0**2)
    angle = 2.0 * np.pi * np.arange(n) / n
    ratios[:, 0, 0] = 3.0 + np.sin(angle)
    ratios[:, 0, 1] = 40.0 + times * tolerance * np.sqrt(2.0 / n) * np.cos(angle)
    stratum = Stratum(1)
    stratum.add(ratios, np.zeros(n))
    assert stratum.fit().rank == rank


def test_saturated_strata_are_warned_of():
    parts = list(blocks(LONG, "step_mixture", [200], SEED))
    estimate = fed(Scv(), parts).result(0.9)
    gain = estimate.details["gain"]
    expected = [s["n_control_steps"] for s in estimate.details["strata"] if 0 < s["rank"] >= s["n"] - 1]
    assert gain["saturated"] == expected != []
    assert any("saturated (l = " in note_words(warning) for warning in estimate.warnings)
    assert gain["claimed"] == pytest.approx(estimate.details["var_y"] / estimate.details["var_z"], rel=1e-9)


def test_fewer_tests_than_columns_claim_no_precision():
    one = blocks(MANY, "episode_mixture", [1], SEED)
    assert fed(MixtureCv(), one).result(0.9).std_error == np.inf


def test_control_that_never_acted_leaves_the_plain_mean():
    some = block([True, False, False, True], method="episode_mixture", weight_cap=1.0)
    estimate = fed(MixtureCv(), [some]).result(0.9)
    assert estimate.crash_rate == pytest.approx(0.5, rel=1e-14)
    assert estimate.details["rank"] == 1
    assert estimate.std_error == pytest.approx(np.std([1, 0, 0, 1], ddof=1) / 2.0, rel=1e-12)
