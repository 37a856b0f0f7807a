"""Cut-ins that take time, in the twin: the same crossings, and an AV that may act from the onset on."""

from __future__ import annotations

import numpy as np
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import Reaction
from harness.campaign.sections import EnvironmentSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.episode.cells import drawn_traffic
from harness.episode.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.importance.functions import build_importance
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import AV, CRASH, CUT_IN, PASSED, STATE_DTYPE
from harness.worlds.twin import TwinWorld
from tests.chains.seed import SEED

N = 3000
CELLS = 256
LATERAL = "ndd-overtaking-1-lateral"
IDM = AutomatedVehicle()
SEES_ONSET = AutomatedVehicle(reaction=Reaction(perceives_lateral_m=0.0))
BLIND = AutomatedVehicle(reaction=Reaction(perceives_lateral_m=10.0))
NEVER = AutomatedVehicle(model="constant")


def campaign(method="forced", lead_s=None, av=IDM, *, log_normal=False, level=1.0) -> Campaign:
    parameters = LATERAL if log_normal else "ndd-overtaking-1"
    environment = EnvironmentSettings(parameters=parameters, cut_in_lead_s=lead_s, lane_change_level=level)
    return Campaign(name="lateral", seed=SEED, environment=environment, av=av, testing={"method": method})


def drive(one: Campaign, traces: str = "none"):
    ready = prepare(resolve(one))
    return ready.loop(TwinWorld(CELLS), traces=traces).run(0, ready.states(0, N))


def episodes(one: Campaign):
    return drive(one).results.episode


def outcome_bits(episode) -> list[bytes]:
    names = ("outcome", "n_steps", "crash_time_s", "impact_speed_mps", "log_weight", "cut_in_step")
    return [episode[name].tobytes() for name in names]


@pytest.mark.parametrize("log_normal", [False, True])
@pytest.mark.parametrize(("method", "level"), [("nde", 1e5), ("forced", 1.0)])
def test_the_crossing_looked_for_ahead_is_the_one_met_on_the_way(method, level, log_normal):
    lead_s = None if log_normal else 1.5
    met = episodes(campaign(method, None, IDM, level=level))
    ahead = episodes(campaign(method, lead_s, IDM, level=level, log_normal=log_normal))
    assert np.array_equal(met["cut_in_step"], ahead["cut_in_step"])
    assert np.array_equal(met["log_weight"], ahead["log_weight"])
    came = ahead["cut_in_step"] >= 0
    onset = np.maximum(ahead["cut_in_step"] - ahead["lead_steps"], 0)
    assert np.array_equal(ahead["onset_step"][came], onset[came])
    assert (ahead["lead_steps"][came] > 0).mean() > 0.9


@pytest.mark.parametrize("lead_s", [0.5, None])
@pytest.mark.parametrize("av", [BLIND, NEVER], ids=["blind", "never brakes"])
def test_one_that_sees_nothing_before_the_overlap_ends_alike_at_every_lead(av, lead_s):
    before = outcome_bits(episodes(campaign("forced", None, av)))
    assert outcome_bits(episodes(campaign("forced", lead_s, av, log_normal=lead_s is None))) == before
    seen = outcome_bits(episodes(campaign("forced", lead_s, IDM, log_normal=lead_s is None)))
    assert seen != outcome_bits(episodes(campaign("forced", None)))  # one that sees the onset does not


def test_the_av_keeps_its_speed_until_it_may_act_and_acts_then():
    shard = drive(campaign(lead_s=1.0, av=SEES_ONSET), "all")
    acted = 0
    for row, trace in list(shard.traces.items())[:500]:
        commanded, onset = trace[:-1, AV, 2], int(shard.results.episode["onset_step"][row])
        assert (commanded[: onset + 1] == 0.0).all()
        acted += commanded.size > onset + 1 and commanded[onset + 1] != 0.0
    assert acted > 450


BESIDE = [(-0.5, CRASH), (-9.9985, CRASH), (0.5, None), (-9.9995, PASSED), (-0.0005, None), (-0.0015, CRASH)]


def beside(r2_m: list[float]):
    """States and traffic of cut-ins in the first step, at an R2 each; nobody but the AV changes speed."""
    states, zero = np.array([(25.0, 60.0, 0.0, r2, 0.0) for r2 in r2_m], STATE_DTYPE), np.zeros(len(r2_m), np.int64)
    lv, bv = np.full((2, len(r2_m), 22), 20, np.int8)
    bv[:, 1] = CUT_IN
    traffic = drawn_traffic()._replace(lv=lv, bv=bv, cut_step=zero, stratum=zero, log_weight=np.zeros(len(r2_m)))
    return states, traffic._replace(lead=zero)


def policy_of(av: AutomatedVehicle, lead_s: float) -> Drawing:
    resolved = resolve(one := campaign("shells", lead_s, av))
    return Drawing(1, resolved.environment, build_importance(one, None), resolved.av)


@pytest.mark.parametrize(("r2_m", "outcome"), BESIDE)
def test_in_the_first_state_of_overlap_touching_is_a_crash_and_being_ahead_is_having_passed(r2_m, outcome):
    shard = EpisodeLoop(TwinWorld(1), policy_of(NEVER, 1.0), RecordPolicy(0, "none", 0.0)).run(0, *beside([r2_m]))
    episode = shard.results.episode[0]
    if outcome is None:
        assert episode["n_steps"] > 1
    else:
        assert (episode["outcome"], episode["n_steps"]) == (outcome, 1)
        contact = episodes_table(shard, 1).column("contact").to_pylist()
        assert contact == ["side" if outcome == CRASH else None]
