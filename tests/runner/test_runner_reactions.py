"""Late, smooth and inattentive drivers in campaigns: any number of cells, resumed, and with either start."""

from __future__ import annotations

import pytest

from harness.campaign.files import load_campaign
from harness.errors import CampaignError
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.worlds.twin import TwinWorld
from tests.runner.conftest import MIXTURE_FILE, TWIN
from tests.stored_runs import stored_table, unlike_columns

REACTION = "{delay_s: 0.4, max_jerk_mps3: 8, inattention_probability: 0.4, inattention_delay_s: 1.1}"
AV = f"av={{model: idm, reaction: {REACTION}}}"
FORCED = ("testing.method=forced", "records.traces=all", AV)


@pytest.fixture(scope="module")
def whole(campaign, run_here, tmp_path_factory):
    out = tmp_path_factory.mktemp("reactions") / "run"
    run_here(campaign(*TWIN, *FORCED), out)
    return out


def test_any_number_of_cells_gives_the_same_bits(whole, campaign, run_here, tmp_path):
    run_here(campaign(*TWIN, *FORCED, "world.cells=7"), tmp_path / "run")
    assert unlike_columns(whole, tmp_path / "run") == []


def test_resumed_after_a_part_gives_the_same_bits(whole, campaign, run_here, tmp_path):
    run_here(campaign(*TWIN, *FORCED, "stop.episodes=160"), tmp_path / "run")
    run_here(campaign(*TWIN, *FORCED, "world.cells=16"), tmp_path / "run", resume=True)
    assert stored_table(tmp_path / "run", "episodes").num_rows == 400
    assert unlike_columns(whole, tmp_path / "run") == []


def test_another_inattention_is_noticed(whole, campaign, run_here, tmp_path):
    more = AV.replace("probability: 0.4", "probability: 0.45")
    run_here(campaign(*TWIN, *FORCED[:-1], more), tmp_path / "run")
    assert "traces.a_mps2" in unlike_columns(whole, tmp_path / "run")


@pytest.mark.parametrize("method", ["nde", "step_mixture"])
def test_a_built_in_driver_keeps_its_speed_until_it_has_reacted(method):
    settings = (*TWIN, "stop.rhw=null", f"testing.method={method}", "environment.lane_change_level=3000", AV)
    prepared = prepare(resolve(load_campaign(MIXTURE_FILE, settings)))
    shard = prepared.loop(TwinWorld(16), traces="all").run(0, prepared.states(0, 200))
    rows = shard.results.episode
    assert (rows["cut_in_step"] >= 0).sum() >= 5
    for row, trace in shard.traces.items():
        cut = int(rows["cut_in_step"][row])
        assert (trace[: cut + 5 if cut >= 0 else -1, 2, 2][:-1] == 0.0).all()


def test_a_built_in_driver_that_would_act_before_the_cut_in_is_refused():
    with pytest.raises(CampaignError, match="has nothing to follow before the cut-in"):
        load_campaign(MIXTURE_FILE, ["testing.method=nde", AV, "av.before_cut_in=controller"])
