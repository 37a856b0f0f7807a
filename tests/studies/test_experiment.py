"""Experiments are read strictly, and what cannot be repeated is refused in words."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.errors import CampaignError
from studies.__main__ import main
from studies.replication.experiment import load_experiment

FOLDER = Path(__file__).parents[2] / "scenarios" / "validate"
HEAD = "format: validation-experiment\nversion: 1\nname: x\n"
SHELLS, FORCED = (f"campaign: {{testing: {{method: {method}}}}}\n" for method in ("shells", "forced"))
ACTS = "avs: {c: {controller: 'a.b:C', before_cut_in: controller}}\n"


def written(tmp_path, text: str) -> Path:
    file = tmp_path / "x.yaml"
    file.write_text(HEAD + text)
    return file


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.yaml")), ids=lambda f: f.stem)
def test_shipped_experiments_are_right(file):
    experiment = load_experiment(file)
    assert experiment.name == file.stem.replace("_", "-")
    assert experiment.campaign.world.engine == "twin"


@pytest.mark.parametrize(
    ("text", "where", "found"),
    [
        ("avs: {acc: {sumo: {carFollowModel: ACC}}}\n" + SHELLS, "avs.acc", "av.sumo"),
        ("avs: {mine: {controller: 'a.b:C'}}\n" + SHELLS, "avs.mine", "av.controller with before_cut_in hold_speed"),
        (ACTS + FORCED, "avs.c", "controller"),
        ("avs: {a: {}}\npairs: {p: {a: a, b: nobody}}\n" + SHELLS, "pairs.p", "nobody"),
        (ACTS + "pairs: {p: {a: c, b: c}}\n" + SHELLS, "pairs.p", "'c'"),
        ("avs: {a: {}}\npairs: {p: {a: a, b: a}}\n" + FORCED, "campaign.testing.method", "forced"),
        ("avs: {a: {}}\npairs: {p: {a: a, b: a}}\nlimits: [1]\n" + SHELLS, "limits", "pairs"),
        ("avs: {a: {}}\nadversaries: {a: {of: a}}\n" + SHELLS, "adversaries.a", "a"),
        ("avs: {a: {before_cut_in: controller}}\n" + SHELLS, "avs.a", "a built-in model"),
        (SHELLS, "avs", "neither"),
        ("avs: {a: {}}\nchains: [rare]\n" + SHELLS, "avs", "both"),
        ("chains: [unheard-of]\n" + SHELLS, "chains", "unheard-of"),
        ("chains: [rare]\nestimators: [scv]\n" + SHELLS, "estimators", "scv"),
        ("chains: [rare]\ncampaign: {world: {engine: sumo}}\n", "campaign.world.engine", "sumo"),
        ("chains: [rare]\ncampaign: {world: twin}\n", "campaign.world", "twin"),
        ("chains: [rare]\ncampaign: {pool: {library: ./none.yaml}}\n", "campaign.pool.library", "no file"),
    ],
)
def test_wrong_ones_name_the_place_before_anything_is_written(tmp_path, capsys, text, where, found):
    file = written(tmp_path, text)
    with pytest.raises(CampaignError) as caught:
        load_experiment(file)
    assert where in caught.value.where
    assert found in caught.value.found
    assert main(["validate", str(file), "--out", str(tmp_path / "out")]) == 2
    assert where in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
