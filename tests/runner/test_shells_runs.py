"""A shells campaign follows its counts, stops where it says, and goes on from what is there."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from harness import estimate, replay
from harness.campaign.campaign import Campaign
from harness.errors import RunFolderError
from harness.report.notes import note_words
from harness.runner.kept import Run
from harness.sampling.shells import Allocation, ShellRounds, first_tests
from tests.estimators.small_blocks import RARE as DESIGN
from tests.estimators.small_blocks import SHELLS as SAFE
from tests.estimators.small_blocks import in_shells
from tests.estimators.small_blocks import tally as counted
from tests.in_process import run_here
from tests.runner.conftest import SHELLS, campaign
from tests.stored_runs import answer_in, copy_of, edit, golden, manifest, part_files, stored_table


def test_a_pool_that_is_used_up_ends_the_run(tmp_path):
    small = ("stop.rhw=0.1", "stop.episodes=100000", "pool.events_per_shell=100")
    result = run_here(campaign(*SHELLS, *small, "world.engine=twin"), tmp_path / "run")
    assert (result.exit_code, result.stopped_by) == (4, "pool")
    tests = [shell["n_episodes"] for shell in result.estimates["estimates"]["shells"]["details"]["shells"]]
    assert tests[-1] >= 100
    assert result.estimates["n_episodes"] < 1000
    assert set(re.findall(r"pool\.[a-z_]+", json.dumps(answer_in(result.folder)))) == {"pool.events_per_shell"}
    assert re.search(r"; raise pool\.events_per_shell to \d,?\d+$", answer_in(result.folder)["scope"])


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
    assert re.search(r"; lower pool\.relative_error to 0\.0\d+(?: and [^;]+)?$", scope)
    assert "pool." not in "".join(map(note_words, found["warnings"]))


@pytest.mark.parametrize(("cut_off", "verdict"), [(0.0, "accepted"), (0.02, "undecided")])
def test_no_limit_is_accepted_that_holds_only_if_tests_that_were_cut_off_had_not_crashed(cut_off, verdict):
    """Nobody knows how they would have ended: 2 % of the tests that crash nowhere, for a limit of 0.1 %."""
    limit = {"accept": {"crash_rate_below": 1e-3 * float(SAFE.p.sum())}, "stop": {"episodes": 20_000}}
    campaign = Campaign.model_validate({"name": "x", "testing": {"method": "shells"}, **limit})
    rounds, rng = ShellRounds(campaign, SAFE, np.full(SAFE.p.size, 20_000)), np.random.default_rng(7)
    while (added := rounds.next_round()).any():
        tests = in_shells(np.repeat(np.arange(added.size), added).tolist(), [False] * int(added.sum()))
        if rounds.enough(replace(tests, columns={**tests.columns, "cut_off": rng.random(len(tests)) < cut_off})):
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
    for key, wrong in (("cell_p", [0.1]), ("n_inside", 9), ("strata", {})):
        kept = json.loads((folder / "shells.json").read_text())[key]
        edit(folder, "shells.json", **{key: wrong})
        with pytest.raises(RunFolderError, match=r"shells\.json"):
            estimate(folder)
        edit(folder, "shells.json", **{key: kept})


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
