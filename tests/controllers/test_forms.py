"""The intelligent driver model gives the same motion in whatever form it is plugged in."""

from __future__ import annotations

import math

import numpy as np
import pytest

from examples import idm_batch
from examples.idm import IDM, idm_acceleration
from harness.controllers.hosts import BatchHost, Guard
from harness.controllers.traci_style import TraciStyleController
from harness.errors import CampaignError
from harness.vocabulary import CRASH
from tests.golden.campaigns import LATERAL
from tests.stored_runs import ROOT
from tests.worlds.running import drive, fmu_av, forced, motion

FORMS = {
    "per vehicle": "av={controller: 'examples.idm:IDM'}",
    "batch": "av={controller: 'examples.idm_batch:IDM'}",
    "TraCI-style": "av={controller: 'examples.idm_traci_style:IDM'}",
    "TraCI script": f"av={{controller: '{ROOT}/examples/idm_traci_script.py'}}",
    "step listener": "av={controller: 'examples.idm_traci_style:Listener'}",
}


@pytest.mark.parametrize(
    "form", [pytest.param(each, marks=[pytest.mark.slow] * (k > 0)) for k, each in enumerate(FORMS)]
)
def test_every_form_gives_the_bits_of_the_built_in_model_in_other_cells(form):
    assert motion(FORMS[form], cells=7) == motion("av={model: idm}")


def test_an_fmu_gives_the_same_motion_and_gets_its_start_values_in_every_episode(fmu):
    built_in = drive("av={model: idm}")
    other = drive(f"av={fmu_av(fmu)}")
    assert other.failures == {}
    for i in built_in.traces:
        np.testing.assert_allclose(other.traces[i], built_in.traces[i], rtol=0, atol=1e-9)
    weaker = drive(f"av={fmu_av(fmu)}", "av.fmu.start_values={a_min: -1.5}")
    braking = [min(run.traces[i][:-1, 2, 2].min() for i in built_in.traces) for run in (weaker, built_in)]
    assert braking[0] == -1.5 > braking[1]


@pytest.mark.slow
def test_one_that_sees_bv_come_over_is_the_built_in_model_and_one_that_waits_for_the_overlap_is_not():
    """To the last bit; the sibling is the built-in model that is blind until then."""
    yields = "controller: 'examples.sees_lateral:Yields'"
    avs = "model: idm", yields, f"{yields}, parameters: {{perceives_m: 2.0}}", "reaction: {perceives_lateral_m: 2.0}"
    built_in, sees, waits, blind = (motion(LATERAL, f"av={{{av}}}", n=200) for av in avs)
    assert built_in == sees
    assert built_in != waits
    assert waits == blind


class ACC(IDM):
    """As everybody writes it: without a leader it makes for a speed of its own."""

    def step(self, seen):
        return 2.0 if math.isinf(seen.gap_m) else super().step(seen)


class ACCBatch(idm_batch.IDM):
    def step_batch(self, seen):
        return super().step_batch(seen._replace(set_speed_mps=np.full(seen.cell.size, 60.0)))


class ACCScript(TraciStyleController):
    def on_step(self, traci, veh_id, time):
        speed, leader = traci.vehicle.getSpeed(veh_id), traci.vehicle.getLeader(veh_id)
        ahead = 2.0 if leader is None else idm_acceleration(speed, traci.vehicle.getSpeed(leader[0]), leader[1])
        traci.vehicle.setAcceleration(veh_id, ahead, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["ACC", "ACCBatch", "ACCScript"])
def test_one_that_sees_nobody_keeps_its_speed_until_bv_is_on_its_lane_however_it_is_written(form):
    """It crashed three times as often as one that waits: it had sped up for 2 s. With ``onset`` it still does."""
    av = f"controller: 'tests.controllers.test_forms:{form}'"
    held, waits = (drive(LATERAL, f"av={{{one}}}", n=200) for one in (av, "reaction: {perceives_lateral_m: 2.0}"))
    assert [held.traces[row].tobytes() for row in range(200)] == [waits.traces[row].tobytes() for row in range(200)]
    episode, early = held.episode, waits.episode["asked_to_speed_up"]
    assert episode["asked_to_speed_up"].mean() > 0.9
    assert not early.any()
    assert np.all(episode["took_over_step"] == episode["event_step"] + 1)
    at_once = drive(LATERAL, f"av={{{av}, takes_over: onset}}", n=200).episode
    assert (at_once["outcome"] == CRASH).sum() > 1.2 * (episode["outcome"] == CRASH).sum()


class Slows:
    """A cruise control that brakes for nobody: to a set speed of its own, or to that of the test."""

    def __init__(self, own_mps=math.nan):
        self.own_mps = own_mps

    def start(self, episode):
        self.target = episode.set_speed_mps if math.isnan(self.own_mps) else self.own_mps

    def step(self, seen):
        return max(self.target - seen.speed_mps, -2.0)


