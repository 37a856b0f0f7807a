"""AVs that others drive: models of SUMO, a program by TraCI, and an FMU; also from the start, after baseline runs."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pyarrow as pa
import pytest

from harness.campaign.files import load_campaign
from harness.errors import CampaignError, WorldDisagreementError
from harness.records.folder import SHADOW
from harness.resolved import require_ready, resolve
from harness.runner.stored import replay_episode
from harness.sampling import prepare
from harness.sampling.paths import as_recorded, requests_before, run_baseline
from harness.vocabulary import AV, BV, CRASH, FAILED, LV
from harness.worlds import build_world, sumo_driven
from harness.worlds.program import TraciWorld, own_addresses, require_neighbour
from harness.worlds.sumo_driven import SumoAvWorld, recyclable
from tests.in_process import run_here
from tests.pool.conftest import GOLDEN_POOL, MIXTURE_FILE
from tests.stored_runs import manifest
from tests.worlds.misbehaving_client import FAULT_STEP
from tests.worlds.running import EXAMPLE, MISBEHAVING, bits, campaign, program, run, run_idm, run_in, smoke, sumo_av


def in_one_simulation(av, ranges, *, cells=4):
    return run_in(SumoAvWorld(cells, av.sumo), av, ranges)


def fresh_bits(av, first, n):
    """Every episode in a new simulation."""
    return [bits(in_one_simulation(av, [(first + i, 1)], cells=1)[0], 0) for i in range(n)]


@pytest.mark.parametrize("model", [pytest.param("Krauss", marks=pytest.mark.slow), "ACC"])
def test_recyclable_models_move_after_many_episodes_as_in_a_fresh_simulation(model):
    av = sumo_av(carFollowModel=model)
    assert recyclable(av.sumo)
    _, shard = in_one_simulation(av, [(0, 40), (40, 12)])
    assert [bits(shard, row) for row in range(12)] == fresh_bits(av, 40, 12)


def test_other_models_do_not_and_get_a_seeded_simulation_per_episode():
    av = sumo_av(carFollowModel="Krauss", sigma=0.5)
    assert not recyclable(av.sumo)
    _, recycled = in_one_simulation(av, [(0, 40), (40, 8)])
    assert [bits(recycled, row) for row in range(8)] != fresh_bits(av, 40, 8)
    in_order, alone = run(av, 40, 8), run(av, 45, 2, cells=16)
    assert [bits(in_order, row) for row in (5, 6)] == [bits(alone, row) for row in (0, 1)]


def test_each_episode_has_a_seed_of_its_own_and_what_nobody_has_measured_is_not_recycled():
    assert len({sumo_driven.sumo_seed(seed, episode) for seed in (1, 2) for episode in range(50)}) == 100
    assert not any(map(recyclable, ({"sigma": 0.1}, {"speedDev": 0.1}, {"actionStepLength": 0.5}, {"startupDelay": 1})))


def test_lv_and_bv_move_as_with_any_other_av_and_the_av_holds_its_speed_until_the_step_after_the_cut_in():
    av = sumo_av(carFollowModel="ACC")
    shard, idm = run(av, 0, 24), run_idm(0, 24)
    responded = 0
    for row in range(24):
        mine, theirs = shard.traces[row], idm.traces[row]
        n = min(len(mine), len(theirs))
        assert np.array_equal(mine[:n, [LV, BV], :2], theirs[:n, [LV, BV], :2])
        cut = shard.episode["event_step"][row]
        assert np.array_equal(mine[: cut + 2, AV, :2], theirs[: cut + 2, AV, :2])
        assert (mine[: cut + 2, AV, 1] == mine[0, AV, 1]).all()
        x, v, a, _ = mine[:, AV].T
        assert np.allclose(np.diff(v), 0.1 * a[:-1], atol=1e-12)
        assert np.allclose(np.diff(x), 0.05 * (v[1:] + v[:-1]), atol=1e-9)
        responded += mine[min(cut + 3, len(mine) - 1), AV, 1] != mine[0, AV, 1]
    assert responded > 12


def test_collision_flag_and_formula_agree_for_an_av_that_keeps_a_gap_but_hardly_brakes():
    # A difference between SUMO's flag and the bumper formula would raise WorldDisagreementError.
    shard = run(sumo_av(carFollowModel="Krauss", minGap=5.0, decel=0.4, emergencyDecel=0.5), 0, 60)
    assert (shard.episode["outcome"] == CRASH).sum() >= 5


@pytest.mark.parametrize(
    ("attributes", "where", "words"),
    [
        ({"tao": 1.0}, "av.sumo.tao", "Did you mean 'tau'"),
        ({"tau": "short"}, "av.sumo.tau", "Cannot be parsed"),
        ({"tau": "nan"}, "av.sumo.tau", "a finite number"),
        ({"length": 4.0}, "av.sumo.length", "Delete"),
    ],
    ids=["misspelt", "no number", "not a number", "the harness's own"],
)
def test_wrong_attributes_are_named_with_what_sumo_says(attributes, where, words, capfd):
    with pytest.raises(CampaignError) as caught:
        run(sumo_av(**attributes), 0, 1)
    assert caught.value.where == where
    assert caught.value.exit_code == 2
    assert words in str(caught.value)
    assert "Error" not in capfd.readouterr().err
    SumoAvWorld(1, {}).close()  # as if SUMO had not been asked


@pytest.mark.parametrize(("overtakes", "speed_mps"), [(1.0, 40.0), (0.0, 26.0)])
def test_by_default_the_av_looks_at_its_own_lane_alone(overtakes, speed_mps):
    with closing(SumoAvWorld(1, {"lcOvertakeRight": overtakes})) as world:
        speeds = np.array([[20.0, 30.0, 30.0]])
        world.place(np.array([0]), np.array([[700.0, 640.0, 100.0]]), speeds, np.array([[1, 1, 0]], np.int8))
        for _ in range(301):
            world.step(speeds, np.array([[1, 0, 0]], np.int8))
        assert world.v[0, AV] == pytest.approx(speed_mps, abs=1.0)  # LV, at 20 m/s, is 24 m or 106 m ahead on the left


# -- a program that drives AVs by TraCI: it is the built-in IDM, its faults, and who may connect to SUMO's server --


def assert_same_motion(shard, expected, rows):
    for row in rows:
        one, other = (each.episode[row].copy() for each in (shard, expected))
        for unknown in ("took_over_step", "end_ttc_s"):  # of a program: when it took over, what it accelerates by
            one[unknown] = other[unknown]
        assert one.tobytes() == other.tobytes()
        assert shard.traces[row][:, :, :2].tobytes() == expected.traces[row][:, :, :2].tobytes()


def test_the_example_client_drives_like_the_built_in_idm_in_every_bit():
    shard, expected = run(program(EXAMPLE), 0, 12, cells=8), run_idm(0, 12)
    assert not shard.failures
    assert_same_motion(shard, expected, range(12))


def test_commands_to_an_av_that_must_hold_its_speed_are_overruled():
    shard, expected = run(program(MISBEHAVING, "pushes_held_avs"), 0, 6, cells=2), run_idm(0, 6)
    assert not shard.failures
    for row in range(6):
        cut = expected.episode["event_step"][row]
        assert shard.traces[row][: cut + 2, :, :2].tobytes() == expected.traces[row][: cut + 2, :, :2].tobytes()
    assert any(bits(shard, row) != bits(expected, row) for row in range(6)), "it never drove"


def test_with_before_cut_in_controller_the_program_drives_from_the_start():
    av = program(MISBEHAVING, "pushes_held_avs")
    (shard,) = run_in(TraciWorld(2, av.traci, av.limits, acts_before_event=True), av, [(0, 2)])
    assert not shard.failures
    assert shard.traces[0][3, AV, 1] < shard.traces[0][0, AV, 1] - 1.0


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("exits", "exit code 7"),
        pytest.param("hangs", "did not finish its step within 1 s", marks=pytest.mark.slow),
        pytest.param("closes", "closed its connection, but goes on running", marks=pytest.mark.slow),
    ],
)
def test_a_program_lost_in_mid_run_fails_what_ran_and_is_started_again(fault, cause):
    # Each start lives for 60 steps, some less than an episode: one restart, then the rest is given up.
    av = program(MISBEHAVING, fault, restarts=1, step_time_s=1.0)
    shard, expected = run(av, 0, 12, cells=4), run_idm(0, 12)
    outcome = shard.episode["outcome"]
    assert set(np.flatnonzero(outcome == FAILED)) == set(shard.failures)
    lost = [row for row, said in shard.failures.items() if cause in said]
    given_up = [row for row, said in shard.failures.items() if "is not started again" in said]
    assert len(lost) >= 8
    assert sorted(lost + given_up) == sorted(shard.failures)
    for row in lost:
        n = shard.episode["n_steps"][row]
        assert n <= FAULT_STEP
        assert np.isfinite(shard.episode["log_weight"][row])
        assert shard.traces[row][:, :, :2].tobytes() == expected.traces[row][: n + 1, :, :2].tobytes()
    assert_same_motion(shard, expected, np.flatnonzero(outcome != FAILED))


@pytest.mark.slow
def test_a_program_that_never_connects_fails_its_episodes():
    shard = run(program(MISBEHAVING, "never_connects", connect_time_s=1.0, restarts=0), 0, 6, cells=2)
    assert len(shard.failures) == 6
    assert "did not connect within 1 s" in shard.failures[0]
    assert "is not started again" in shard.failures[5]


@pytest.mark.parametrize(
    ("fault", "cells", "early", "said"),
    [
        ("moves_bv", 4, False, "SUMO, BV1.*may only command AVs"),
        pytest.param("changes_lane", 4, False, "SUMO, AV.*may only command AVs", marks=pytest.mark.slow),
        ("removes_av", 4, True, "SUMO, AV1: found a vehicle that has left the road"),
        ("stops_dead", 1, True, r"SUMO, AV0: found -[0-9.]+ m/s²; expected -15 to 10 m/s²"),
    ],
)
def test_what_no_client_may_do_stops_the_run(fault, cells, early, said):
    av = program(MISBEHAVING, fault)
    with pytest.raises(WorldDisagreementError, match=said):
        run_in(TraciWorld(cells, av.traci, av.limits, acts_before_event=early), av, [(0, 2 * cells)])


def load(command, more=""):
    return smoke(f"av={{traci: {{command: '{command}'{more}}}}}")


def test_a_command_that_cannot_be_started_is_an_error_of_the_campaign():
    with pytest.raises(CampaignError, match=r"av\.traci\.command.*no_such_program"):
        run(load("./no_such_program {port}").av, 0, 1)


def test_a_run_says_that_it_is_not_reproducible_and_is_not_replayed(tmp_path):
    folder = tmp_path / "run"
    run_here(campaign(program(EXAMPLE), episodes=4), folder)
    assert manifest(folder)["reproducible"] is False
    with pytest.raises(CampaignError, match="not reproducible"):
        replay_episode(folder, 0)


def test_a_machine_with_a_public_address_is_refused_unless_it_is_allowed(monkeypatch):
    assert "127.0.0.1" in own_addresses()
    addresses = {"127.0.0.1", "10.1.2.3", "192.168.0.9"}
    monkeypatch.setattr("harness.worlds.program.own_addresses", lambda: addresses)
    plain, allowed = (load(f"{EXAMPLE} {{port}} {{cells}}", more) for more in ("", ", allow_public: true"))
    require_ready(plain)
    addresses.add("8.8.4.4")
    require_ready(allowed)
    with pytest.raises(CampaignError, match=r"8\.8\.4\.4.*allow_public") as caught:
        require_ready(plain)
    assert caught.value.where == "av.traci"
    assert plain.av.identity() == allowed.av.identity()


def test_a_client_of_another_machine_ends_the_run():
    require_neighbour("0100007F:B267", "0100007F:A6BC")
    require_neighbour("0A01A8C0:B267", "0A01A8C0:A6BC")  # this machine, by its own address
    with pytest.raises(WorldDisagreementError, match="a client at"):
        require_neighbour("0A01A8C0:B267", "0B01A8C0:A6BC")


# -- driven from the start: baseline runs, and tests that find the same motion --


FIRST = "SUMO's ACC"
FORMS = {
    FIRST: "{sumo: {carFollowModel: ACC}",
    "SUMO's Krauss with seeded noise": "{sumo: {carFollowModel: Krauss, sigma: 0.5}",
    "TraCI style": "{controller: 'tests.controllers.early:SpeedsTraci'",
    "a program": f"{{traci: {{command: {program(EXAMPLE).traci.command!r}}}",
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name != FIRST)) for name in FORMS])
def test_it_does_in_tests_what_it_did_in_its_baseline_runs(name):
    av, sizes = (
        f"av={FORMS[name]}, before_event: controller}}",
        ("world.cells=8", "pool.shadow_paths=120", *GOLDEN_POOL),
    )
    campaign = load_campaign(MIXTURE_FILE, [av, "testing.method=shells", "world.engine=sumo", *sizes])
    ready = prepare(resolve(campaign))
    with closing(build_world(campaign)) as world, closing(ready.loop(world)) as loop:
        specs = list(requests_before(SHADOW, len(ready.baseline_paths)))
        done = [run_baseline(loop, ready.baseline_paths, ready.resolved, spec) for spec in specs]
        runs = as_recorded(pa.concat_tables(part.table for part in done), ready.scenario.max_steps)
        ready.begin_after(runs)
        rows = np.linspace(0, ready.prescribed.available.sum() - 1, 60).astype(np.int64)
        shard = loop.run(1000, ready.prescribed.of_rows(rows, np.zeros(60, np.int64)))
    assert not runs.failed.any()
    assert shard.failures == {}
    moved = np.abs(runs.v_mps[np.arange(120), runs.n_steps] - runs.v_mps[:, 0]) > 0.1
    assert moved.mean() > 0.2 or name == "a program", "it never acted"  # but the client holds its speed, too
    assert np.all(shard.episode["event_step"] >= 0)
