"""Cut-ins that take time, in the twin: the same crossings, and an AV that may act from the onset on."""

import numpy as np
import pytest

from harness.families.cut_in.nade.functions import build_importance
from harness.loop.cells import drawn_traffic
from harness.loop.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.vocabulary import AV, CRASH, CUT_IN, PASSED, STATE_DTYPE
from harness.worlds.twin import TwinWorld
from tests.episode.twin_runs import campaign, run

N = 3000
LOG_NORMAL = "ndd-overtaking-1-lateral"
LATERAL = [{"lead_s": 1.5}, {"parameters": LOG_NORMAL}]


def episodes(method: str = "forced", **settings):
    return run(method, n=N, **settings).episode


def outcome_bits(**settings) -> list[bytes]:
    names = ("outcome", "n_steps", "crash_time_s", "impact_speed_mps", "log_weight", "cut_in_step")
    return [episodes(**settings)[name].tobytes() for name in names]


@pytest.mark.parametrize("lateral", LATERAL)
@pytest.mark.parametrize(("method", "level"), [("nde", 1e5), ("forced", 1.0)])
def test_the_crossing_looked_for_ahead_is_the_one_met_on_the_way(method, level, lateral):
    met, ahead = (episodes(method, level=level, **more) for more in ({}, lateral))
    assert np.array_equal(met["cut_in_step"], ahead["cut_in_step"])
    assert np.array_equal(met["log_weight"], ahead["log_weight"])
    came = ahead["cut_in_step"] >= 0
    onset = np.maximum(ahead["cut_in_step"] - ahead["lead_steps"], 0)
    assert np.array_equal(ahead["onset_step"][came], onset[came])
    assert (ahead["lead_steps"][came] > 0).mean() > 0.9


@pytest.mark.parametrize("lateral", LATERAL)
@pytest.mark.parametrize("av", ["blind", "holds"])
def test_one_that_sees_nothing_before_the_overlap_ends_alike_at_every_lead(av, lateral):
    assert outcome_bits(av=av, **lateral) == outcome_bits(av=av)
    assert outcome_bits(**lateral) != outcome_bits()  # one that sees the onset does not


def test_the_av_keeps_its_speed_until_it_may_act_and_acts_then():
    shard = run("forced", n=N, lead_s=1.0, av="sees the onset", traces="all").shard
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


@pytest.mark.parametrize(("r2_m", "outcome"), BESIDE)
def test_in_the_first_state_of_overlap_touching_is_a_crash_and_being_ahead_is_having_passed(r2_m, outcome):
    resolved = resolve(one := campaign("shells", lead_s=1.0, av="holds"))
    policy = Drawing(1, resolved.environment, build_importance(one, None), resolved.av)
    shard = EpisodeLoop(TwinWorld(1), policy, RecordPolicy(0, "none", 0.0)).run(0, *beside([r2_m]))
    episode = shard.results.episode[0]
    if outcome is None:
        assert episode["n_steps"] > 1
    else:
        assert (episode["outcome"], episode["n_steps"]) == (outcome, 1)
        contact = episodes_table(shard, 1).column("contact").to_pylist()
        assert contact == ["side" if outcome == CRASH else None]
