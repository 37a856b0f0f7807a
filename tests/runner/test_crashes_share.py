"""`examples/what_crashes_share.py`: a bug at one speed shows, a vehicle that fails at random has nothing in common."""

from __future__ import annotations

import pytest

from examples.idm import IDM
from examples.what_crashes_share import what_crashes_share
from tests.runner.test_shells_runs import SHELLS

TWIN = (*SHELLS, "world.engine=twin", "stop.episodes=1500", "records.traces=none", "records.trace_share=0")
BAND_MPS = (30.0, 30.5)


class AtOneSpeed(IDM):
    """Does not brake where its speed at the cut-in is 30.0 to 30.5 m/s."""

    def start(self, episode):
        self.asleep, self.draw = None, episode.random.random()

    def step(self, seen):
        self.asleep = self.fails(seen.speed_mps) if self.asleep is None else self.asleep
        return 0.0 if self.asleep else super().step(seen)

    def fails(self, speed_mps):
        return BAND_MPS[0] <= speed_mps <= BAND_MPS[1]


class AtRandom(AtOneSpeed):
    """Does not brake in one cut-in of fifty, whatever it is like."""

    def fails(self, speed_mps):
        return self.draw < 0.02


@pytest.mark.parametrize("vehicle", ["AtOneSpeed", "AtRandom"])
def test_what_crashes_share(vehicle, campaign, run_here, tmp_path):
    av = f"av={{controller: 'tests.runner.test_crashes_share:{vehicle}', limits: {{max_acceleration_mps2: 2}}}}"
    first = what_crashes_share(run_here(campaign(*TWIN, av), tmp_path / "run").folder).iloc[0]
    if vehicle == "AtRandom":
        assert first["p_value"] > 0.01
        return
    assert (first["quantity"], first["share of crashes"], first["p_value"]) == ("AV speed, m/s", 1.0, 1 / 200)
    assert first["band"].left < BAND_MPS[1]
    assert first["band"].right > BAND_MPS[0]
