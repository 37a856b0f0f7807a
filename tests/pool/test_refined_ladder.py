"""The adaptive ladder: known drivers are found again, and what is no driver is called so."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from harness.campaign.files import dump_campaign, load_campaign
from harness.campaign.vehicle import IDMParameters, Reflexes
from harness.cli import main
from harness.episode.loop import traced_by_index
from harness.errors import CampaignError, RunFolderError
from harness.pool.fit_driver import expected, fit_driver
from harness.pool.library import LibraryIDM, load_library
from harness.pool.observed import WINDOW_STEPS, read_observed
from harness.pool.predicted import predict, replay_drivers
from harness.pool.refined_ladder import free_names, more_careless, refine_ladder
from harness.runner import run_campaign
from tests.pool.conftest import SMALL_POOL

ROOT = Path(__file__).parents[2]
FORCED_FILE = ROOT / "scenarios" / "overtaking_forced.yaml"
SMALL = ("stop.rhw=null", "run.shard_size=200")
TWIN = "world.engine=twin"
ALL = "records.traces=all"
LATE = "av={model: idm, parameters: {min_acceleration_mps2: -5}, reaction: {delay_s: 0.6}}"
SMOOTH = "av={model: idm, reaction: {delay_s: 0.3, max_jerk_mps3: 6}}"
WEAK = "av={model: idm, parameters: {min_acceleration_mps2: -1}}"
NOISY = "av={controller: 'tests.pool.test_refined_ladder:WhiteNoise'}"


class WhiteNoise:
    """Accelerates as chance will have it, whatever happens."""

    def start(self, episode):
        self.random = episode.random

    def step(self, seen):
        return self.random.uniform(-6.0, 2.0)

    def close(self):
        pass


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run a campaign without its page, each once; returns folder and campaign."""

    @cache
    def run_without_page(*overrides, n=140):
        folder = tmp_path_factory.mktemp("ladder") / "run"
        campaign = load_campaign(FORCED_FILE, [*SMALL, f"stop.episodes={n}", *overrides])
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(ROOT)
            patch.setattr("harness.report.write_report", lambda folder: folder / "report.html")
            result = run_campaign(campaign, folder, workers=1)
        return folder, campaign, result

    return run_without_page


@pytest.fixture(scope="module")
def late(run):
    return run(LATE, TWIN, ALL)


@pytest.fixture(scope="module")
def ladder(late, tmp_path_factory):
    """What came of the late driver's run, and the library that was written."""
    out = tmp_path_factory.mktemp("library") / "mine.yaml"
    return refine_ladder(late[0], out), out


def reflexes(driver):
    return driver.reaction.delay_s, driver.reaction.max_jerk_mps3


def test_a_late_driver_is_found_again_and_predicts_every_crash(ladder):
    refined, _ = ladder
    assert reflexes(refined.fitted.driver) == (0.6, None)
    assert refined.fitted.driver.parameters.min_acceleration_mps2 == pytest.approx(-5.0, abs=0.05)
    assert refined.explained > 0.999
    assert (refined.prediction.only_av, refined.prediction.only_driver) == (0, 0)
    assert refined.prediction.both >= 3
    assert refined.prediction.caught == 1.0
    assert refined.predicted
    assert refined.n_checked + refined.fitted.n_cut_ins == 140


def test_a_jerk_limit_is_told_from_a_delay(run, tmp_path):
    folder, _, _ = run(SMOOTH, TWIN, ALL)
    driver = refine_ladder(folder, tmp_path / "mine.yaml").fitted.driver
    assert driver.reaction.delay_s == 0.3
    assert driver.reaction.max_jerk_mps3 == pytest.approx(6.0, rel=0.02)
    assert driver.parameters.min_acceleration_mps2 == pytest.approx(-4.0, abs=0.05)


def test_white_noise_is_reported_as_not_predicted(run, tmp_path):
    folder, _, _ = run(NOISY, TWIN, ALL)
    refined = refine_ladder(folder, tmp_path / "mine.yaml")
    assert refined.explained < 0.1
    assert not refined.predicted
    assert refined.statements[-1].startswith("NOT PREDICTED")
    assert "# NOT PREDICTED" in (tmp_path / "mine.yaml").read_text()


def test_the_library_is_the_runs_with_two_drivers_more(late, ladder):
    refined, out = ladder
    library, before = load_library(str(out)), load_library("ladder-2")
    assert library == refined.library
    assert library.surrogates.keys() - before.surrogates.keys() == {"fitted", "fitted-careless"}
    assert all(library.surrogates[name] == model for name, model in before.surrogates.items())
    assert library.boundary == before.boundary
    text = out.read_text()
    assert f"campaign {late[1].name}" in text
    assert "reacts after 0.6 s" in text


def test_a_second_ladder_finds_new_names(ladder):
    assert free_names(load_library("ladder-2")) == ("fitted", "fitted-careless")
    assert free_names(load_library(str(ladder[1]))) == ("fitted-2", "fitted-2-careless")


def test_an_av_beyond_the_boundary_moves_it(run, tmp_path):
    folder, _, _ = run(WEAK, TWIN, ALL)
    refined = refine_ladder(folder, tmp_path / "mine.yaml")
    assert refined.fitted.driver.parameters.min_acceleration_mps2 == pytest.approx(-1.0, abs=0.02)
    assert refined.library.boundary == "fitted-careless"


