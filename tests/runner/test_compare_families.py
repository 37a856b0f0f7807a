"""Two vehicles in several scenarios: one verdict about the sum, a comparison of each scenario, and nothing twice."""

from __future__ import annotations

import json
import shutil

import pytest

import harness
from harness.cli import main
from harness.errors import CampaignError, RunFolderError
from harness.records.folder import read_manifest
from harness.runner.compare import compare_campaigns
from harness.runner.stored import write_report
from tests.in_process import one_process
from tests.runner.test_families import NAMES, QUICK

HARDER = "av.parameters.min_acceleration_mps2=-5"


def campaign(*overrides):
    return harness.load_campaign("idm", [*QUICK, *overrides])


@pytest.fixture(scope="module", autouse=True)
def _here():
    with one_process():
        yield


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    return compare_campaigns(campaign(), campaign(HARDER), tmp_path_factory.mktemp("pairs") / "out", workers=1)


def test_the_sum_is_that_of_the_scenarios(done):
    told, total = done.content, 0.0
    assert (told["decision"]["verdict"], done.exit_code) == ("proven", 0)  # idm brakes with 4 m/s² at most
    for name, of in told["families"].items():
        own = json.loads((done.folder / name / "compare.json").read_text())
        side = told["a"]["families"][name]
        per_hour = side["exposure"]["per_hour"] / side["p_event"]
        assert of["difference"] == pytest.approx(per_hour * own["difference"])
        ends = [per_hour * own[end] for end in ("ci_low", "ci_high")]
        assert [of["ci_low"], of["ci_high"]] == pytest.approx(ends, rel=0.2)  # that of events is uncertain, too
        assert (own["ended"], own["decision"]) == ("sum", of["decision"])
        a, b = (read_manifest(done.folder / name / side) for side in "ab")
        assert a["n_episodes"] == b["n_episodes"] == of["n_pairs"]
        total += of["difference"]
    assert told["difference"] == pytest.approx(total)
    assert told["ci_low"] < total < told["ci_high"]
    rates = [told[side]["per_hour"]["rate"] for side in "ab"]
    assert rates[0] - rates[1] == pytest.approx(total)
    assert told["ratio"] == pytest.approx(rates[0] / rates[1])
    out = repr(done)
    assert out.startswith("B crashes less often than A · ")
    assert "3 scenarios · crashes per hour" in out.splitlines()[0]
    page = done.report.read_text()
    assert all(f'<a href="{name}/report.html">' in page for name in NAMES)
    assert (done.folder / "lead_brakes" / "a" / "report.html").is_file()


def test_pages_are_written_anew(done):
    pages = [done.report, *(done.folder / name / "report.html" for name in NAMES)]
    before = [page.read_text() for page in pages]
    for page in pages:
        page.unlink()
    assert write_report(done.folder) == done.report
    assert [page.read_text() for page in pages] == before


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return harness.run(campaign(), tmp_path_factory.mktemp("stored") / "run", workers=1)


def test_what_an_earlier_call_has_driven_is_not_driven_again(done, monkeypatch):
    monkeypatch.setattr("harness.runner.workers.ShardRunner.run", None)
    again = compare_campaigns(campaign(), campaign(HARDER), done.folder, workers=1)
    assert again.content == done.content


@pytest.mark.slow
def test_nor_are_tests_of_a_stored_run_of_a_in_the_same_scenarios(run, tmp_path, capsys):
    call = ["compare", str(run.folder), "late-600ms", "--out", str(tmp_path / "out"), "--workers", "1", "--json"]
    assert main(call) in (0, 4)  # so small a pool may be used up
    found = json.loads(capsys.readouterr().out)
    for name in NAMES:
        held, n_pairs = read_manifest(run.folder / name)["n_episodes"], found["families"][name]["n_pairs"]
        n = read_manifest(tmp_path / "out" / name / "a")["n_episodes"]
        assert max(held, n_pairs) <= n < held + n_pairs  # those held are of strata that pairs need, or not
    assert [of["label"] for of in found["campaigns"].values()] == ["idm", "late-600ms"]  # as A's campaign says
    a, b = (found[side] for side in "ab")
    assert a["per_hour"]["rate"] - b["per_hour"]["rate"] == pytest.approx(found["difference"])
    assert a["n_episodes"] == b["n_episodes"] == found["n_pairs"]  # further tests that are held do not count


def test_a_stored_campaign_that_is_damaged_is_not_believed(run, tmp_path):
    stored = tmp_path / "stored"
    shutil.copytree(run.folder, stored)
    file = stored / "campaign.yaml"
    file.write_text(file.read_text().replace("exposure: {}", "exposure: {lead_brakes: 7.0}"))
    with pytest.raises(RunFolderError, match="checksum"):
        compare_campaigns(campaign(), campaign(HARDER), tmp_path / "out", stored=stored)
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_compared_is_refused(done, tmp_path):
    each, limit = "stop.each_family=true", "accept.times_reference={driver: r157-cc, at_most: 1.0}"
    for of_a, of_b, said in (
        ((each,), (each, HARDER), r"stop\.each_family"),
        ((), ("scenarios=[cut_in, lead_brakes]",), "^scenarios"),
        ((), ("exposure.lead_brakes=0.3",), r"^exposure"),
        ((limit,), (limit, HARDER), "a limit of one crash rate"),
    ):
        with pytest.raises(CampaignError, match=said):
            compare_campaigns(campaign(*of_a), campaign(*of_b), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(RunFolderError, match="another campaign"):
        compare_campaigns(campaign("seed=2"), campaign("seed=2", HARDER), done.folder)
    alone = campaign("scenarios=null"), campaign("scenarios=null", HARDER)
    with pytest.raises(RunFolderError, match="a folder with cut_in"):
        compare_campaigns(*alone, done.folder)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "families.json").touch()
    with pytest.raises(RunFolderError, match=r"a folder with families\.json"):
        compare_campaigns(campaign(), campaign(HARDER), tmp_path / "run")
