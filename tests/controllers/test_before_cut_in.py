"""A controller that acts from the start meets the methods that do not need to know the AV's speed."""

import numpy as np
import pytest

from examples.idm import IDM
from harness.controllers.hosts import BatchHost, Guard
from harness.errors import CampaignError
from harness.vocabulary import PASSED
from tests.controllers.driving import drive, forced

EARLY = "av={controller: 'tests.controllers.test_before_cut_in:Faster', before_cut_in: controller}"


class Faster(IDM):
    """Accelerates until someone is ahead, and remembers nothing but its steps."""

    def start(self, episode):
        self.steps = 0

    def step(self, seen):
        assert seen.time_s == pytest.approx(0.1 * self.steps)
        self.steps += 1
        ahead = np.isfinite(seen.gap_m)
        assert ahead == (seen.bv.lane == 0)
        assert ahead or np.isnan(seen.lead_speed_mps)
        return -3.0 if ahead else 0.5


@pytest.mark.parametrize("method", ["nde", "step_mixture"])
def test_a_controller_acts_from_the_first_step(method):
    shard = drive(EARLY, f"testing={{method: {method}}}", "environment.lane_change_level=350", n=300)
    assert shard.failures == {}
    passed = cut_in = 0
    for i, row in enumerate(shard.results.episode):
        trace, cut = shard.traces[i], row["cut_in_step"]
        np.testing.assert_array_equal(trace[: cut if cut >= 0 else -1, 2, 2], 0.5)
        cut_in += cut > 0
        if row["outcome"] == PASSED:
            r2 = trace[:, 1, 0] - 5.0 - trace[:, 2, 0]
            assert r2[-1] < -10.0 <= r2[-2]
            passed += 1
    assert min(passed, cut_in) > 0


def test_a_method_that_draws_the_path_ahead_refuses_it():
    with pytest.raises(CampaignError, match=r"draws LV's and BV's path ahead.*shells \(or forced\)"):
        forced(EARLY, "testing={method: episode_mixture}")


def test_tests_of_one_baseline_run_that_begin_together_have_streams_of_their_own():
    """Both are told the same index: the second was given the rest of the first one's numbers, and its test failed."""
    seen = []

    class Draws:
        def start_batch(self, cells, episodes, random):
            seen.extend(stream.uniform(size=4) for stream in random)

        def step_batch(self, observation): ...
        def close(self): ...

    av = forced(EARLY).av
    host = BatchHost(Draws(), av, 7, Guard(av.limits, None))
    assert host.start(np.arange(3), np.arange(3), np.array([3, 5, 3])) == {}
    host.close()
    np.testing.assert_array_equal(seen[0], seen[2])
    assert not np.any(seen[0] == seen[1])