def test_the_neighbour_is_more_careless(late):
    driver = LibraryIDM(model="idm", reaction=Reflexes(delay_s=0.5, max_jerk_mps3=7.0))
    neighbour = more_careless(driver)
    assert neighbour.parameters.min_acceleration_mps2 > driver.parameters.min_acceleration_mps2
    assert reflexes(neighbour) == (0.7, 7.0)
    folder, campaign, _ = late
    replayed = replay_drivers(folder, campaign, [driver, neighbour])
    assert (replayed.drivers[:, 1] | ~replayed.drivers[:, 0]).all()
    assert replayed.drivers[:, 1].sum() > replayed.drivers[:, 0].sum()


# -- what is observed --


def test_only_traces_that_do_not_depend_on_the_outcome_are_used(run):
    folder, campaign, _ = run(LATE, TWIN, "records.traces=crash", "records.trace_share=0.4", n=300)
    observed = read_observed(folder, campaign)
    episodes = np.arange(300)
    assert observed.episode.tolist() == episodes[traced_by_index(campaign.seed, episodes, 0.4)].tolist()


def test_the_avs_own_model_gives_the_accelerations_observed_in_every_bit(run):
    folder, campaign, _ = run(SMOOTH, TWIN, ALL)
    observed = read_observed(folder, campaign)
    assert observed.episode.size == 140
    assert np.diff(observed.begin).max() == WINDOW_STEPS
    own = LibraryIDM(model="idm", reaction=Reflexes(delay_s=0.3, max_jerk_mps3=6.0))
    assert (expected(own, observed) == observed.acceleration).all()
    other = own.model_copy(update={"reaction": Reflexes(delay_s=0.2, max_jerk_mps3=6.0)})
    assert (expected(other, observed) != observed.acceleration).any()


def test_a_fit_does_not_depend_on_the_order_of_cut_ins(late):
    folder, campaign, _ = late
    observed = read_observed(folder, campaign).part(np.arange(50))
    backward = observed.part(np.arange(50)[::-1])
    assert backward.episode.tolist() == observed.episode.tolist()[::-1]
    one, other = (fit_driver(cut_ins, 2.0).driver for cut_ins in (observed, backward))
    assert reflexes(one) == reflexes(other)
    assert one.parameters.min_acceleration_mps2 == pytest.approx(other.parameters.min_acceleration_mps2, abs=0.02)


# -- how crashes are predicted --


def test_weights_add_up_to_the_runs_own_estimate(run, late):
    folder, campaign, result = late
    replayed = replay_drivers(folder, campaign, [LibraryIDM(model="idm")])
    assert predict(replayed, 0).crash_rate == pytest.approx(result.estimates["estimates"]["nade"]["crash_rate"])
    shells = ("testing.method=shells", "stop.episodes=400", *SMALL_POOL)
    folder, campaign, result = run(LATE, TWIN, *shells)
    replayed = replay_drivers(folder, campaign, [LibraryIDM(model="idm")])
    assert predict(replayed, 0).crash_rate == pytest.approx(result.estimates["estimates"]["shells"]["crash_rate"])


def test_the_avs_own_model_crashes_exactly_where_the_av_does(run):
    folder, campaign, _ = run(LATE, TWIN, n=800)
    own = LibraryIDM(model="idm", parameters=IDMParameters(min_acceleration_mps2=-5.0), reaction=Reflexes(delay_s=0.6))
    careful = own.model_copy(update={"parameters": IDMParameters(min_acceleration_mps2=-8.0)})
    replayed = replay_drivers(folder, campaign, [own, careful])
    assert replayed.av.sum() >= 50
    assert (replayed.drivers[:, 0] == replayed.av).all()
    found = predict(replayed, 1)
    assert (found.only_driver, found.false_alarms) == (0, 0.0)
    assert 0.1 < found.caught < 0.9
    part = replayed.apart_from(np.arange(0, 800, 2))
    assert part.episode.tolist() == list(range(1, 800, 2))
    assert predict(part, 0).caught == 1.0


# -- refusals --


def unrun(folder, *overrides):
    """A folder with nothing but a campaign: what can be refused by that alone."""
    folder.mkdir()
    text = dump_campaign(load_campaign(FORCED_FILE, overrides))
    (folder / "campaign.yaml").write_text(text, encoding="utf-8")
    return folder


def test_without_an_outcome_independent_share_there_is_no_ladder(tmp_path, capsys):
    folder = unrun(tmp_path / "run", "records.traces=crash")
    assert main(["ladder", str(folder), "--out", str(tmp_path / "mine.yaml")]) == 2
    assert "records.trace_share=0.2" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [folder]


def test_too_few_cut_ins_are_refused(run, tmp_path):
    folder, _, _ = run(LATE, TWIN, ALL, "testing.method=nde")
    with pytest.raises(RunFolderError, match=r"found 0 cut-ins .* testing\.method shells or forced"):
        refine_ladder(folder, tmp_path / "mine.yaml")


def test_an_av_that_acts_before_the_cut_in_is_refused(tmp_path):
    early = NOISY.replace("}", ", before_cut_in: controller}")
    with pytest.raises(CampaignError, match="as all surrogates do"):
        refine_ladder(unrun(tmp_path / "run", early), tmp_path / "mine.yaml")


def test_a_library_is_never_written_over(late, tmp_path):
    (tmp_path / "mine.yaml").write_text("mine")
    with pytest.raises(RunFolderError, match="there already"):
        refine_ladder(late[0], tmp_path / "mine.yaml")
    assert (tmp_path / "mine.yaml").read_text() == "mine"
    with pytest.raises(CampaignError, match=r"--out mine\.yaml"):
        refine_ladder(late[0], tmp_path / "mine")


def test_the_command_prints_what_it_found(late, tmp_path, capsys):
    assert main(["ladder", str(late[0]), "--out", str(tmp_path / "mine.yaml")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("fitted: an IDM that reacts after 0.6 s")
    assert lines[-1] == str(tmp_path / "mine.yaml")
