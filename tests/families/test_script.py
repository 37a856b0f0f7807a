"""What a script says beside motion: how long a test is, from when the AV acts, and whom it sees."""

from __future__ import annotations

import math
from contextlib import closing

import numpy as np
import pytest

from harness.loop.cells import natural_script
from harness.loop.loop import EpisodeLoop, RecordPolicy, Scenario
from harness.loop.repeat import Traffic
from harness.vocabulary import TIMEOUT
from harness.worlds.sumo import SumoWorld
from harness.worlds.twin import TwinWorld

STEPS, TESTS = 40, 6
NAMES = ("LV", "SV", "AV")
SCENARIO = Scenario(1, NAMES, 1, 0, STEPS, 1.7, False, np.zeros(0), ())


class Notes:
    """A host whose controller brakes with 1 m/s² and keeps what it was shown."""

    acts_before_event, warm_up_steps, cruises = False, 0, False

    def __init__(self):
        self.seen = []

    def start(self, *_):
        return {}

    def act(self, seen):
        self.seen += zip(*(getattr(seen, name) for name in (*ASKED, "episode")), strict=True)
        return np.full(len(seen.cell), -1.0), {}

    def require_untouched(self):
        pass


ASKED = "time_s", "gap_m", "lead_speed_mps", "bv_position_m", "lv_position_m"


def script(lv_leaves: int, **how):
    """LV 30 m ahead leaves the lane in a step; SV, 60 m ahead and slower, is revealed. They keep their speed."""
    x, v = np.tile([135.0, 165.0, 100.0], (TESTS, 1)), np.tile([30.0, 20.0, 30.0], (TESTS, 1))
    lanes = np.zeros((TESTS, STEPS, 2), np.int8)
    lanes[:, lv_leaves:, 0] = 1
    speed, at, lead = np.tile([30.0, 20.0], (TESTS, STEPS, 1)), np.full(TESTS, 20), np.full(TESTS, 12)
    return natural_script(x, v, np.zeros((TESTS, 3), np.int8), speed, lanes, at, lead, **how)


@pytest.mark.parametrize("world", [TwinWorld, SumoWorld])
def test_the_leader_is_the_nearest_that_is_seen_and_tests_end_when_they_are_said_to(world):
    """Also where cells are used again, in which LV ends on the other lane."""
    kinds = [(0, 8, 30), (5, 25, 40)] * (TESTS // 2)
    first, visible, last = np.array(kinds).T
    sees = np.stack((np.zeros_like(visible), visible), axis=1)
    given, host = script(20, n_steps=last, acts_from=first, visible_from=sees), Notes()
    with closing(world(2, NAMES)) as opened:
        loop = EpisodeLoop(opened, SCENARIO, RecordPolicy("all", 0.0), host)
        shard = loop.run(0, Traffic(given, np.zeros(TESTS)))
    assert shard.episode["n_steps"].tolist() == last.tolist()
    assert shard.episode["outcome"].tolist() == [TIMEOUT] * TESTS
    for row, (first, visible, last) in enumerate(kinds):
        seen = {round(10 * time): rest for time, *rest, episode in host.seen if episode == row}
        assert sorted(seen) == list(range(first, last))
        for step, (gap, speed, sv, lv) in seen.items():
            av, held = shard.traces[row][step, 2, 0], np.round([135.0 + 3.0 * step, 165.0 + 2.0 * step], 9)
            assert lv == pytest.approx(held[0])
            assert (sv == pytest.approx(held[1])) if step >= visible else math.isnan(sv)
            ahead = [(held[0], 30.0)] if step <= 20 else [(held[1], 20.0)] if step >= visible else []
            assert (gap, speed) == pytest.approx(
                (ahead[0][0] - 5.0 - av, ahead[0][1]) if ahead else (math.inf, math.nan), nan_ok=True
            )
