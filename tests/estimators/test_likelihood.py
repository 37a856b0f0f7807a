"""Likelihood-ratio limits, alone and beside a reference: against the definition, identities, exact coverage."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize
from scipy.special import betaincinv, gammaln, xlogy

from harness.estimators.beside import beside, preventable_share
from harness.estimators.likelihood import Level, contrast_limit, likelihood_limit, ratio_limits, spread
from harness.estimators.tally import Tally
from harness.strata import Reference
from tests.estimators.small_blocks import EXACT, SHELLS, tally


def _outcomes(share: Sequence[float], n: int) -> Iterator[tuple[float, np.ndarray]]:
    """How often ``n`` tests may have each outcome, the last being all that have no ``share``, and its probability."""
    counts = np.array([(*k, n - sum(k)) for k in product(range(n + 1), repeat=len(share)) if sum(k) <= n])
    shares = np.array([*share, max(1.0 - sum(share), 0.0)])
    chance = np.exp(gammaln(n + 1) - gammaln(counts + 1).sum(1) + xlogy(counts, shares).sum(1))
    likely = chance > 1e-6
    return zip(chance[likely].tolist(), counts[likely], strict=True)


def coverage(
    shares: Sequence[Sequence[float]],
    tests: Sequence[int],
    truth: float,
    limits: Callable[[np.ndarray], tuple[float, float]],
) -> float:
    """Probability that limits of counts (S, J) of independent strata hold the truth, unlikely counts being misses."""
    covered = 0.0
    for drawn in product(*(list(_outcomes(share, n)) for share, n in zip(shares, tests, strict=True))):
        chance = math.prod(probability for probability, _ in drawn)
        if chance > 1e-8:
            low, high = limits(np.array([counts for _, counts in drawn]))
            covered += chance * (low - 1e-9 <= truth <= high + 1e-9)  # up to rounding
    return covered


def tilted(a: np.ndarray, crashes: np.ndarray, tests: np.ndarray) -> tuple[np.ndarray, float]:
    """Shares nearest to those seen, tilted by ``a`` per test, as roots of a quadratic; and Σ n KL of them."""
    c = crashes / tests
    root = np.sqrt((1 - a) ** 2 + 4 * a * c)
    shares = np.where(a <= 1, 2 * c / (1 - a + root), (a - 1 + root) / (2 * np.where(a > 1, a, 1)))
    cost = xlogy(c, c) - xlogy(c, shares) + xlogy(1 - c, 1 - c) - xlogy(1 - c, 1 - shares)
    return shares, float((tests * cost).sum())


# -- limits of weighted sums and of ratios --


MANY = 1e6
"""A quantile so large that the threshold for few crashes always holds."""
STRATA = st.lists(
    st.tuples(st.floats(0.01, 100.0), *[st.integers(0, 30)] * 4), min_size=1, max_size=4, unique_by=lambda t: t[0]
).map(lambda rows: (np.array([p for p, *_ in rows]), np.array([counts for _, *counts in rows])))
"""Probabilities, and counts of the outcomes both, only A, only B, neither."""
DIFFERENCE = np.array([0.0, 1.0, -1.0, 0.0])


def both(weights, counts, level, variance=0.0):
    w, k = np.array(weights, float, order="C"), np.array(counts, order="C")  # of one layout, for which all is compiled
    return tuple(contrast_limit(w, k, level, side, variance) for side in (-1.0, 1.0))


def binomial(weights, crashes, tests, level, variance=0.0):
    w, k, n = np.array(weights, float), np.array(crashes), np.array(tests)
    return tuple(likelihood_limit(w, k, n, level, side, variance) for side in (-1.0, 1.0))


def closed_form(weights, crashes, tests, threshold, side):
    """Limit of binomial strata."""
    far = brentq(lambda nu: tilted(nu * weights / tests, crashes, tests)[1] - threshold, 0.0, side * 1e4, xtol=1e-14)
    return weights @ tilted(far * weights / tests, crashes, tests)[0]


def test_two_outcomes_are_a_binomial_stratum_to_nine_digits():
    rng = np.random.default_rng(3)
    for _ in range(50):
        tests = rng.integers(3, 400, 4)
        crashes, weights = rng.integers(1, tests), rng.uniform(0.1, 3.0, 4) * [1, -1, 1, 1]
        expected = [closed_form(weights, crashes, tests, 2.6, side) for side in (-1.0, 1.0)]
        assert binomial(weights, crashes, tests, Level(2.6, MANY)) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("counts", [[(3, 8, 2, 27), (0, 1, 0, 89)], [(0, 4, 0, 16), (5, 0, 0, 35)]])
def test_the_limit_is_the_largest_sum_that_shares_within_the_threshold_give(counts):
    k, w, level = np.array(counts), np.array([[1.0], [0.3]]) * [0.2, 1.0, -1.5, 0.0], Level(2.6, MANY)
    n = k.sum(1, keepdims=True)

    def shares(x):
        return np.exp(x.reshape(k.shape)) / np.exp(x.reshape(k.shape)).sum(1, keepdims=True)

    def room(x):
        return level.threshold - (xlogy(k, k / n) - xlogy(k, shares(x))).sum()

    how = {"constraints": {"type": "ineq", "fun": room}, "options": {"maxiter": 2000, "ftol": 1e-12}}
    for side in (-1.0, 1.0):
        found = minimize(lambda x, s=side: -s * (w * shares(x)).sum(), np.log(k + 0.3).ravel(), method="SLSQP", **how)
        assert contrast_limit(w, k, level, side) == pytest.approx(-side * found.fun, rel=1e-3)


@given(STRATA, st.sampled_from([0.9, 0.95, 0.99]), st.floats(0.0, 0.1))
@settings(deadline=None, max_examples=50)
def test_identities(strata, confidence, relative):
    p, counts = strata
    weights = p[:, None] * DIFFERENCE
    level, variance, slack = Level.two_sided(confidence), relative * float(p @ p), 1e-9 * float(p.sum())
    low, high = both(weights, counts, level, variance)
    shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    assert low - slack <= (weights * shares).sum() <= high + slack
    assert both(-weights, counts, level, variance) == pytest.approx((-high, -low), rel=1e-6, abs=slack)
    scaled = both(5.0 * weights, counts, level, 25.0 * variance)
    assert scaled == pytest.approx((5.0 * low, 5.0 * high), rel=1e-6, abs=slack)
    together = counts[:, :3] + np.outer(counts[:, 3], [1, 0, 0])  # outcomes of equal weight are one
    assert both(weights[:, :3], together, level, variance) == pytest.approx((low, high), rel=1e-6, abs=slack)
    order = [2, 0, 3, 1]
    assert both(weights[:, order], counts[:, order], level, variance) == pytest.approx((low, high), rel=1e-6, abs=slack)
    if counts[0, 3]:  # one pair more in which only A crashes
        more = counts + np.outer(np.eye(len(p), dtype=int)[0], [0, 1, 0, -1])
        assert np.all(np.array(both(weights, more, level, variance)) >= np.array((low, high)) - slack)


def test_a_stratum_without_a_test_may_have_any_outcome():
    assert both([[1.0, -2.0, 0.0]], [[0, 0, 0]], Level.two_sided(0.9)) == (-2.0, 1.0)
    tested = both([[1.0, -2.0, 0.0]], [[5, 1, 90]], Level.two_sided(0.9))
    more = both([[1.0, -2.0, 0.0], [0.5, -0.25, 0.0]], [[5, 1, 90], [0, 0, 0]], Level.two_sided(0.9))
    assert more == pytest.approx((tested[0] - 0.25, tested[1] + 0.5))


def rates(p):
    """Weights of outcomes in the rates of A and of B."""
    return np.outer(p, [1.0, 1.0, 0.0, 0.0]), np.outer(p, [1.0, 0.0, 1.0, 0.0])


def ratio(p, counts, level):
    return ratio_limits(*rates(p), np.array(counts, order="C"), level)


@given(STRATA)
@settings(deadline=None, max_examples=40)
def test_ratios_are_where_the_contrast_may_be_0_and_turn_over_with_the_vehicles(strata):
    (p, counts), level = strata, Level.two_sided(0.9)
    a, b = rates(p)
    low, high = ratio(p, counts, level)
    assert low <= high
    for x in (0.1, 0.5, 1.0, 3.0):
        lower, upper = both(a - x * b, counts, level)
        if not min(abs(math.log(x / end)) if 0.0 < end < math.inf else 1.0 for end in (low, high)) < 1e-6:
            assert (low <= x <= high) == (lower <= 0.0 <= upper)
    swapped = ratio(p, counts[:, [0, 2, 1, 3]], level)
    inverse = tuple(1.0 / end if end > 0.0 else math.inf for end in (high, low))
    assert swapped == pytest.approx(inverse, rel=1e-6)


def test_a_ratio_is_open_where_a_vehicle_has_not_crashed():
    level = Level.two_sided(0.9)
    assert ratio([1.0], [[0, 9, 0, 91]], level)[1] == math.inf
    assert ratio([1.0], [[0, 0, 9, 91]], level)[0] == 0.0
    assert ratio([1.0], [[0, 0, 0, 100]], level) == (0.0, math.inf)
    low, high = ratio([1.0], [[50, 0, 0, 0]], level)
    assert low < 1.0 < high


PAIRS = [
    (((0.47, 0.47),), (60,), [1.0]),
    (((0.03, 0.03),), (50,), [1.0]),
    (((0.12, 0.0),), (25,), [1.0]),
    (((0.5, 0.4), (0.02, 0.0)), (8, 60), [1.0, 6.0]),
    (((0.05, 0.0), (0.0, 0.1)), (30, 15), [1.0, 1.0]),
]
"""Of each stratum: shares of tests in which only A crashes, and only B; tests; its probability."""
RARE = [
    ((1.3 / 40, 1.7 / 40), (40, 40), [1.0, 1.0]),
    ((0.12, 0.004), (30, 400), [1.0, 12.0]),
    ((0.9, 0.02), (20, 60), [1.0, 2.0]),
    *((share, (12, 12, 30), [1.0, 3.0, 200.0]) for share in ((1.0, 0.3, 0.0), (0.6, 0.1, 0.002), (0.9, 0.5, 0.1))),
]
"""Few crashes decide: share of tests with a crash, tests, probability."""


@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.99])
@pytest.mark.parametrize(
    ("share", "tests", "weights"),
    [
        *((share, tests, np.outer(p, [1.0, -1.0, 0.0])) for share, tests, p in PAIRS),
        *(([(one,) for one in share], tests, np.outer(p, [1.0, 0.0])) for share, tests, p in RARE),
    ],
)
def test_limits_cover_whatever_the_counts(confidence, share, tests, weights):
    truth = (weights[:, :-1] * share).sum()
    assert coverage(share, tests, truth, lambda k: both(weights, k, Level.two_sided(confidence))) >= confidence


def test_pairs_taken_for_independent_tests_do_not_cover():
    """The sibling that must fail: each vehicle's crashes as if from tests of its own."""

    def limits(k):
        return binomial([1.0, -1.0], k[0, :2], [60, 60], Level.two_sided(0.95))

    assert coverage([(0.47, 0.47)], (60,), 0.0, limits) < 0.92


