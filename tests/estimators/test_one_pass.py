"""One pass feeds all estimators, keeps the order, and follows the headline on growing prefixes."""

import numpy as np
import pytest

from harness.estimators import ESTIMATORS, Estimate, Unavailable, accumulator, one_pass
from harness.methods import SAMPLING
from harness.studies.chains.named import overtaking
from harness.studies.chains.sampler import blocks
from tests.chains.seed import SEED

CHAIN = overtaking("short", skill=0.5, surrogates=[0.5, 0.2, 0.8], level=0.02, horizon=5)
METHODS = ["nde", "forced", "step_mixture", "episode_mixture"]


@pytest.mark.parametrize("method", METHODS)
def test_each_estimator_gets_what_it_would_get_alone(method):
    parts = list(blocks(CHAIN, method, [1_000] * 4, SEED))
    together = one_pass(iter(parts)).estimates
    for name, estimate in together.items():
        alone = accumulator(name)
        reason = alone.seen.refusal(parts[0])
        if reason is not None:
            assert estimate == Unavailable(reason)
            assert estimate.to_json() == {"crash_rate": None, "reason": reason}
            continue
        for part in parts:
            alone.add(part)
        assert estimate == alone.result(0.9)
    assert set(together) == set(ESTIMATORS)
    assert isinstance(together[SAMPLING[method].headline], Estimate)


@pytest.mark.parametrize("method", METHODS)
def test_convergence_is_the_headline_on_prefixes(method):
    parts = list(blocks(CHAIN, method, [500] * 6, SEED))
    points = one_pass(parts).convergence
    assert [point["n"] for point in points] == [500, 1_000, 1_500, 2_000, 2_500, 3_000]
    for k in (1, 3, 6):
        prefix = one_pass(parts[:k]).headline_estimate
        assert (points[k - 1]["crash_rate"], points[k - 1]["rhw"]) == (prefix.crash_rate, prefix.precision)


def test_convergence_points_are_thinned_but_end_at_the_end():
    parts = list(blocks(CHAIN, "nde", [10] * 400, SEED))
    numbers = np.array([point["n"] for point in one_pass(parts).convergence])
    assert numbers[-1] == 4_000
    assert np.all(numbers[1:-1] >= 1.01 * numbers[:-2])
    assert len(numbers) < 300


def test_a_gap_is_refused():
    first, second, third = blocks(CHAIN, "nde", [10] * 3, SEED)
    with pytest.raises(ValueError, match="expected a block from episode 10 on, got one from 20"):
        one_pass([first, third])
    with pytest.raises(ValueError, match="expected a block from episode 0"):
        one_pass([second])
    with pytest.raises(ValueError, match="at least one episode"):
        one_pass([])
