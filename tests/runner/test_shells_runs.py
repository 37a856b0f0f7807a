"""Campaigns of shells: counts, ends, what is there goes on; vehicles that act before the cut-in, and that fail."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from examples.idm import IDM
from examples.what_crashes_share import what_crashes_share
from harness import estimate, load_campaign, replay
from harness.campaign.campaign import Campaign
from harness.errors import RunFolderError, TooManyFailedError
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import RoundRule
from harness.families.cut_in.family import CUT_IN
from harness.records.schemas import baseline_schema
from harness.report.notes import note_words
from harness.runner.kept import Run
from harness.sampling.paths import run_baseline
from harness.sampling.shells import Allocation, ShellRounds, first_tests
from tests.estimators.small_blocks import RARE as DESIGN
from tests.estimators.small_blocks import SHELLS as SAFE
from tests.estimators.small_blocks import in_shells
from tests.estimators.small_blocks import tally as counted
from tests.in_process import run_here
from tests.pool.conftest import GOLDEN_POOL
from tests.pool.test_vehicle_pool import ACTING
from tests.runner.conftest import SHELLS, campaign
from tests.stored_runs import (
    ROOT,
    answer_in,
    copy_of,
    edit,
    estimates,
    golden,
    manifest,
    part_files,
    stored_table,
    unlike_columns,
    with_fewer_before,
)


def test_a_pool_that_is_used_up_ends_the_run(tmp_path):
    small = ("stop.rhw=0.1", "stop.episodes=100000", "pool.events_per_shell=100")
    result = run_here(campaign(*SHELLS, *small, "world.engine=twin"), tmp_path / "run")
    assert (result.exit_code, result.stopped_by) == (4, "pool")
    tests = [shell["n_episodes"] for shell in result.estimates["estimates"]["shells"]["details"]["shells"]]
    assert tests[-1] >= 100
    assert result.estimates["n_episodes"] < 1000
    assert set(re.findall(r"pool\.[a-z_]+", json.dumps(answer_in(result.folder)))) == {"pool.events_per_shell"}
    assert re.search(
        r"; to narrow it: --set pool\.events_per_shell=\d+ and a new --out$", answer_in(result.folder)["scope"]
    )


def test_a_vehicle_that_fails_in_most_tests_is_given_up_after_few(tmp_path):
    """Each may take as long as its time limit; one that fails in fewer is given up after 200."""
    raises = (
        "av={controller: 'tests.controllers.misbehaving:Always', parameters: {where: step, how: raises}}",
        "world.engine=twin",
        "stop.episodes=2000",
    )
    with pytest.raises(TooManyFailedError) as told:
        run_here(campaign(*SHELLS, *raises), tmp_path / "run")
    failed, _, n, *_ = told.value.found.split()
    assert 20 <= int(n) < 2 * int(failed) < 200


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["lead_brakes", "cut_out"])
def test_a_vehicle_that_never_crashes_is_decided_before_the_pool_is_used_up(scenario, tmp_path):
    found = run_here(load_campaign("brakes-8", [f"scenario={scenario}", "world.engine=twin"]), tmp_path / "run")
    assert (found.exit_code, found.stopped_by) == (0, "below_reference")


@pytest.mark.slow
def test_a_pool_that_is_too_rough_ends_the_run(tmp_path):
    """A vehicle that crashes often: after some thousand tests the pool's own error is most of the interval."""
    often = ("av={model: constant, parameters: {acceleration_mps2: -1.0}}", "world.engine=twin")
    settings = (*SHELLS, *often, "stop.episodes=100000", "pool.events_per_shell=5000")
    fresh = run_here(campaign(*settings, "stop.rhw=0.05"), tmp_path / "fresh")
    assert (fresh.exit_code, fresh.stopped_by) == (4, "pool_error")
    found = fresh.estimates["estimates"]["shells"]
    assert found["rhw"] > found["details"]["rhw_from_pool"] > 0.05
    scope = answer_in(fresh.folder)["scope"]
    assert re.search(r"; to narrow it: --set pool\.relative_error=0\.0\d+ [^;]*and a new --out$", scope)
    assert "pool." not in "".join(map(note_words, found["warnings"]))


@pytest.mark.parametrize(("cut_off", "verdict"), [(0.0, "accepted"), (0.02, "undecided")])
def test_no_limit_is_accepted_that_holds_only_if_tests_that_were_cut_off_had_not_crashed(cut_off, verdict):
    """Nobody knows how they would have ended: 2 % of the tests that crash nowhere, for a limit of 0.1 %."""
    limit = {"accept": {"crash_rate_below": 1e-3 * float(SAFE.p.sum())}, "stop": {"episodes": 20_000}}
    campaign = Campaign.model_validate({"name": "x", "testing": {"method": "shells"}, **limit})
    rounds = ShellRounds(campaign, SAFE, np.full(SAFE.p.size, 20_000), RoundRule(campaign))
    seen, rng = SeenShells(SAFE), np.random.default_rng(7)
    while (added := rounds.next_round(seen)[0]).any():
        tests = in_shells(np.repeat(np.arange(added.size), added).tolist(), [False] * int(added.sum()))
        tests = replace(tests, columns={**tests.columns, "cut_off": rng.random(len(tests)) < cut_off})
        seen.add(tests.cut_off_as_failed())
        if rounds.rule.observe(seen):
            break
    assert rounds.rule.look.decision.verdict == verdict


