"""A controller that acts from the start meets the methods that do not need to know the AV's speed."""

import numpy as np
import pytest

from harness.controllers.hosts import BatchHost, Guard
from harness.errors import CampaignError
from harness.vocabulary import PASSED
from tests.controllers.driving import ROOT, drive, forced

EARLY = "av={controller: 'tests.controllers.test_before_cut_in:Faster', before_cut_in: controller}"


class Faster:
    """Accelerates until someone is ahead, and remembers nothing but that."""

    def start(self, episode):
        self.steps = 0

    def step(self, seen):
        assert seen.time_s == pytest.approx(0.1 * self.steps)
        self.steps += 1
        ahead = np.isfinite(seen.gap_m)
        assert ahead == (seen.bv.lane == 0)
        assert ahead or np.isnan(seen.lead_speed_mps)
        return -3.0 if ahead else 0.5

    def close(self):
        pass


@pytest.mark.parametrize("method", ["nde", "step_mixture"])
def test_a_controller_acts_from_the_first_step(method, monkeypatch):
    monkeypatch.chdir(ROOT)
    shard = drive(EARLY, f"testing={{method: {method}}}", "environment.lane_change_level=350", n=300)
    assert shard.failures == {}
    rows = shard.results.episode
    cut = np.flatnonzero(rows["cut_in_step"] > 0)
    assert cut.size > 0
    for i in range(300):
        av = shard.traces[i][:, 2]
        last = rows["cut_in_step"][i] if rows["cut_in_step"][i] >= 0 else len(av) - 1
        np.testing.assert_array_equal(av[:last, 2], 0.5)
    passed = np.flatnonzero(rows["outcome"] == PASSED)
    assert passed.size > 0
    for i in passed:
        r2 = shard.traces[i][:, 1, 0] - 5.0 - shard.traces[i][:, 2, 0]
        assert r2[-1] < -10.0 <= r2[-2]


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
