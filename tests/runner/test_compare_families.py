"""Two vehicles in several scenarios: one verdict about the sum, a comparison of each scenario, and nothing twice."""

from __future__ import annotations

import json

import pytest

from harness.errors import CampaignError, RunFolderError
from harness.records.folder import read_manifest
from harness.runner.compare import compare_campaigns
from harness.runner.stored import write_report
from tests.in_process import one_process, without_page
from tests.runner.test_families import HARDER, NAMES, campaign


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


def test_what_an_earlier_call_has_driven_is_not_driven_again(done, monkeypatch):
    monkeypatch.setattr("harness.runner.workers.ShardRunner.run", None)
    with without_page():
        assert compare_campaigns(campaign(), campaign(HARDER), done.folder, workers=1).content == done.content


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