SPENT, MORE = "stop.episodes=150", "stop.episodes=400"
"""A budget that ends within a round: its last shards are not those of a run that goes on."""


def test_a_continuation_that_dies_leaves_what_was_there(tmp_path, monkeypatch):
    out = tmp_path / "run"
    run_here(campaign(*SHELLS, "world.engine=twin", SPENT), out)
    before = {path: path.read_bytes() for path in (*part_files(out), out / "manifest.json")}
    add = Run.with_shard

    def add_or_die(run, shard):
        if shard.is_new:
            raise KeyboardInterrupt
        return add(run, shard)

    monkeypatch.setattr(Run, "with_shard", add_or_die)
    with pytest.raises(KeyboardInterrupt):
        run_here(campaign(*SHELLS, "world.engine=twin", MORE), out, resume=True)
    assert {path: path.read_bytes() for path in before} == before
    assert estimate(out)["n_episodes"] == 150


def test_shells_of_another_pool_or_that_are_none_are_refused(stored_run, tmp_path):
    folder = copy_of(stored_run("shells-twin"), tmp_path / "run")
    edit(folder, "shells.json", pool="f" * 24)
    for act in (lambda: replay(folder, 3), lambda: run_here(golden("shells-twin"), folder, resume=True)):
        with pytest.raises(RunFolderError, match="events of pool ffff"):
            act()
    edit(folder, "shells.json", strata={})
    with pytest.raises(RunFolderError, match=r"shells\.json"):
        estimate(folder)


def tally(tests, crashes, failed):
    """Counts of tests of a pool that is known exactly."""
    return counted(DESIGN.p, crashes, tests, failed)


MANY, NONE, TWELVE = np.full(3, 10_000), np.zeros(3, int), np.full(3, 12)


def test_first_tests_go_in_proportion_to_the_probability():
    """Within limits: at least a few, and no more beyond the boundary than a start."""
    p = np.array([1e-9, 1e-7, 2e-7, 5e-7, 3e-5])
    strata = ("a", "b", "c", "d", "outside")
    design = replace(DESIGN, strata=strata, cell_stratum=tuple(range(5)), cell_p=p, boundary="c", n_inside=3)
    assert first_tests(design).tolist() == [3, 12, 12, 12, 12]
    many = replace(design, cell_p=p * [1, 1, 0.5, 1, 1], boundary="d", n_inside=4)
    assert first_tests(many).tolist() == [3, 6, 6, 12, 12]
    assert first_tests(design, 40).tolist() == [40] * 5


def test_the_boundary_is_passed_when_what_lies_within_is_known():
    rule = Allocation(DESIGN.p, 2, TWELVE, MANY)
    assert rule.next_round(tally(NONE, NONE, NONE), 10**6).tolist() == [12, 12, 0]
    tests, crashes = np.array([400, 400, 0]), np.array([400, 200, 0])
    assert rule.next_round(tally(tests, crashes, NONE), 10**6).tolist() == [0, 0, 12]
    inside = Allocation(DESIGN.p, 2, TWELVE, MANY, "library")
    assert inside.next_round(tally(tests, crashes, NONE), 10**6)[2] == 0
    hopeless = Allocation(DESIGN.p, DESIGN.n_inside, TWELVE, MANY).next_round(
        tally(np.array([96, 96, 0]), NONE, NONE), 10**6
    )
    assert hopeless.tolist() == [0, 0, 12]


@pytest.mark.slow
def test_what_is_traced_may_change_when_a_run_goes_on(tmp_path):
    traced, untraced = ("records.traces=all",), ("records.traces=none", "records.trace_share=0")
    out = tmp_path / "run"
    run_here(campaign(*SHELLS, "world.engine=twin", SPENT, *traced), out)
    for _ in range(2):  # the second time all tests are taken over
        run_here(campaign(*SHELLS, "world.engine=twin", MORE, *untraced), out, resume=True)
    traced_tests = set(stored_table(out, "traces")["episode"].to_pylist())
    assert 0 in traced_tests
    assert len(traced_tests) < manifest(out)["n_episodes"]
    assert replay(out, 0).bit_equal


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


def test_nothing_is_said_per_km_where_a_vehicle_that_acts_may_drive_farther_than_one_that_holds(tmp_path):
    result = run_here(campaign(*FORCED, TWIN, "stop.episodes=100", f"av={of('Speeds')}"), tmp_path / "run")
    assert result.estimates["distance_per_test_km"] is None
    assert result.estimates["crash_rate_per_1e6_km"] is None


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


FAILING = "av={controller: 'tests.runner.test_shells_runs:RaisesBeforeContact'}"
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
    av = "av={controller: 'tests.runner.test_shells_runs:AtOneSpeed', limits: {max_acceleration_mps2: 2}}"
    many = (*SHELLS, "world.engine=twin", "stop.episodes=1500", "records.traces=none", "records.trace_share=0", av)
    first = what_crashes_share(run_here(campaign(*many), tmp_path / "run").folder).iloc[0]
    assert (first["quantity"], first["share of crashes"], first["p_value"]) == ("AV speed, m/s", 1.0, 1 / 200)
    assert first["band"].left < 30.5
    assert first["band"].right > 30.0
