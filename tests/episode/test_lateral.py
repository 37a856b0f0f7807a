"""Cut-ins that take time, in the twin: the same crossings, and an AV that may act from the onset on."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import ConstantParameters, Reaction
from harness.campaign.sections import EnvironmentSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.episode.cells import PrescribedTraffic, drawn_traffic
from harness.episode.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.importance.build import build_importance
from harness.maneuvers import CUT_IN
from harness.pool.replay import Retracing
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.vocabulary import AV, BV, CRASH, PASSED, STATE_DTYPE
from harness.worlds.twin import TwinWorld
from tests.chains.seed import SEED

N = 3000
CELLS = 256
LATERAL = "ndd-overtaking-1-lateral"
IDM = AutomatedVehicle()
SEES_ONSET = AutomatedVehicle(reaction=Reaction(perceives_lateral_m=0.0))
BLIND = AutomatedVehicle(reaction=Reaction(perceives_lateral_m=10.0))
NEVER = AutomatedVehicle(model="constant")


def campaign(method="forced", lead_s=None, av=IDM, *, log_normal=False, level=1.0, delay_s=0.0) -> Campaign:
    parameters = LATERAL if log_normal else "ndd-overtaking-1"
    environment = EnvironmentSettings(parameters=parameters, cut_in_lead_s=lead_s, lane_change_level=level)
    if delay_s:
        reaction = av.reaction.model_copy(update={"delay_s": delay_s})
        av = av.model_copy(update={"reaction": reaction})
    drawn = {"method": method}
    return Campaign(name="lateral", seed=SEED, environment=environment, av=av, testing=drawn)


@cache
def _driven(asked: str, traces: str):
    one = Campaign.model_validate_json(asked)
    ready = prepare(resolve(one))
    return ready.loop(TwinWorld(CELLS), traces=traces).run(0, ready.states(0, N))


def drive(one: Campaign, traces: str = "none"):
    return _driven(one.model_dump_json(), traces)


def episodes(one: Campaign):
    return drive(one).results.episode


def outcome_bits(episode) -> list[bytes]:
    names = ("outcome", "n_steps", "crash_time_s", "impact_speed_mps", "log_weight", "cut_in_step")
    return [episode[name].tobytes() for name in names]


@pytest.mark.parametrize(("method", "level"), [("nde", 1e5), ("forced", 1.0)])
@pytest.mark.parametrize("av", [IDM, AutomatedVehicle(model="fvdm"), AutomatedVehicle(model="need-based")])
def test_a_lead_of_zero_gives_every_bit_of_the_cut_in_of_one_step(method, level, av):
    """The crossing is looked for ahead with a lead, and met on the way without one."""
    without, zero = drive(campaign(method, None, av, level=level)), drive(campaign(method, 0.0, av, level=level))
    for name in without.results.episode.dtype.names:
        if not name.startswith("onset_r2"):
            assert without.results.episode[name].tobytes() == zero.results.episode[name].tobytes(), name
    assert without.results.log_q.tobytes() == zero.results.log_q.tobytes()
    assert without.results.bv_path.tobytes() == zero.results.bv_path.tobytes()
    assert without.results.lv_path.tobytes() == zero.results.lv_path.tobytes()
    assert (without.results.episode["cut_in_step"] >= 0).sum() > 300


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


def test_control_steps_of_forced_cut_ins_are_those_of_before():
    ready = [prepare(resolve(campaign("forced", lead_s))) for lead_s in (None, 0.0, 1.0)]
    kept = []
    for each in ready:
        loop = EpisodeLoop(TwinWorld(64), each.policy, RecordPolicy(9, "none", 0.0))
        results = loop.run(0, each.states(0, 200)).results
        moment = results.moment[: results.moment_count[0]]
        kept.append(moment[np.argsort(moment["row"])])
    assert kept[0].size == 200
    for other in kept[1:]:
        assert np.array_equal(kept[0], other)  # with a lead, in the state that the driver who cuts in predicts


@pytest.mark.parametrize("lead_s", [0.5, 1.0, 2.0, None])
@pytest.mark.parametrize("av", [BLIND, NEVER], ids=["blind", "never brakes"])
def test_one_that_sees_nothing_before_the_overlap_ends_alike_at_every_lead(av, lead_s):
    before = outcome_bits(episodes(campaign("forced", None, av)))
    assert outcome_bits(episodes(campaign("forced", lead_s, av, log_normal=lead_s is None))) == before


def test_one_that_sees_the_onset_does_not():
    """The sibling that must fail."""
    assert outcome_bits(episodes(campaign("forced", 1.0))) != outcome_bits(episodes(campaign("forced", None)))


def test_only_when_it_brakes_counts_and_not_why_it_is_late():
    """0.6 s late, seen at 0.375 m of a lead of 1.5 s (0.4 s), is 0.5 s seen at once."""
    late, early = episodes(campaign(lead_s=1.5, delay_s=0.6)), episodes(campaign(lead_s=0.5, av=SEES_ONSET))
    whole = late["cut_in_step"] >= 15
    assert whole.sum() > 1000
    for name in ("outcome", "n_steps", "crash_time_s", "impact_speed_mps", "min_ttc_s"):
        assert np.array_equal(late[name][whole], early[name][whole], equal_nan=True), name
    other = episodes(campaign(lead_s=1.5, delay_s=0.7))
    assert not np.array_equal(late["n_steps"][whole], other["n_steps"][whole])


def test_the_av_keeps_its_speed_until_it_may_act_and_acts_then():
    shard = drive(campaign(lead_s=1.0, av=SEES_ONSET), "all")
    acted = 0
    for row, trace in list(shard.traces.items())[:500]:
        commanded, onset = trace[:-1, AV, 2], int(shard.results.episode["onset_step"][row])
        assert (commanded[: onset + 1] == 0.0).all()
        acted += commanded.size > onset + 1 and commanded[onset + 1] != 0.0
    assert acted > 450


def test_a_longer_lead_never_crashes_a_vehicle_that_brakes_more_for_it_and_helps():
    crashes = [(episodes(campaign(lead_s=lead_s))["outcome"] == CRASH).sum() for lead_s in (0.0, 0.5, 1.0)]
    assert crashes[0] > crashes[1] > crashes[2]


@pytest.mark.parametrize("lead_s", [0.1, 0.8, None])
@pytest.mark.parametrize(
    "av",
    [IDM, AutomatedVehicle(model="r157-cc"), AutomatedVehicle(model="constant", parameters={"acceleration_mps2": 2.0})],
    ids=["idm", "r157-cc", "accelerates"],
)
def test_every_episode_is_retraced(av, lead_s):
    one = campaign("forced", lead_s, av, log_normal=lead_s is None)
    table = episodes_table(drive(one), one.seed)
    sumo = Retracing(resolve(one))
    assert sumo.check(table) == N
    assert "onset_r2_m" in sumo.summary(N)["compared"]
    contact = table.column("contact").to_pylist()
    assert set(contact) >= {None, "rear"}


# What happens beside each other: BV cuts in after some steps, nobody but the AV changes speed.

BESIDE = [(-0.5, CRASH), (-9.9985, CRASH), (0.5, None), (-9.9995, PASSED), (-0.0005, None), (-0.0015, CRASH)]


def beside(lead: int, cut: int, r2_m: list[float], closing_mps: float = 0.0) -> tuple[np.ndarray, PrescribedTraffic]:
    states = np.array([(25.0, 60.0, 0.0, r2, -closing_mps) for r2 in r2_m], STATE_DTYPE)
    n, steady = len(r2_m), 20
    lv, bv = np.full((n, 22), steady, np.int8), np.full((n, 22), steady, np.int8)
    bv[:, cut // 10 + 1] = CUT_IN
    zeros, of_all = np.zeros(n, np.int64), np.full(n, cut)
    traffic = drawn_traffic()._replace(lv=lv, bv=bv, cut_step=of_all, stratum=zeros, log_weight=np.zeros(n))
    return states, traffic._replace(lead=np.full(n, lead))


def policy_of(av: AutomatedVehicle, lead_s: float) -> Drawing:
    one = campaign("shells", lead_s, av)
    resolved = resolve(one)
    return Drawing(1, resolved.environment, build_importance(one, None), resolved.av)


@pytest.mark.parametrize(("r2_m", "outcome"), BESIDE)
def test_in_the_first_state_of_overlap_touching_is_a_crash_and_being_ahead_is_having_passed(r2_m, outcome):
    states, traffic = beside(0, 0, [r2_m])
    shard = EpisodeLoop(TwinWorld(1), policy_of(NEVER, 1.0), RecordPolicy(0, "none", 0.0)).run(0, states, traffic)
    episode = shard.results.episode[0]
    if outcome is None:
        assert episode["n_steps"] > 1
    else:
        assert (episode["outcome"], episode["n_steps"]) == (outcome, 1)
        contact = episodes_table(shard, 1).column("contact").to_pylist()
        assert contact == ["side" if outcome == CRASH else None]


def test_a_vehicle_that_accelerates_and_passes_is_ahead_at_the_overlap():
    """From 2 m behind, with 2 m/s² and 1 m/s faster for 4 s: 16 + 4 - 2 m further, so 13 m of it past BV's rear."""
    parameters = ConstantParameters(acceleration_mps2=2.0)
    fast = AutomatedVehicle(model="constant", parameters=parameters, reaction=SEES_ONSET.reaction)
    shorter = [(4.0, 40, PASSED), (2.0, 20, CRASH)]
    for lead_s, lead, expected in shorter:
        states, traffic = beside(lead, lead, [2.0], closing_mps=1.0)
        loop = EpisodeLoop(TwinWorld(1), policy_of(fast, lead_s), RecordPolicy(0, "all", 0.0))
        shard = loop.run(0, states, traffic)
        episode, trace = shard.results.episode[0], shard.traces[0]
        assert (episode["outcome"], episode["n_steps"]) == (expected, lead + 1)
        gaps = trace[:, BV, 0] - 5.0 - trace[:, AV, 0]
        assert (gaps[:-1] < 0.0).any()  # beside BV before the overlap nothing ends
        assert (gaps[-1] < -9.999) == (expected == PASSED)
