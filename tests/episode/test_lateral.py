"""Cut-ins that take time, in the twin: the same crossings, and an AV that may act from the onset on."""

import numpy as np
import pytest

from harness.families.cut_in.events import Maneuvers
from harness.families.cut_in.script import facts_of, script_of
from harness.families.protocol import Chosen
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.loop.repeat import Traffic
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.vocabulary import CRASH, CUT_IN, PASSED, STATE_DTYPE
from harness.worlds.twin import TwinWorld
from tests.episode.twin_runs import campaign, run
from tests.golden.campaigns import LATERAL_FILE

N = 3000
LATERAL = [{"lead_s": 1.5}, {"parameters": LATERAL_FILE}]


def episodes(method: str = "forced", **settings):
    return run(method, n=N, **settings).episode


def outcome_bits(**settings) -> list[bytes]:
    names = ("outcome", "n_steps", "crash_time_s", "impact_speed_mps", "log_weight", "event_step")
    return [episodes(**settings)[name].tobytes() for name in names]


@pytest.mark.parametrize("lateral", LATERAL)
@pytest.mark.parametrize(("method", "level"), [("nde", 1e5), ("forced", 1.0)])
def test_the_crossing_looked_for_ahead_is_the_one_met_on_the_way(method, level, lateral):
    met, ahead = (episodes(method, level=level, **more) for more in ({}, lateral))
    assert np.array_equal(met["event_step"], ahead["event_step"])
    assert np.array_equal(met["log_weight"], ahead["log_weight"])
    came = ahead["event_step"] >= 0
    onset = np.maximum(ahead["event_step"] - ahead["lead_steps"], 0)
    assert np.array_equal(ahead["onset_step"][came], onset[came])
    assert (ahead["lead_steps"][came] > 0).mean() > 0.9


@pytest.mark.parametrize("lateral", LATERAL)
@pytest.mark.parametrize("av", ["blind", "holds"])
def test_one_that_sees_nothing_before_the_overlap_ends_alike_at_every_lead(av, lateral):
    assert outcome_bits(av=av, **lateral) == outcome_bits(av=av)
    assert outcome_bits(**lateral) != outcome_bits()  # one that sees the onset does not


BESIDE = [(-0.5, CRASH), (-9.9985, CRASH), (0.5, None), (-9.9995, PASSED), (-0.0005, None), (-0.0015, CRASH)]


def beside(r2_m: list[float]):
    """Cut-ins in the first step, at an R2 each; nobody but the AV changes speed."""
    return at_once(np.array([(25.0, 60.0, 0.0, r2, 0.0) for r2 in r2_m], STATE_DTYPE))


def at_once(states: np.ndarray) -> Traffic:
    """Cut-ins in the first step; LV and BV keep their speeds."""
    n, environment = len(states), resolve(campaign("shells")).environment
    lv, bv = np.full((2, n, 22), 20, np.int8)
    bv[:, 1] = CUT_IN
    zero, used = np.zeros(n, np.int64), np.full(n, 20)
    chosen = Chosen(facts_of(states, Maneuvers(lv, bv, used, used + 2, zero)), zero, zero)
    return Traffic(script_of(environment, chosen)._replace(stratum=zero), chosen.facts)


@pytest.mark.parametrize(("r2_m", "outcome"), BESIDE)
def test_in_the_first_state_of_overlap_touching_is_a_crash_and_being_ahead_is_having_passed(r2_m, outcome):
    resolved = resolve(campaign("shells", lead_s=1.0, av="holds"))
    shard = EpisodeLoop(TwinWorld(1), resolved.scenario, RecordPolicy("none", 0.0)).run(0, beside([r2_m]))
    episode = shard.episode[0]
    if outcome is None:
        assert episode["n_steps"] > 1
    else:
        assert (episode["outcome"], episode["n_steps"]) == (outcome, 1)
        contact = episodes_table(shard, 1).column("contact").to_pylist()
        assert contact == ["side" if outcome == CRASH else None]