def test_without_the_empty_stratum_they_do_not():
    """The sibling that must fail: a stratum that was tested without a crash is left out of the limits."""

    def limits(k):
        return binomial([1.0, 3.0, 0.0], (12, k[0, 0], 0), (12, 12, 30), Level.two_sided(0.9))

    assert coverage([(0.3,)], [12], 5.9, limits) < 0.5


@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.99])
def test_limits_of_a_ratio_cover(confidence):
    """Of vehicles that crash together in 40 %, A alone in 25 %, B alone in 5 %: 1.44."""
    covered = coverage([(0.4, 0.25, 0.05)], (16,), 0.65 / 0.45, lambda k: ratio([1.0], k, Level.two_sided(confidence)))
    assert covered >= confidence - 1e-3  # what was left out


LEVEL = Level(Level.two_sided(0.9).threshold, MANY)


def test_further_tests_go_where_one_more_narrows_the_interval_most():
    """Against the interval itself, with a little more of each stratum; nowhere but where there is room."""
    rng, decided, room = np.random.default_rng(5), 0, np.full(4, 10)
    for _ in range(200):
        weights = 10.0 ** rng.uniform(-2.0, 0.0, (4, 1)) * np.array([1.0, 0.0])
        tests = rng.integers(5, 400, 4)
        crashes = rng.binomial(tests, rng.beta(0.3, 1.0, 4))
        counts = np.column_stack([crashes, tests - crashes])

        def width(s, counts=counts, weights=weights, tests=tests):
            grown = counts * np.where(np.arange(4) == s, 1.0 + 1e-3 / tests, 1.0)[:, None]
            return sum(side * contrast_limit(weights, grown, LEVEL, side) for side in (-1.0, 1.0))

        narrowed = np.array([width(None) - width(s) for s in range(4)])
        best, second = np.argsort(-narrowed)[:2]
        if narrowed[best] > 1.1 * max(narrowed[second], 1e-9):
            decided += 1
            is_best = np.arange(4) == best
            np.testing.assert_array_equal(spread(weights, counts, counts, LEVEL, 1, room), is_best)
            assert spread(weights, counts, counts, LEVEL, 100, np.where(is_best, 0, room))[best] == 0
    assert decided > 100


