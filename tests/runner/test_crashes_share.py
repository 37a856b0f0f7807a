"""`examples/what_crashes_share.py`: a bug at one speed shows, a vehicle that fails at random has nothing in common."""

from __future__ import annotations

import pytest

from examples.what_crashes_share import what_crashes_share
from tests.controllers.with_holes import BAND_MPS
from tests.runner.test_shells_runs import SHELLS

TWIN = (*SHELLS, "world.engine=twin", "stop.episodes=1500", "records.traces=none", "records.trace_share=0")


@pytest.mark.parametrize("vehicle", ["AtOneSpeed", "AtRandom"])
def test_what_crashes_share(vehicle, campaign, run_here, tmp_path):
    av = f"av={{controller: 'tests.controllers.with_holes:{vehicle}', limits: {{max_acceleration_mps2: 2}}}}"
    first = what_crashes_share(run_here(campaign(*TWIN, av), tmp_path / "run").folder).iloc[0]
    if vehicle == "AtRandom":
        assert first["p_value"] > 0.01
        return
    assert (first["quantity"], first["share of crashes"], first["p_value"]) == ("AV speed, m/s", 1.0, 1 / 200)
    assert first["band"].left < BAND_MPS[1]
    assert first["band"].right > BAND_MPS[0]
