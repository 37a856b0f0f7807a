"""The recorded path determines the episode: initial state and maneuvers, replayed in plain Python, give it again.

Bit for bit in positions and speeds, with IDM, motion and clocks written out a second time.
"""

import math

import numpy as np
import pytest

from harness.families.cut_in.events import Maneuvers
from harness.families.cut_in.script import facts_of, script_of
from harness.families.cut_in.vocabulary import CUT_IN, STATE_COLUMNS, STATE_DTYPE
from harness.families.protocol import Chosen
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.loop.repeat import Traffic
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.vocabulary import CONTACT, CRASH, PASSED, TIMEOUT
from harness.worlds.twin import TwinWorld
from tests.episode.twin_runs import campaign, run
from tests.golden.campaigns import LATERAL_FILE

METHODS = {"nde": {"level": 1e6}, "forced": {}, "step_mixture": {}, "episode_mixture": {}}
N = 300


def idm(v, v_lead, gap):
    s = max(gap, 0.1)
    s_star = 2.0 + max(0.0, v * 1.0 + (v * (v - v_lead)) / (2.0 * math.sqrt(2.0 * 3.0)))
    r = (v / 40.0) * (v / 40.0)
    return min(max(2.0 * (1.0 - r * r - (s_star / s) * (s_star / s)), -4.0), 2.0)


def moved(x, v, a):
    after = max(v + a * 0.1, 0.0)
    change = (after - v) / 0.1 * 0.1
    if v + change >= 0.0:
        return x + (v + 0.5 * change) * 0.1, after
    return x - 0.5 * v * v / change * 0.1, after


def replayed(state, lv_path, bv_path, hold):
    """Motion (steps + 1, 3, 3: x, v, a), outcome and cut-in step."""
    v_bv, r1, r1dot, r2, r2dot = state
    x = [100.0 + 5.0 + r2 + 5.0 + r1, 100.0 + 5.0 + r2, 100.0]
    v = [max(v_bv + r1dot, 0.0), v_bv, v_bv - r2dot]
    lv, bv = iter(lv_path), iter(bv_path)
    upcoming = next(bv)
    cut_step, motion = -1, []
    for step in range(200):
        a_av = idm(v[2], v[1], x[1] - 5.0 - x[2]) if cut_step >= 0 else 0.0
        if step % hold == 0:
            a_lv = (next(lv) - 20) / 5.0
        due = step % hold == 0 if cut_step < 0 else (step - cut_step - 1) % hold == 0
        if due:
            a_bv, upcoming = (upcoming - 20) / 5.0, next(bv, None)
        # The path does not say in which step of a period the cut-in was: the caller hands it over.
        if upcoming == CUT_IN and cut_step < 0 and (yield step):
            cut_step, upcoming = step, next(bv, None)
        motion.append(list(zip(x, v, (a_lv, a_bv, a_av), strict=True)))
        x, v = zip(*(moved(*one) for one in motion[-1]), strict=True)
        outcome = ended(x, cut_step >= 0)
        if outcome is not None:
            break
    else:
        outcome = TIMEOUT
    motion.append(list(zip(x, v, [math.nan] * 3, strict=True)))
    return np.array(motion), outcome, cut_step


def ended(x, cut_in):
    if cut_in:
        return CRASH if x[1] - 5.0 - x[2] < -0.001 else None
    if x[0] - 5.0 - x[1] < -0.001:
        return CONTACT
    return PASSED if x[1] - 5.0 - x[2] <= 0.0 else None


def replay(done, row, hold):
    """Drive `replayed`, answering its question in which step BV cuts in."""
    episode = done.episode[row]
    facts = done.shard.traffic.facts[row]
    lv = facts["lv_maneuvers"][: facts["n_lv"]].tolist()
    bv = facts["bv_maneuvers"][: facts["n_bv"]].tolist()
    steps = replayed([facts[name] for name in STATE_COLUMNS], lv, bv, hold)
    answer = None
    while True:
        try:
            answer = steps.send(answer) == episode["event_step"]
        except StopIteration as end:
            return end.value


HOLDS = [
    *((method, 1.0) for method in METHODS),
    *(("nde", 0.1), ("forced", 0.1), ("forced", 0.7)),
    *(
        pytest.param(each, hold, marks=pytest.mark.slow)
        for each in ("step_mixture", "episode_mixture")
        for hold in (0.1, 0.5)
    ),
]
"""Tables for draws in every step take 12 s of a core, for those in every fifth 8 s."""


@pytest.mark.parametrize(("method", "hold_s"), HOLDS)
def test_replay_in_plain_python(method, hold_s):
    surrogates = "default" if hold_s == 1.0 else "SM-I"
    done = run(method, n=N, traces="all", hold_s=hold_s, surrogates=surrogates, **METHODS[method])
    seen = set()
    for row in range(N):
        motion, outcome, cut_step = replay(done, row, round(hold_s * 10))
        trace = done.shard.traces[row]
        np.testing.assert_array_equal(trace[:, :, :2], motion[:, :, :2])
        np.testing.assert_array_equal(trace[:, 2, 2], motion[:, 2, 2])
        assert outcome == done.episode["outcome"][row]
        assert cut_step == done.episode["event_step"][row]
        assert len(motion) == done.episode["n_steps"][row] + 1
        if outcome == CRASH:
            assert done.episode["impact_speed_mps"][row] == trace[-1, 2, 1] - trace[-1, 1, 1]
        seen.add(outcome)
    assert CRASH in seen
    assert len(seen) > 1


MANY = 3000
LATERAL = [{"lead_s": 1.5}, {"parameters": LATERAL_FILE}]


def episodes(method: str = "forced", **settings):
    return run(method, n=MANY, **settings).episode


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
