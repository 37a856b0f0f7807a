"""Plain means: identities, failed episodes both ways, what is said when little is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.estimators.weighted import Nade, Nde

from .small_blocks import block, fed


def nade(*blocks) -> Nade:
    return fed(Nade(), blocks)


@given(st.lists(st.booleans(), min_size=1, max_size=50))
def test_without_control_nade_is_the_share_of_crashes(crash):
    some = block(crash, method="nde", weight_cap=1.0)
    assert nade(some).result(0.9).crash_rate == fed(Nde(), [some]).result(0.9).crash_rate == np.mean(crash)


@given(st.lists(st.tuples(st.booleans(), st.floats(-40.0, 3.0)), min_size=1, max_size=40))
def test_is_the_mean_with_its_standard_error(rows):
    estimate = nade(block([crash for crash, _ in rows], [weight for _, weight in rows])).result(0.9)
    y = np.array([math.exp(weight) if crash else 0.0 for crash, weight in rows])
    assert estimate.crash_rate == pytest.approx(y.mean(), rel=1e-12)
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


def test_the_cap_comes_from_the_design_then_from_the_paths_then_from_weights():
    some, paths = ([True, False], [-7.0, 0.0]), np.log([1e-3, 2e-3])
    known = nade(block(*some, method="forced", weight_cap=5e-3, log_p_cut_in=paths))
    driven = nade(block(*some, method="forced", log_p_cut_in=paths))
    mixed = nade(block(*some, method="episode_mixture", alpha=np.array([0.1, 0.9]), log_p_cut_in=paths))
    seen = nade(block(*some, method="step_mixture"))
    assert known.cap() == (5e-3, "the weight cap known by design")
    assert driven.cap()[0] == pytest.approx(2e-3)
    assert mixed.cap()[0] == pytest.approx(2e-3 / 0.1)  # over the defensive share
    assert seen.cap()[0] == pytest.approx(math.exp(-7.0))
    assert not any("upper bound rests" in w for w in known.result(0.9).warnings)
    for unknown in (driven, seen):
        assert any("upper bound rests" in w for w in unknown.result(0.9).warnings)
        assert unknown.cap()[1] in unknown.result(0.9).method


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
    assert all(any(part in warning for warning in estimate.warnings) for part in told)
    assert bool(estimate.warnings) == bool(told)
    assert list(estimate.warnings[: len(estimate.cautions)]) == list(estimate.cautions)
    assert (estimate.precision == math.inf) == (cap != 1.0)
