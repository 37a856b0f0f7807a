"""The command end to end: files, table, the same bits for any number of workers, which do not outlive it, the twin."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from harness.errors import CampaignError
from harness.progress import Progress
from studies.__main__ import main
from studies.replication import run
from studies.replication.experiment import load_experiment
from tests.studies.here import Here

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[2] / "scenarios" / "validate"
CHAINS = """
format: validation-experiment
version: 1
name: small
seed: 4
replications: 12
chains: [good surrogates, strong noise]
campaign: {testing: {method: shells}, stop: {rhw: 0.5, episodes: 3000}}
super_population: {pool_paths: 256}
"""


def test_workers_change_no_bit_and_the_online_rule_is_followed(tmp_path, monkeypatch):
    (tmp_path / "x.yaml").write_text(CHAINS)
    folders = tmp_path / "2", tmp_path / "here"
    assert main(["validate", str(tmp_path / "x.yaml"), "--out", str(folders[0]), "--workers", "2"]) == 0
    monkeypatch.setattr(run, "worker_processes", lambda workers: Here())
    assert main(["validate", str(tmp_path / "x.yaml"), "--out", str(folders[1])]) == 0
    texts = [(folder / "results.json").read_text() for folder in folders]
    tables = [pq.read_table(folder / "replications.parquet") for folder in folders]
    assert texts[0] == texts[1]
    assert tables[0].equals(tables[1])
    content, rows = json.loads(texts[0]), tables[0].to_pylist()
    assert content["confidence"] == 0.9
    assert [one["subject"] for one in content["judgements"]] == ["good surrogates"] * 4 + ["strong noise"] * 4
    assert len(rows) == 2 * 4 * 12
    bounds = [row for row in rows if "upper bound" in row["result"]]
    assert all(row["ci_low"] == 0.0 for row in bounds)
    assert len(bounds) == 2 * 2 * 12
    for row in rows:
        if row in bounds:
            continue
        rhw = (row["ci_high"] - row["ci_low"]) / 2.0 / row["crash_rate"] if row["crash_rate"] else float("inf")
        assert row["reached"] == (rhw <= 0.5 and row["n_crashes"] > 0)


ENUMERATED = """
format: validation-experiment
version: 1
name: enumerated
replications: 8
campaign: {environment: {parameters: ndd-overtaking-1}, testing: {method: shells}, stop: {rhw: 0.5, episodes: 2000}}
super_population: {paths: 1024, reference_paths: 1024, pool_paths: 256}
avs: {idm: {}}
adversaries: {hole: {of: idm, hole: 0.3}}
"""


def test_enumerated_vehicles_alone_and_compared(tmp_path, monkeypatch):
    """A hole outside the boundary: the library's statement knows nothing of it, alone and in a comparison.

    Verdicts beside a reference driver are judged, too: which of them is wrong follows from the vehicle's ratio.
    """
    monkeypatch.setattr(run, "worker_processes", lambda workers: Here())
    found = {}
    decided = "verdicts: [3]\nbeside: r157-cc\nbudgets: [200]", ["super_population.reference_paths=0"]
    for more, overrides in (decided, ("pairs: {pair: {a: idm, b: hole}}", [])):
        (tmp_path / "x.yaml").write_text(ENUMERATED + more)
        judgements = run.validate(load_experiment(tmp_path / "x.yaml", overrides), tmp_path, None, Progress())
        found |= {(one["subject"], one["result"]): one for one in judgements}
    assert all(one["covered"] >= 6 for one in found.values() if one["assumption_met"])
    wrong = {"shells, library", "difference, conditional"}
    assert {(one["result"], one["covered"]) for one in found.values() if not one["assumption_met"]} == {
        (w, 0) for w in wrong
    }
    truth, same = (found["idm", result]["truth"] for result in ("shells", "shells, upper bound"))
    assert truth == pytest.approx(same, rel=1e-12)  # both that of the pools' paths
    verdicts = {key: one for key, one in found.items() if key[1].startswith("limit ")}
    assert {name for name, _ in verdicts} == {"idm", "hole"}
    for (name, result), one in verdicts.items():
        factor = 3.0 / found[name, "ratio to r157-cc"]["truth"]
        assert float(result.split()[1]) == pytest.approx(factor, rel=0.3)
        assert ("rejected" in result) == (factor > 1.0)
        assert one["covered"] == one["replications"]
    assert {one["reached"] for (name, _), one in verdicts.items() if name == "idm"} >= {1.0}
    beyond = found["hole", "shells, upper bound beyond library"]["truth"]
    assert found["pair", "difference"]["truth"] == pytest.approx(-beyond) != 0.0


# -- experiments are read strictly, and what cannot be repeated is refused in words --

HEAD = "format: validation-experiment\nversion: 1\nname: x\n"
SHELLS = "campaign: {testing: {method: shells}}\n"
ACTS = "avs: {c: {controller: 'a.b:C', before_event: controller}}\n"


def written(tmp_path, text: str) -> Path:
    file = tmp_path / "x.yaml"
    file.write_text(HEAD + text)
    return file


EXPERIMENTS = [file for file in sorted(FOLDER.glob("*.yaml")) if "format: validation" in file.read_text("utf-8")]


@pytest.mark.parametrize("file", EXPERIMENTS, ids=lambda file: file.stem)
def test_shipped_experiments_are_right(file):
    experiment = load_experiment(file)
    assert experiment.name == file.stem.replace("_", "-")
    assert experiment.campaign.world.engine == "twin"


def test_budgets_end_with_that_of_the_campaign(tmp_path):
    file = written(tmp_path, "chains: [rare]\nlimits: [1]\nbudgets: [3_000, 30_000]\n" + SHELLS)
    for most, budgets in ((400_000, (3_000, 30_000, 400_000)), (9_000, (3_000, 9_000)), (3_000, (3_000,))):
        assert load_experiment(file, [f"campaign.stop.episodes={most}"]).all_budgets == budgets


@pytest.mark.parametrize(
    ("text", "where", "found"),
    [
        ("avs: {acc: {sumo: {carFollowModel: ACC}}}\n" + SHELLS, "avs.acc", "av.sumo"),
        ("avs: {mine: {controller: 'a.b:C'}}\n" + SHELLS, "avs.mine", "av.controller with before_event hold_speed"),
        (ACTS + "pairs: {p: {a: c, b: c}}\n" + SHELLS, "pairs.p", "'c'"),
        ("avs: {a: {}}\npairs: {p: {a: a, b: a}}\nlimits: [1]\n" + SHELLS, "limits", "pairs"),
        ("avs: {a: {}}\nverdicts: [1]\n" + SHELLS, "beside", "none"),
        ("avs: {a: {before_event: controller}}\n" + SHELLS, "avs.a", "a built-in model"),
        (SHELLS, "avs", "neither"),
        ("avs: {a: {}}\nchains: [rare]\n" + SHELLS, "avs", "both"),
        ("chains: [rare]\ncampaign: {world: {engine: sumo}}\n", "campaign.world.engine", "sumo"),
        ("chains: [rare]\ncampaign: {pool: {library: ./none.yaml}}\n", "none.yaml", "no such file"),
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