def test_strata_without_a_test_come_first_and_all_that_there_is_is_given():
    weights, counts = np.array([[1.0, 0.0], [1e-9, 0.0]]), np.array([[3, 7], [0, 0]])
    assert spread(weights, counts, counts, LEVEL, 1, np.array([5, 5])).tolist() == [0, 1]
    assert spread(weights, counts, counts, LEVEL, 100, np.array([5, 7])).tolist() == [5, 7]


def test_shares_end_at_0_and_1_and_without_a_crash_the_bound_is_the_exact_one_at_its_level():
    assert binomial([1.0], [0], [20], LEVEL)[0] == pytest.approx(0.0, abs=1e-12)
    assert binomial([1.0], [20], [20], LEVEL)[1] == pytest.approx(1.0, abs=1e-12)
    level = Level.of_bound(0.95, 50)
    bound = likelihood_limit(np.ones(1), np.zeros(1, int), np.array([50]), level, 1.0)
    assert bound == pytest.approx(betaincinv(1, 50, 1.0 - math.exp(-level.threshold)), rel=1e-9)
    assert 1.0 - math.exp(-level.threshold) > 0.95


# -- beside a reference driver --


FEW = Level(2.6, MANY)
"""The threshold for few crashes always holds."""
TWO_SIDED = Level.two_sided(0.9)
P = np.array([1e-7, 3e-7, 2e-6])


