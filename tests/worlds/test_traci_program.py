"""A program that drives AVs by TraCI: it is the built-in IDM, its faults, and who may connect to SUMO's server."""

import numpy as np
import pytest

from harness.errors import CampaignError, WorldDisagreementError
from harness.runner.look import plan_campaign
from harness.runner.run import run_campaign
from harness.runner.stored import replay_episode
from harness.vocabulary import AV, FAILED
from harness.worlds.program import TraciWorld, own_addresses, require_neighbour
from tests.stored_runs import manifest
from tests.worlds.misbehaving_client import FAULT_STEP
from tests.worlds.running import EXAMPLE, MISBEHAVING, bits, campaign, program, run, run_idm, run_in, smoke


def assert_same_motion(shard, expected, rows):
    for row in rows:
        assert shard.results.episode[row].tobytes() == expected.results.episode[row].tobytes()
        assert shard.traces[row][:, :, :2].tobytes() == expected.traces[row][:, :, :2].tobytes()


@pytest.mark.parametrize("n", [24, 3])
def test_the_example_client_drives_like_the_built_in_idm_in_every_bit(n):
    """Also where some of its eight cells never get an episode and stay parked."""
    shard, expected = run(program(EXAMPLE), 0, n, cells=8), run_idm(0, n)
    assert not shard.failures
    assert_same_motion(shard, expected, range(n))


@pytest.mark.parametrize("client", ["pushes_held_avs", "connects_late"])
def test_commands_to_an_av_that_must_hold_its_speed_are_overruled_and_connecting_late_is_no_fault(client):
    shard, expected = run(program(MISBEHAVING, client), 0, 6, cells=2), run_idm(0, 6)
    assert not shard.failures
    for row in range(6):
        cut = expected.results.episode["cut_in_step"][row]
        assert shard.traces[row][: cut + 2, :, :2].tobytes() == expected.traces[row][: cut + 2, :, :2].tobytes()
    assert any(bits(shard, row) != bits(expected, row) for row in range(6)), "it never drove"


def test_with_before_cut_in_controller_the_program_drives_from_the_start():
    av = program(MISBEHAVING, "pushes_held_avs")
    (shard,) = run_in(TraciWorld(2, av.traci, 60.0, acts_before_cut_in=True), av, [(0, 2)])
    assert not shard.failures
    assert shard.traces[0][3, AV, 1] < shard.traces[0][0, AV, 1] - 1.0


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("exits", "exit code 7"),
        ("is_killed", "killed by signal 9"),
        ("hangs", "did not finish its step within 3 s"),
        ("closes", "closed its connection, but goes on running"),
        ("drops", "closed its connection, but goes on running"),
    ],
)
def test_a_program_lost_in_mid_run_fails_what_ran_and_is_started_again(fault, cause):
    # Each start lives for 60 steps, some less than an episode: one restart, then the rest is given up.
    av = program(MISBEHAVING, fault, restarts=1, step_time_s=3.0)
    shard, expected = run(av, 0, 12, cells=4), run_idm(0, 12)
    outcome = shard.results.episode["outcome"]
    assert set(np.flatnonzero(outcome == FAILED)) == set(shard.failures)
    lost = [row for row, said in shard.failures.items() if cause in said]
    given_up = [row for row, said in shard.failures.items() if "is not started again" in said]
    assert len(lost) >= 8
    assert sorted(lost + given_up) == sorted(shard.failures)
    for row in lost:
        n = shard.results.episode["n_steps"][row]
        assert n <= FAULT_STEP
        assert np.isfinite(shard.results.episode["log_weight"][row])
        assert shard.traces[row][:, :, :2].tobytes() == expected.traces[row][: n + 1, :, :2].tobytes()
    assert_same_motion(shard, expected, np.flatnonzero(outcome != FAILED))


def test_a_program_that_never_connects_fails_its_episodes():
    shard = run(program(MISBEHAVING, "never_connects", connect_time_s=1.0, restarts=0), 0, 6, cells=2)
    assert len(shard.failures) == 6
    assert "did not connect within 1 s" in shard.failures[0]
    assert "is not started again" in shard.failures[5]


@pytest.mark.parametrize(("fault", "vehicle"), [("moves_bv", "BV1"), ("slows_lv", "LV1"), ("changes_lane", "AV")])
def test_moving_what_is_not_the_clients_stops_the_run(fault, vehicle):
    with pytest.raises(WorldDisagreementError, match=f"SUMO, {vehicle}") as caught:
        run(program(MISBEHAVING, fault), 0, 8, cells=4)
    assert "may only command AVs" in str(caught.value)


def load(command, more=""):
    return smoke(f"av={{traci: {{command: '{command}'{more}}}}}")


def test_a_command_that_cannot_be_started_is_an_error_of_the_campaign():
    with pytest.raises(CampaignError, match=r"av\.traci\.command.*no_such_program"):
        run(load("./no_such_program {port}").av, 0, 1)


def test_a_run_says_that_it_is_not_reproducible_and_is_not_replayed(tmp_path):
    folder = tmp_path / "run"
    run_campaign(campaign(program(EXAMPLE), episodes=4), folder, workers=1)
    assert manifest(folder)["reproducible"] is False
    with pytest.raises(CampaignError, match="not reproducible"):
        replay_episode(folder, 0)


def test_a_machine_with_a_public_address_is_refused_unless_it_is_allowed(monkeypatch):
    assert "127.0.0.1" in own_addresses()
    addresses = {"127.0.0.1", "10.1.2.3", "192.168.0.9"}
    monkeypatch.setattr("harness.worlds.program.own_addresses", lambda: addresses)
    plain, allowed = (load(f"{EXAMPLE} {{port}} {{cells}}", more) for more in ("", ", allow_public: true"))
    plan_campaign(plain)
    addresses.add("8.8.4.4")
    plan_campaign(allowed)
    with pytest.raises(CampaignError, match=r"8\.8\.4\.4.*allow_public") as caught:
        plan_campaign(plain)
    assert caught.value.where == "av.traci"
    assert plain.av.identity() == allowed.av.identity()


def test_a_client_of_another_machine_ends_the_run():
    require_neighbour("0100007F:B267", "0100007F:A6BC")
    require_neighbour("0A01A8C0:B267", "0A01A8C0:A6BC")  # this machine, by its own address
    with pytest.raises(WorldDisagreementError, match="a client at"):
        require_neighbour("0A01A8C0:B267", "0B01A8C0:A6BC")


@pytest.mark.parametrize("command", ["x {port.x}", "x {}", "x {port:5}", "x {ports}", "x {", "x '", " "])
def test_only_port_and_cells_stand_in_braces(command):
    with pytest.raises(CampaignError, match="the only things in braces"):
        load(command.replace("'", "''"))
    assert load("x {{}} {port} {cells}").av.traci.words(1, 2) == ["x", "{}", "1", "2"]
