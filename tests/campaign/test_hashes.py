"""Campaign hashes are those of earlier versions: runs on disk go on, and a changed default is noticed."""

import hashlib
import json
from pathlib import Path

import pytest

from harness.campaign.files import load_campaign, load_panel
from harness.resolved import resolve

FOLDER = Path(__file__).parents[2] / "scenarios"
SHIPPED = {
    "overtaking_forced": "b372a814b6bd6800",
    "overtaking_mixture": "418c17ecd91dbf05",
    "overtaking_nade": "399ca2421adf69d9",
    "overtaking_nade_epsilon_0.1": "9c126fcf2823adcd",
    "overtaking_nde": "71294e917364cdb2",
    "overtaking_recursive": "a43f69057d98143b",
    "smoke": "e96a008c5e8b50b4",
}
PANEL = "85f51781dfe16fec"
CHANGED = [
    (["testing.shells.stopping=sequential"], "7af628145960e74a"),  # of before; the only way that is left
    (["environment.cut_in_lead_s=0.5"], "849f9c8cd132d0f4"),
    (["testing.shells.smallest_round=8"], "9effa1d477121757"),
    (["av={controller: 'a:B', parameters: {x: 1}, before_cut_in: controller}"], "0b74ded34c4cb2ce"),
    (["av={controller: 'a:B', warm_up_s: 0}"], "e554cf95f11fe057"),  # as before there was one
    (["av={traci: {command: x}}"], "bd13597d5b96bc4b"),
    (["av={sumo: {tau: 1}}"], "32f3238a2fdebd9c"),
    (["testing.shells.statements={mine: {boundary: brakes-3, checked: true}}"], "ebd005bdfd4934f6"),
    (["surrogates={}", "accept.crash_rate_below=1e-7"], "8550aa94734883c2"),
    (["testing.method=forced"], "03cae7d7dff5e59c"),
    (["run.shard_size=7", "records.moments=all", "pool.library=ladder-1"], "a96e964afce39346"),
]


def test_shipped_scenarios():
    found = {
        file.stem: resolve(load_campaign(file)).content_hash for file in FOLDER.glob("*.yaml") if file.stem in SHIPPED
    }
    assert found == SHIPPED


@pytest.mark.parametrize(("changes", "expected"), CHANGED, ids=str)
def test_changed_scenarios(changes, expected):
    assert load_campaign(FOLDER / "smoke.yaml", changes).content_hash("p") == expected


def test_the_panel():
    found = {name: load_campaign(FOLDER / "smoke.yaml", av=name).content_hash("p") for name in load_panel().avs}
    assert hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()[:16] == PANEL