def ratio_to(p, found, n_paths, crashes_too, rate, square):
    """Limits of the rate over that of a reference which crashes on all events, or on none that are tested."""
    of_cells = {
        "strata": SHELLS.strata[: p.size],
        "cell_stratum": tuple(range(p.size)),
        "cell_p": p,
        "n_paths": n_paths,
    }
    known = {"reference_rate": np.array([rate]), "reference_square": np.array([square])}
    bits, references = (crashes_too,) * p.size, (Reference("r157-cc", "a driver"),)
    design = replace(SHELLS, **of_cells, **known, cell_references=bits, references=references)
    return beside(design, found, 0, p.size, TWO_SIDED)


@pytest.mark.parametrize("crashes", [(5, 9, 0), (0, 0, 0)])
def test_the_ratio_to_a_known_rate_is_the_rate_over_it(crashes):
    found = tally(P, crashes, (10, 20, 300))
    low, high = (likelihood_limit(P, found.crashes, found.tests, TWO_SIDED, side) / 2e-7 for side in (-1.0, 1.0))
    ratio = ratio_to(P, found, EXACT, 0, 2e-7, 4e-14)
    assert ratio == pytest.approx((low, high), rel=1e-6)
    assert (ratio[0] == 0.0) == (sum(crashes) == 0)


