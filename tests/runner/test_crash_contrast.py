"""A bug at one speed shows in the comparison of crashes with other tests; a vehicle without one has no such line."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.report.crash_contrast import CONDITIONS, crash_contrast, cut_in_conditions
from harness.report.run_folder import read_run_folder
from tests.controllers.with_holes import BAND_MPS
from tests.runner.test_shells_runs import SHELLS

TWIN = (*SHELLS, "world.engine=twin", "stop.episodes=1500", "records.traces=none", "records.trace_share=0")
NAMES = [condition.name for condition in CONDITIONS]


@pytest.fixture
def contrast_of(campaign, run_here, tmp_path):
    """The comparison of a vehicle of `tests.controllers.with_holes` tested in shells."""

    def of(vehicle):
        av = f"av={{controller: 'tests.controllers.with_holes:{vehicle}', limits: {{max_acceleration_mps2: 2}}}}"
        folder = run_here(campaign(*TWIN, av), tmp_path / vehicle).folder
        return crash_contrast(read_run_folder(folder))

    return of


def test_a_vehicle_that_does_not_brake_at_one_speed_is_found_by_its_speed(contrast_of):
    found = contrast_of("AtOneSpeed")
    first = found.telling[0]
    assert NAMES[first.quantity] == "AV speed"
    assert BAND_MPS[0] - 0.05 <= first.low < first.high <= BAND_MPS[1] + 0.05
    assert first.n_crashes == found.crashes.n >= 5
    assert first.other_share < 0.01
    assert found.sentence.startswith(
        f"All {found.crashes.n} crashes outside the boundary happened with an AV speed of 30."
    )


def test_its_sibling_that_fails_at_random_has_nothing_that_stands_out(contrast_of):
    found = contrast_of("AtRandom")
    assert found.crashes.n >= 5
    assert found.telling == ()
    assert found.sentence.startswith("Nothing stands out")


@pytest.mark.parametrize("method", ["testing.method=shells", "testing.method=forced"])
def test_conditions_at_the_cut_in_are_those_of_the_trace(method, campaign, run_here, tmp_path):
    settings = (*TWIN, "stop.rhw=null", "stop.episodes=120", "records.traces=all", method)
    folder = run_here(campaign(*settings), tmp_path / "run").folder
    rows = pq.read_table(folder / "episodes").sort_by("episode").combine_chunks()
    traces = pq.read_table(folder / "traces").to_pandas().set_index(["episode", "step", "vehicle"])
    (batch,) = rows.to_batches()
    values = dict(zip(NAMES, cut_in_conditions(batch, 10), strict=True))
    for i, (episode, cut) in enumerate(zip(rows["episode"].to_pylist(), rows["cut_in_step"].to_pylist(), strict=True)):
        lv, bv, av = (traces.loc[(episode, cut, vehicle)] for vehicle in ("LV", "BV", "AV"))
        seen = {
            "AV speed": av.v_mps,
            "BV speed": bv.v_mps,
            "R1, gap LV–BV": lv.x_m - 5.0 - bv.x_m,
            "R1dot": lv.v_mps - bv.v_mps,
            "R2, gap BV–AV": bv.x_m - 5.0 - av.x_m,
            "R2dot": bv.v_mps - av.v_mps,
            "time of the cut-in": 0.1 * cut,
            "BV acceleration at the cut-in": bv.a_mps2,
        }
        for name, value in seen.items():
            assert values[name][i] == pytest.approx(value, abs=1e-8), (name, episode)
        after = traces["a_mps2"].get((episode, cut + 1, "BV"), np.nan)
        if np.isfinite(after):
            assert values["BV acceleration after the cut-in"][i] == pytest.approx(after, abs=1e-12)
