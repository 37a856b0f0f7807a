"""SUMO's TraCI server must not be open to strangers without a word."""

from __future__ import annotations

import pytest

from harness.campaign.files import load_campaign
from harness.errors import CampaignError, WorldDisagreementError
from harness.runner.look import plan_campaign
from harness.worlds import program
from tests.sumo_av.running import EXAMPLE, ROOT

FORCED = ROOT / "scenarios/overtaking_forced.yaml"
COMMAND = f"python {EXAMPLE} --port {{port}} --cells {{cells}}"


def load(command, more=""):
    return load_campaign(FORCED, [f"av={{traci: {{command: '{command}'{more}}}}}"])


def test_a_machine_with_a_public_address_is_refused_unless_it_is_allowed(monkeypatch):
    assert "127.0.0.1" in program.own_addresses()
    addresses = {"127.0.0.1", "10.1.2.3", "192.168.0.9"}
    monkeypatch.setattr(program, "own_addresses", lambda: addresses)
    monkeypatch.setattr("harness.runner.look.seconds_per_test", lambda _: 0.1)
    plain, allowed = load(COMMAND), load(COMMAND, ", allow_public: true")
    plan_campaign(plain)
    addresses.add("8.8.4.4")
    plan_campaign(allowed)
    with pytest.raises(CampaignError, match=r"8\.8\.4\.4.*allow_public") as caught:
        plan_campaign(plain)
    assert caught.value.where == "av.traci"
    assert plain.av.identity() == allowed.av.identity()


def test_a_client_of_another_machine_ends_the_run():
    program.require_neighbour("0100007F:B267", "0100007F:A6BC")
    program.require_neighbour("0A01A8C0:B267", "0A01A8C0:A6BC")  # this machine, by its own address
    with pytest.raises(WorldDisagreementError, match="a client at"):
        program.require_neighbour("0A01A8C0:B267", "0B01A8C0:A6BC")


@pytest.mark.parametrize("command", ["x {port.x}", "x {}", "x {port:5}", "x {ports}", "x {", "x '", " "])
def test_only_port_and_cells_stand_in_braces(command):
    with pytest.raises(CampaignError, match="the only things in braces"):
        load(command.replace("'", "''"))
    assert load("x {{}} {port} {cells}").av.traci.words(1, 2) == ["x", "{}", "1", "2"]