class SlowsAsPolicy(Slows):
    def step(self, seen):
        return np.array([super().step(seen)])


class SlowsInSingle(Slows):
    def step(self, seen):
        return np.float32(super().step(seen))


class SlowsToNothing(Slows):
    """Its answers while it warms up, for 20 steps, are no numbers that anybody could use."""

    def start(self, episode):
        self.asked = 0

    def step(self, seen):
        self.asked += 1
        return -(10**400) if self.asked <= 20 else 0.0


class SlowsBatch:
    def step_batch(self, seen):
        return np.maximum(20.0 - seen.speed_mps, -2.0)


class SlowsScript(TraciStyleController):
    def on_step(self, traci, veh_id, time):
        traci.vehicle.setAcceleration(veh_id, max(20.0 - traci.vehicle.getSpeed(veh_id), -2.0), 0.1)


@pytest.mark.parametrize(
    ("form", "n"),
    [
        ("Slows, parameters: {own_mps: 20}", 40),
        ("SlowsAsPolicy, parameters: {own_mps: 20}", 40),
        ("SlowsInSingle, parameters: {own_mps: 20}", 40),
        ("SlowsBatch", 40),
        ("SlowsScript", 40),
        ("Slows", 0),
        ("SlowsToNothing", 0),
    ],
)
def test_one_that_brakes_while_nobody_is_ahead_is_seen_however_it_is_written(form, n):
    """Its own set speed makes it slow before BV comes, and cut-ins milder than they are for who cruises."""
    name, *more = form.split(", ")
    av = ", ".join([f"controller: 'tests.controllers.test_forms:{name}'", *more])
    shard = drive(LATERAL, f"av={{{av}}}", n=40)
    assert (shard.episode["braked_before"].sum(), shard.failures) == (n, {})


EAGER = "parameters: {desired_speed_mps: 60.0, time_headway_s: 0.2}"


class Eager(IDM):
    """Sees BV from the onset on, and follows it with little headway."""

    def step(self, seen):
        gap, v, v_lead = seen.bv.position_m - 5.0 - seen.position_m, seen.speed_mps, seen.bv.speed_mps
        desired = 2.0 + max(0.0, v * 0.2 + (v * (v - v_lead)) / (2.0 * math.sqrt(2.0 * 3.0)))
        ratio, close = v / 60.0, desired / max(gap, 0.1)
        return min(max(2.0 * (1.0 - (ratio * ratio) * (ratio * ratio) - close * close), -4.0), 2.0)


@pytest.mark.parametrize("takes_over", ["first_braking", "onset"])
def test_a_built_in_model_is_held_by_the_same_rule(takes_over):
    own = f"controller: 'tests.controllers.test_forms:Eager', takes_over: {takes_over}"
    built_in = f"reaction: {{perceives_lateral_m: 0.0}}, {EAGER}, takes_over: {takes_over}"
    ours, theirs = (drive(LATERAL, f"av={{{av}}}", n=200) for av in (own, built_in))
    ours.episode["braked_before"] = 0  # of built-in models nobody asks
    assert ours.episode.tobytes() == theirs.episode.tobytes()
    asked = ours.episode["asked_to_speed_up"]
    assert (asked.sum() > 20) == (takes_over == "first_braking")
    assert any((ours.traces[row][:-1, 2, 2] > 0.0).any() for row in range(200))


EARLY = "av={controller: 'tests.controllers.test_forms:Faster', before_event: controller}"


class Faster(IDM):
    """Accelerates until someone is ahead, and remembers nothing but its steps."""

    def start(self, episode):
        self.steps = 0

    def step(self, seen):
        assert seen.time_s == pytest.approx(0.1 * self.steps)
        self.steps += 1
        ahead = np.isfinite(seen.gap_m)
        assert ahead == (seen.bv.lane == 0)
        assert ahead or np.isnan(seen.lead_speed_mps)
        return -3.0 if ahead else 0.5


def test_a_method_that_draws_the_path_ahead_refuses_it():
    with pytest.raises(CampaignError, match=r"draws the event.*shells \(or forced\)"):
        forced(EARLY, "testing={method: episode_mixture}")


def test_tests_of_one_baseline_run_that_begin_together_have_streams_of_their_own():
    """Both are told the same index: the second was given the rest of the first one's numbers, and its test failed."""
    seen = []

    class Draws:
        def start_batch(self, cells, episodes, random):
            seen.extend(stream.uniform(size=4) for stream in random)

        def step_batch(self, observation): ...
        def close(self): ...

    av = forced(EARLY).av
    host = BatchHost(av, 7, Guard(av.limits), lambda _: None, Draws())
    assert host.start(np.arange(3), np.arange(3), np.array([3, 5, 3]), np.zeros(3)) == {}
    host.close()
    np.testing.assert_array_equal(seen[0], seen[2])
    assert not np.any(seen[0] == seen[1])
