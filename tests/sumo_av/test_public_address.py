"""SUMO's TraCI server must not be open to strangers without a word."""

from __future__ import annotations

import pytest

from harness.campaign.files import load_campaign
from harness.errors import CampaignError, WorldDisagreementError
from harness.runner import plan_campaign
from harness.worlds import program
from tests.sumo_av.running import EXAMPLE, ROOT

FORCED = ROOT / "scenarios/overtaking_forced.yaml"
COMMAND = f"python {EXAMPLE} --port {{port}} --cells {{cells}}"


def load(command, more=""):
    return load_campaign(FORCED, [f"av={{traci: {{command: '{command}'{more}}}}}"])


@pytest.mark.parametrize(
    ("addresses", "more", "refused"),
    [
        ({"127.0.0.1", "10.1.2.3", "192.168.0.9"}, "", False),
        ({"127.0.0.1", "8.8.4.4"}, "", True),
        ({"127.0.0.1", "8.8.4.4"}, ", allow_public: true", False),
    ],
)
def test_a_machine_with_a_public_address_is_refused_unless_it_is_allowed(addresses, more, refused, monkeypatch):
    monkeypatch.setattr(program, "own_addresses", lambda: addresses)
    monkeypatch.setattr("harness.runner.look.seconds_per_test", lambda _: 0.1)
    if not refused:
        plan_campaign(load(COMMAND, more))
        return
    with pytest.raises(CampaignError, match=r"8\.8\.4\.4.*allow_public") as caught:
        plan_campaign(load(COMMAND, more))
    assert caught.value.where == "av.traci"


def test_this_machines_own_addresses_are_found():
    assert "127.0.0.1" in program.own_addresses()


def test_permission_to_be_public_is_no_other_vehicle():
    assert load(COMMAND).av.identity() == load(COMMAND, ", allow_public: true").av.identity()


def test_a_client_of_another_machine_ends_the_run():
    program.require_neighbour("0100007F:B267", "0100007F:A6BC")
    program.require_neighbour("0A01A8C0:B267", "0A01A8C0:A6BC")  # this machine, by its own address
    with pytest.raises(WorldDisagreementError, match="a client at"):
        program.require_neighbour("0A01A8C0:B267", "0B01A8C0:A6BC")


@pytest.mark.parametrize(
    "command", ["x {port.x}", "x {port[0]}", "x {}", "x {0}", "x {port:5}", "x {ports}", "x {", "x '", " "]
)
def test_only_port_and_cells_stand_in_braces(command):
    with pytest.raises(CampaignError, match="the only things in braces"):
        load(command.replace("'", "''"))


def test_doubled_braces_are_braces():
    assert load("x {{}} {port} {cells}").av.traci.words(1, 2) == ["x", "{}", "1", "2"]
