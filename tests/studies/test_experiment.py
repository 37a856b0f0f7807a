"""Experiments are read strictly, and what cannot be repeated is refused in words."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.errors import CampaignError
from studies.__main__ import main
from studies.replication.experiment import load_experiment

FOLDER = Path(__file__).parents[2] / "scenarios" / "validate"
HEAD = "format: validation-experiment\nversion: 1\nname: x\n"
SHELLS = "campaign: {testing: {method: shells}}\n"


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
        ("avs: {acc: {sumo: {carFollowModel: ACC}}}\n" + SHELLS, "avs.acc", "an AV that av.sumo drives"),
        ("avs: {mine: {controller: 'a.b:C'}}\n" + SHELLS, "avs.mine", "av.controller drives from the cut-in on"),
        (
            "avs: {mine: {controller: 'a.b:C', before_cut_in: controller}}\ncampaign: {testing: {method: forced}}\n",
            "avs.mine.before_cut_in",
            "controller",
        ),
        ("avs: {a: {}}\npairs: {p: {a: a, b: nobody}}\n" + SHELLS, "pairs.p.b", "nobody"),
        (
            "avs: {a: {}, c: {controller: 'a.b:C', before_cut_in: controller}}\npairs: {p: {a: a, b: c}}\n" + SHELLS,
            "pairs.p.b",
            "'c'",
        ),
        ("avs: {a: {}}\npairs: {p: {a: a, b: a}}\ncampaign: {testing: {method: nde}}\n", "pairs", "nde"),
        ("avs: {a: {}}\nadversaries: {a: {of: a}}\n" + SHELLS, "adversaries.a", "a name that avs has"),
        ("avs: {a: {before_cut_in: controller}}\n" + SHELLS, "avs.a.before_cut_in", "controller"),
        (SHELLS, "avs", "neither"),
        ("avs: {a: {}}\nchains: [rare]\n" + SHELLS, "avs", "both"),
        ("chains: [unheard-of]\n" + SHELLS, "chains", "unheard-of"),
        ("chains: [rare]\nestimators: [scv]\n" + SHELLS, "estimators", "scv"),
        ("chains: [rare]\ncampaign: {world: {engine: sumo}}\n", "campaign.world.engine", "sumo"),
        ("chains: [rare]\ncampaign: {world: twin}\n", "campaign.world", "twin"),
        ("chains: [rare]\ncampaign: {pool: {library: ./none.yaml}}\n", "campaign.pool.library", "no file"),
    ],
)
def test_wrong_ones_name_the_place(tmp_path, text, where, found):
    with pytest.raises(CampaignError) as caught:
        load_experiment(written(tmp_path, text))
    assert where in caught.value.where
    assert found in caught.value.found


def test_the_command_refuses_before_anything_is_written(tmp_path, capsys):
    file = written(tmp_path, "avs: {krauss: {sumo: {carFollowModel: Krauss}}}\n" + SHELLS)
    assert main(["validate", str(file), "--out", str(tmp_path / "out")]) == 2
    assert "avs.krauss" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