def test_the_reference_itself_is_as_often_as_itself_whatever_the_pool():
    """It crashes on all cut-ins of its cells: the error of the pool cancels where both crash on the same paths."""
    mass = np.random.default_rng(1).exponential(P[:1], 4_000)
    crashed = mass[np.random.default_rng(2).choice(4_000, 1_000_000, p=mass / mass.sum())]
    found = Tally(*(np.array([x]) for x in (1_000_000, 1_000_000, 0)), crashed.sum()[None, None], np.zeros((1, 1)))
    p, square = mass.mean(), (mass**2).mean()
    alone, both = (
        ratio_to(np.array([p]), found, 4_000, 0, p, p * p),
        ratio_to(np.array([p]), found, 4_000, 1, p, square),
    )
    assert alone[1] - alone[0] > 0.04
    assert both == pytest.approx((1.0, 1.0), abs=2e-3)


def least_cost(p, k, n, prevented, y):
    """Σ n KL at the shares nearest to those seen that have this share of crashes in the prevented cells."""
    weights, how = p * (prevented - y) / p.max(), {"xtol": 1e-14, "rtol": 1e-15, "maxiter": 1000}
    off = brentq(lambda nu: weights @ tilted(nu * weights / n, k, n)[0], -1e5, 1e5, **how)
    return tilted(off * weights / n, k, n)[1]


@pytest.mark.parametrize(("k", "n"), [((6, 9, 3), (40, 30, 200)), ((1, 20, 5), (25, 30, 400))])
def test_the_preventable_shares_are_those_that_some_crash_shares_explain(k, n):
    k, n, prevented = np.array(k), np.array(n), np.array([True, False, True])
    share, low, high = preventable_share(P, tally(np.zeros(3), k, n), prevented, EXACT, FEW)
    both = P * k / n
    assert share == pytest.approx(both[prevented].sum() / both.sum())
    assert low < share < high
    for limit in (low, high):
        assert least_cost(P, k, n, prevented, limit) == pytest.approx(FEW.threshold, rel=1e-5)


def test_failed_tests_count_as_whatever_is_worse():
    def found(crashes, failed=0):
        counts = tally(P[:2], crashes, (20, 30), failed)
        return preventable_share(P[:2], counts, np.array([True, False]), EXACT, TWO_SIDED)

    plain, failed = found((8, 9)), found((8, 9), (3, 4))
    assert failed[0] == plain[0]
    for crashes in product(range(8, 12), range(9, 14)):
        _, low, high = found(crashes)
        assert failed[1] <= low + 1e-9
        assert high <= failed[2] + 1e-9
    assert failed[1] < plain[1] < plain[2] < failed[2]


@pytest.mark.parametrize("share", [(0.9, 0.4, 0.0), (0.3, 0.1, 0.01), (0.02, 0.9, 0.05)])
def test_the_preventable_share_is_held_often_enough_whatever_the_counts(share):
    """Known answers: coverage summed over outcomes, nominal 0.90; and too narrow a level does not hold it."""
    tests, prevented, true = (8, 9, 14), np.array([True, False, True]), P * share
    truth = true[prevented].sum() / true.sum()

    def covered(level):
        def limits(counts):
            return preventable_share(P, tally(P, counts[:, 0], tests), prevented, EXACT, level)[1:]

        return coverage([(each,) for each in share], tests, truth, limits)

    assert covered(TWO_SIDED) >= 0.90
    assert covered(Level(0.3, 0.5)) < 0.85


def test_an_error_of_the_weights_alone_gives_the_normal_interval():
    limits = binomial([1.0], [10**12 // 4], [10**12], Level.two_sided(0.9), 0.01)
    assert limits == pytest.approx((0.25 - 1.6449 * 0.1, 0.25 + 1.6449 * 0.1), abs=2e-3)
