"""Plain means: identities, failed episodes both ways, what is said when little is known."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, binomtest

from harness.estimators.likelihood import Level
from harness.estimators.limits import _hall, capped_mean_upper, clopper_pearson, skewed_distances
from harness.estimators.weighted import Moments, Nade
from harness.report.notes import note_words
from tests.estimators.small_blocks import block, fed


def nade(*blocks) -> Nade:
    return fed(Nade(), blocks)


@given(st.lists(st.tuples(st.booleans(), st.floats(-40.0, 3.0)), min_size=1, max_size=40))
def test_is_the_mean_with_its_standard_error(rows):
    estimate = nade(block([crash for crash, _ in rows], [weight for _, weight in rows])).result(0.9)
    y = np.array([math.exp(weight) if crash else 0.0 for crash, weight in rows])
    assert estimate.crash_rate == pytest.approx(min(y.mean(), 1.0), rel=1e-12)
    assert estimate.ci_low <= estimate.crash_rate * (1.0 + 1e-12)
    assert estimate.crash_rate <= estimate.ci_high or not y.any()
    if len(y) > 1 and y.any():
        assert estimate.std_error == pytest.approx(y.std(ddof=1) / math.sqrt(len(y)), rel=1e-6, abs=1e-9 * y.mean())
        assert estimate.n_effective == pytest.approx(y.sum() ** 2 / (y**2).sum(), rel=1e-9)
        assert estimate.largest_weight_share == pytest.approx(y.max() / y.sum(), rel=1e-12)


def test_no_crash_still_gives_an_upper_bound_and_an_interval():
    estimate = nade(block([False] * 100, method="forced", weight_cap=3e-4)).result(0.9)
    assert (estimate.crash_rate, estimate.ci_low) == (0.0, 0.0)
    assert estimate.upper_bound == pytest.approx(3e-4 * (1 - 0.1 ** (1 / 100)))
    assert estimate.ci_high == pytest.approx(3e-4 * (1 - 0.05 ** (1 / 100)))
    assert estimate.rhw == math.inf


def test_where_every_test_has_crashed_some_might_not_have():
    """Equal weights show no spread: the lower limit is that of a share."""
    estimate = nade(block([True] * 20, [math.log(0.5)] * 20, method="forced", weight_cap=0.5)).result(0.9)
    assert (estimate.crash_rate, estimate.ci_high) == pytest.approx((0.5, 0.5))
    assert estimate.ci_low == pytest.approx(0.5 * 0.05 ** (1 / 20))
    assert estimate.rhw == pytest.approx(0.5 * (1.0 - 0.05 ** (1 / 20)))


def test_the_cap_comes_from_the_design_or_from_the_paths():
    some, paths = ([True, False], [-7.0, 0.0]), np.log([1e-3, 2e-3])
    known = nade(block(*some, method="forced", weight_cap=5e-3, log_p_event=paths))
    driven = nade(block(*some, method="forced", log_p_event=paths))
    mixed = nade(block(*some, method="episode_mixture", alpha=np.array([0.1, 0.9]), log_p_event=paths))
    unknown = nade(block(*some, method="step_mixture"))
    assert known.cap() == (5e-3, "design")
    assert driven.cap()[0] == pytest.approx(2e-3)
    assert mixed.cap()[0] == pytest.approx(2e-3 / 0.1)  # over the defensive share
    assert unknown.cap() == (math.inf, "none")
    assert not any("upper bound rests" in note_words(w) for w in known.result(0.9).warnings)
    assert any("upper bound rests" in note_words(w) for w in driven.result(0.9).warnings)
    assert [(each.result(0.9).bound, each.result(0.9).cap) for each in (driven, unknown)] == [
        ("hoeffding", "tests"),
        ("hoeffding", "none"),
    ]
    assert unknown.result(0.9).upper_bound == 1.0


@pytest.mark.parametrize(
    ("weights", "cap", "told"),
    [
        ([0.0] + [-9.0] * 59, None, ["effective sample size", "one crash carries", "weights of these tests are unbou"]),
        ([0.0] * 60, 1e-3, ["contradict the campaign"]),
        ([0.0] * 3, 1.0, ["only 3 crashes"]),
        ([0.0] * 60, 1.0, []),
    ],
)
def test_what_a_user_must_be_told(weights, cap, told):
    method = "step_mixture" if cap is None else "forced"
    estimate = nade(block([True] * len(weights), weights, method=method, weight_cap=cap)).result(0.9)
    assert all(any(part in note_words(warning) for warning in estimate.warnings) for part in told)
    assert bool(estimate.warnings) == bool(told)
    assert list(estimate.warnings[: len(estimate.cautions)]) == list(estimate.cautions)
    assert (estimate.precision == math.inf) == (cap != 1.0)


@pytest.mark.parametrize(
    ("epsilon", "log_weight", "cap", "told"),
    [
        (1.0, 0.0, 1.0, ""),
        (0.99, 0.0, 0.99**-200, ""),
        (0.99, -9.0, 0.99**-200, "a crash may weigh 7.46, and all that were seen together weigh 7.40 × 10⁻³"),
        (0.1, 0.0, 1e200, "a crash may weigh 1.00 × 10²⁰⁰, and all that were seen together weigh 60.0"),
        (0.01, 0.0, math.inf, "the weights of these tests are unbounded"),
    ],
)
def test_a_step_mixture_has_the_cap_that_its_share_of_natural_driving_gives(epsilon, log_weight, cap, told):
    n = 60
    some = block([True] * n, [log_weight] * n, epsilon=epsilon, n_steps=np.array([20] * (n - 1) + [200]))
    found = nade(some).result(0.9)
    assert found.weight_cap == pytest.approx(cap)
    assert [note_words(each).partition(": ")[2] for each in found.cautions] == [told] * bool(told)


# -- running moments: exact, whatever the blocks, and of the zeros that were never added --


def moments(*blocks: list[float]) -> Moments:
    return sum((Moments.of(np.array(values, dtype=np.float64)) for values in blocks), Moments())


@pytest.mark.parametrize("size", [1, 10, 1_000])
def test_weights_over_many_decades_keep_twelve_digits_in_blocks_of_any_size(size):
    values = np.exp(np.random.default_rng(7).normal(-20.0, 3.0, 3_000))
    sums, n = moments(*np.split(values, range(size, len(values), size))), 10 * len(values)
    total, squares, cubes = (sum(Fraction(v) ** power for v in values.tolist()) for power in (1, 2, 3))
    mean = total / n
    assert sums.mean(n) == pytest.approx(float(mean), rel=1e-13)
    assert sums.variance(n) == pytest.approx(float((squares - total * mean) / (n - 1)), rel=1e-12)
    third = (cubes - 3 * mean * squares + 2 * n * mean**3) / n**3
    assert sums.third_moment(n) == pytest.approx(float(third), rel=1e-12)


@pytest.mark.parametrize(
    ("blocks", "n", "mean", "variance"),
    [
        ([[1.0, math.inf]], 3, math.inf, math.inf),
        ([[math.inf], [1.0], []], 3, math.inf, math.inf),
        ([[1e200], [0.0]], 2, 5e199, math.inf),
        ([[1.0]], 1, 1.0, math.inf),
        ([], 5, 0.0, 0.0),
    ],
)
def test_infinite_numbers_and_squares_decide_and_nothing_has_no_spread(blocks, n, mean, variance):
    sums = moments(*blocks)
    assert (sums.mean(n), sums.variance(n), sums.third_moment(n)) == (mean, variance, 0.0)
    assert sums.third_moment(0) == 0.0
    assert math.isnan(moments([math.inf], [-math.inf]).total)


# -- limits against scipy, and by exact enumeration of their coverage --


levels = st.floats(0.5, 0.999)


@given(st.integers(0, 60), st.integers(1, 60), levels)
def test_clopper_pearson_is_scipys_exact_interval(n_crashes, n, confidence):
    n = max(n, n_crashes)
    low, high = clopper_pearson(n_crashes, n, (1.0 - confidence) / 2.0)
    reference = binomtest(n_crashes, n).proportion_ci(confidence, method="exact")
    assert low == pytest.approx(reference.low, rel=1e-9, abs=1e-12)
    assert high == pytest.approx(reference.high, rel=1e-9)


@given(st.floats(1e-12, 1.0), st.floats(0.0, 1.0), st.integers(1, 10**9), levels)
def test_the_capped_bound_solves_hoeffdings_equation(cap, share, n, confidence):
    upper = capped_mean_upper(share * cap, cap, n, confidence)
    assert share * cap * (1.0 - 1e-12) <= upper <= cap * (1.0 + 1e-12)
    p = upper / cap
    if 1e-9 < share < 0.999 and p < 0.999 and share * n > 1e-3:
        entropy = share * math.log(share / p) + (1 - share) * (math.log1p(-share) - math.log1p(-p))
        assert n * entropy == pytest.approx(-math.log(1.0 - confidence), rel=1e-3)


@pytest.mark.parametrize("p", [0.003, 0.05, 0.4])
@pytest.mark.parametrize("n", [10, 200])
def test_the_capped_bound_holds_at_its_level_for_the_hardest_case(p, n):
    """Y is 0 or the cap: the exact probability that the bound fails, summed over all counts."""
    cap, confidence = 3e-4, 0.9
    counts = np.arange(n + 1)
    bounds = np.array([capped_mean_upper(cap * c / n, cap, n, confidence) for c in counts])
    assert binom.pmf(counts[bounds < cap * p], n, p).sum() <= 1.0 - confidence


@given(st.floats(-2.0, 2.0).filter(lambda k: k == 0.0 or abs(k) > 1e-9), st.floats(-3.0, 3.0))
def test_halls_transformation_is_inverted(skewness, z):
    t = _hall(z, skewness) if skewness else z
    assert t + skewness * t * t / 3.0 + skewness**2 * t**3 / 27.0 + skewness / 6.0 == pytest.approx(z, abs=1e-6)


@given(st.floats(1e-9, 1.0), st.floats(-1.0, 1.0), levels)
def test_limits_reach_as_far_as_the_normal_ones_and_lean_to_the_side_of_the_skew(std_error, skewness, confidence):
    below, above = skewed_distances(std_error, skewness * std_error**3, (1.0 - confidence) / 2.0)
    mirrored = skewed_distances(std_error, -skewness * std_error**3, (1.0 - confidence) / 2.0)
    assert (below, above) == pytest.approx(mirrored[::-1])
    assert min(below, above) >= Level.two_sided(confidence).z * std_error * (1.0 - 1e-12)
    if skewness > 1e-3 and confidence > 0.8:
        assert above > below
