"""Vehicles that act before the cut-in: shadow runs, tests that follow from them, and motion that is not the same."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from examples.idm import IDM
from examples.what_crashes_share import what_crashes_share
from harness import estimate, replay
from harness.errors import RunFolderError, TooManyFailedError
from harness.families.cut_in.family import CUT_IN
from harness.records.schemas import baseline_schema
from harness.report.notes import note_words
from harness.sampling.baseline import run_baseline
from tests.in_process import run_here
from tests.pool.conftest import GOLDEN_POOL
from tests.pool.test_vehicle_pool import ACTING
from tests.runner.conftest import SHELLS, campaign
from tests.stored_runs import (
    ROOT,
    answer_in,
    copy_of,
    estimates,
    golden,
    manifest,
    part_files,
    stored_table,
    unlike_columns,
    with_fewer_before,
)

SHADOWS, TWIN = ("pool.shadow_paths=120", *GOLDEN_POOL), "world.engine=twin"
FORCED = ("testing.method=forced", "stop.episodes=600", "run.shard_size=100")


def of(name: str, *more: str) -> str:
    return ACTING.format(name)[:-1] + "".join(f", {text}" for text in more) + "}"


def files_of(folder):
    return sorted((folder / "shadow").glob("*.parquet"))


ACTS = "shells-acting-twin"
"""Sixty shadow runs, in two tasks."""


@pytest.mark.slow
def test_a_run_that_was_interrupted_goes_on_where_it_was(stored_run, tmp_path):
    """Ended in the middle of the shadow runs, and again among the tests: the end is that of a run in one go."""
    out = copy_of(stored_run(ACTS), tmp_path / "run")
    [table] = [pq.read_table(path) for path in files_of(out)]
    assert table.num_rows == 60
    assert table.schema.equals(baseline_schema(CUT_IN.columns))
    with_fewer_before(out, "shadow", 50)
    files_of(out)[-1].unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.runner.workers.run_baseline", driven := Driven())
        run_here(golden(ACTS), out, resume=True)
    assert driven.first == [50]
    assert unlike_columns(stored_run(ACTS), out) == []
    assert len(files_of(out)) == 1
    part_files(out)[-1].unlink()
    run_here(golden(ACTS), out, resume=True)
    assert unlike_columns(stored_run(ACTS), out) == []


class Driven:
    """Baseline runs as they are, noting which."""

    def __init__(self):
        self.first = []

    def __call__(self, loop, paths, resolved, request):
        self.first.append(request.first_episode)
        return run_baseline(loop, paths, resolved, request)


NOISY = "parameters: {noise_mps2: 0.2}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [pytest.param(SHELLS, id="shells", marks=pytest.mark.slow), pytest.param(FORCED, id="forced")]
)
def test_a_vehicle_with_noise_of_its_own_is_refused_unlike_one_with_the_given(method, tmp_path):
    asked = (*method, *SHADOWS, TWIN)
    with pytest.raises(TooManyFailedError, match="something else than in its baseline run"):
        run_here(campaign(*asked, f"av={of('FreshNoise', NOISY)}"), tmp_path / "fresh")
    kept = (tmp_path / "fresh").glob("episodes/*.parquet")
    assert {outcome for file in kept for outcome in pq.read_table(file).column("outcome").to_pylist()} == {"failed"}
    seeded = run_here(campaign(*asked, f"av={of('Speeds', NOISY)}"), tmp_path / "seeded").folder
    assert manifest(seeded)["repeated"]["differing"] == []
    assert stored_table(seeded, "episodes").column("failure").drop_null().to_pylist() == []
    assert replay(seeded, 123).bit_equal


def test_shadow_runs_that_fail_count_against_the_vehicle(tmp_path):
    """Three in 120 fail: refused at one per cent; with five they are a part of the upper limit that no test takes."""
    breaks = (*SHELLS, *SHADOWS, TWIN, f"av={of('Breaks')}")
    with pytest.raises(TooManyFailedError, match="3 of 120 baseline runs failed, 3 of them with: step: RuntimeError"):
        run_here(campaign(*breaks), tmp_path / "run")
    assert manifest(tmp_path / "run")["status"] == "interrupted"
    loose = campaign(*breaks, "run.max_failed_share=0.05", "stop.rhw=9")
    result = run_here(loose, tmp_path / "run", resume=True)
    shells = result.estimates["estimates"]["shells"]
    lost = shells["details"]["shells"][-1]
    assert (lost["shell"], lost["n_episodes"], lost["inside"]) == ("failed shadow runs", 0, False)
    assert lost["p"] > 1e-9
    assert shells["ci_high"] > shells["crash_rate"] + lost["p"]
    assert shells["details"]["within"]["upper_bound_outside"] > lost["p"]
    assert any("no test in failed shadow runs" in note_words(warning) for warning in shells["warnings"])


@pytest.mark.slow
def test_crashes_on_a_handful_of_paths_give_no_interval(tmp_path):
    """A vehicle that gives way, but on three paths of 120: the run ends, and says that it knows too little."""
    lonely = campaign(*SHELLS, *SHADOWS, TWIN, f"av={of('YieldsMostly')}", "stop.rhw=0.3", "stop.episodes=20000")
    result = run_here(lonely, tmp_path / "run")
    shells = result.estimates["estimates"]["shells"]
    assert (result.exit_code, result.stopped_by) == (4, "pool_error")
    assert (shells["ci_low"], shells["ci_high"], shells["rhw"]) == (0.0, 1.0, None)
    told = " ".join(answer_in(result.folder)["warnings"])
    assert "no interval: nearly all crashes lie on some" in told
    assert "raise pool.shadow_paths" in told
    assert shells["details"]["references"] == []


@pytest.mark.slow
def test_forced_cut_ins_of_a_vehicle_that_holds_are_those_of_one_that_holds(tmp_path):
    """The same paths, weights and ends, with and without a shadow run before each test."""
    plain = run_here(campaign(*FORCED, TWIN, "av={controller: 'tests.controllers.early:HoldsThenIdm'}"), tmp_path / "a")
    walked = run_here(campaign(*FORCED, TWIN, f"av={of('HoldsThenIdm')}"), tmp_path / "b")
    a, b = (stored_table(result.folder, "episodes") for result in (plain, walked))
    for name in ("outcome", "event_step", "n_steps", "crash_time_s", "impact_speed_mps", "event_gap_m"):
        assert a.column(name).to_pylist() == b.column(name).to_pylist(), name
    for name in ("log_weight", "log_p_event"):
        np.testing.assert_allclose(a.column(name).to_numpy(), b.column(name).to_numpy(), rtol=1e-9)
    one, other = (result.estimates["estimates"]["nade"] for result in (plain, walked))
    assert one["crash_rate"] == pytest.approx(other["crash_rate"], rel=1e-9)
    assert one["n_crashes"] > 0


def test_a_forced_test_fails_where_its_shadow_run_did(tmp_path):
    """A row, with the weight of the cut-in that it may have hidden, and counted as a crash in the upper limit."""
    loose = campaign(*FORCED, TWIN, "stop.episodes=200", "run.max_failed_share=0.05", f"av={of('Breaks')}")
    result = run_here(loose, tmp_path / "run")
    rows = [row for row in stored_table(result.folder, "episodes").to_pylist() if row["outcome"] == "failed"]
    assert rows
    assert all(row["episode"] % 50 == 7 and "sensor lost" in row["failure"] for row in rows)
    assert all(np.isfinite(row["log_weight"]) and row["log_weight"] < 0.0 for row in rows)


@pytest.mark.slow
def test_shadow_runs_that_are_gone_or_damaged_are_named(stored_run, tmp_path):
    folder = copy_of(stored_run(ACTS), tmp_path / "run")
    files_of(folder)[0].write_bytes(b"PAR1")
    with pytest.raises(RunFolderError, match=r"shadow/000000000-000000060\.parquet.*Delete this file"):
        replay(folder, 5)
    files_of(folder)[0].unlink()
    with pytest.raises(RunFolderError, match="0 baseline runs; expected all 60"):
        replay(folder, 5)
    assert estimate(folder) == estimates(folder)  # needs no path


# -- vehicles that fail just before contact --


FAILING = "av={controller: 'tests.runner.test_shadow_runs:RaisesBeforeContact'}"
TRUTH = json.loads((ROOT / "tests/reference/default.json").read_text())["crash_rate"]
BUSY = json.loads((ROOT / "docs/validation/nde_1e4.json").read_text())["crash_rate"]
METHODS = {
    "shells": (TRUTH, (*SHELLS, "stop.episodes=1500")),  # whose precision failed tests would soon have reached
    "forced": (TRUTH, ("testing.method=forced", "stop.episodes=2000", "records.moments=none")),
    "episode_mixture": (TRUTH, ("testing.method=episode_mixture", "stop.episodes=2000")),
    "nde": (BUSY, ("testing.method=nde", "environment.lane_change_level=1e4", "stop.episodes=8000")),
}


class RaisesBeforeContact(IDM):
    """The built-in IDM; in three of four episodes it raises in the step before contact."""

    def start(self, episode):
        self.raises = episode.episode % 4 != 0

    def step(self, seen):
        if self.raises and seen.gap_m + 0.1 * (seen.lead_speed_mps - seen.speed_mps) < 0.0:
            raise RuntimeError("no room")
        return super().step(seen)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [pytest.param(each, marks=[pytest.mark.slow] * (each != "shells")) for each in METHODS]
)
def test_the_interval_holds_what_may_have_happened(method, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    truth, settings = METHODS[method]
    tested = campaign("world.engine=twin", "run.max_failed_share=1", "run.shard_size=1000", *settings, FAILING)
    result = run_here(tested, tmp_path / "run")
    assert (result.exit_code, result.stopped_by) == (4 if method == "shells" else 0, "episodes")
    content = result.estimates
    found = content["estimates"][content["headline"]]
    assert found["details"]["n_failed"] > 0
    assert found["crash_rate"] < 0.6 * truth
    assert found["ci_low"] <= truth <= found["ci_high"]
    assert truth <= found["upper_bound"]
    assert found["details"]["crash_rate_if_failed_had_crashed"] > 0.6 * truth
    assert any("tests FAILED; had they all crashed" in text for text in answer_in(result.folder)["warnings"])
    if found["rhw"] is not None:
        assert found["rhw"] == pytest.approx((found["ci_high"] - found["ci_low"]) / 2.0 / found["crash_rate"])


class AtOneSpeed(IDM):
    """Does not brake where its speed at the cut-in is 30.0 to 30.5 m/s."""

    def start(self, episode):
        self.asleep = None

    def step(self, seen):
        self.asleep = 30.0 <= seen.speed_mps <= 30.5 if self.asleep is None else self.asleep
        return 0.0 if self.asleep else super().step(seen)


@pytest.mark.slow
def test_what_crashes_share(tmp_path):
    av = "av={controller: 'tests.runner.test_shadow_runs:AtOneSpeed', limits: {max_acceleration_mps2: 2}}"
    many = (*SHELLS, "world.engine=twin", "stop.episodes=1500", "records.traces=none", "records.trace_share=0", av)
    first = what_crashes_share(run_here(campaign(*many), tmp_path / "run").folder).iloc[0]
    assert (first["quantity"], first["share of crashes"], first["p_value"]) == ("AV speed, m/s", 1.0, 1 / 200)
    assert first["band"].left < 30.5
    assert first["band"].right > 30.0
