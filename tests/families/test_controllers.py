"""What a vehicle of the user's own sees of lead braking and cut-outs, in each of its forms."""

from __future__ import annotations

import math
from contextlib import closing

import numpy as np
import pytest

from examples import idm_traci_style
from examples.idm import IDM
from harness.campaign.files import load_campaign
from harness.families.lead_brakes.words import HEADWAY
from harness.loop.cells import BRAKED_MPS2
from harness.sampling import prepare
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import CRASH
from harness.worlds.twin import TwinWorld
from tests.families.test_same_bits import LADDERS, require_same, resolved_of, run, source_of
from tests.in_process import run_here

SET_SPEED_MPS = 40.0


def traffic_from(name: str, n: int):
    """Tests from all shells of the pool."""
    rows = np.linspace(0, len(source_of(name).pool.events.at) - 1, n).astype(np.int64)
    return source_of(name).prescribed.of_rows(rows, np.zeros(n, np.int64))


def drive(name: str, controller: str, traffic, cells=16):
    source = prepare(resolved_of(name, None, f"av.controller={controller}"))
    with closing(TwinWorld(cells, source.scenario.vehicles)) as world:
        loop = source.loop(world, traces="all")
        with closing(loop):
            return loop.run(0, traffic)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "cut_out")) for name in LADDERS]
)
def test_the_same_model_has_the_same_bits_in_every_form(name):
    """Where the vehicle ahead brakes they are those of the built-in one; before a cut-out that looks ahead of it."""
    traffic, resolved = traffic_from(name, 40), resolved_of(name)
    shards = [drive(name, f"examples.{form}:IDM", traffic) for form in ("idm", "idm_batch", "idm_traci_style")]
    shards += [run(TwinWorld, resolved, traffic, "all")] if name == "lead_brakes" else []
    for shard in shards:
        assert not shard.failures
        require_same(shard, shards[0])
    assert 3 < (shards[0].episode["outcome"] == CRASH).sum() < 37


class Lags:
    """Its own set speed is lower than that of the traffic: nobody ahead can become a danger."""

    def step(self, seen):
        return max(-1.0, 18.0 - seen.speed_mps)


@pytest.mark.parametrize("name", LADDERS)
def test_one_that_does_not_keep_up_is_seen_when_the_event_begins(name):
    traffic = traffic_from(name, 20)
    lags, follows = (
        drive(name, each, traffic) for each in ("tests.families.test_controllers:Lags", "examples.idm:IDM")
    )
    assert (lags.episode["fell_behind"].sum(), follows.episode["fell_behind"].sum()) == (20, 0)
    for row, trace in follows.traces.items():
        slower = -np.diff(trace[int(follows.episode["onset_step"][row]) + 1 :, -1, 1]) / STEP_S
        hardest = follows.episode["hardest_braking_mps2"][row]
        assert hardest == pytest.approx(max(slower.max(initial=0.0), 0.0), rel=1e-12)
        [first, *_] = [*np.flatnonzero(slower >= BRAKED_MPS2) + int(follows.episode["onset_step"][row]) + 1, -1]
        assert follows.episode["braked_step"][row] == first
    assert follows.episode["hardest_braking_mps2"].max() > 3.0


@pytest.mark.parametrize(
    ("scenario", "av", "told"),
    [
        ("cut_out", "av.controller=examples.idm:IDM", "it did nothing before the one ahead (LV) had left the lane; lv"),
        ("cut_out", "av.model=idm", None),  # looks ahead of it
        ("cut_out", "av={sumo: {carFollowModel: Krauss}}", "cannot see that LV leaves the lane"),
        ("lead_brakes", "av.controller=examples.idm:IDM", None),  # nobody could see that coming
    ],
)
def test_one_that_waits_until_the_lane_is_clear_is_told_what_shows_it_earlier(scenario, av, told, tmp_path):
    """In the same 60 forced events."""
    engine = "sumo" if "sumo" in av else "twin"
    asked = [f"scenario={scenario}", "stop={episodes: 60, rhw: null}", "testing.method=forced"]
    asked.append(f"world.engine={engine}")
    answer = " ".join(repr(run_here(load_campaign("idm", [*asked, av]), tmp_path / "run")).split())
    assert told in answer if told else not ("did nothing before" in answer or "cannot see that" in answer)


def ahead_on_lane(trace, step, visible):
    """Gap (m) to, and place of, the nearest that is seen ahead on the AV's lane."""
    av = trace[step, -1, 0]
    there = [(trace[step, i, 0] - 5.0 - av, i) for i in range(trace.shape[1] - 1) if trace[step, i, 3] == 0.0]
    return min((gap, i) for gap, i in there if step >= visible[i])


@pytest.mark.parametrize("name", LADDERS)
def test_a_controller_follows_from_the_first_step_and_sees_who_is_revealed_in_time(name):
    traffic = traffic_from(name, 12)
    SEEN.clear()
    shard = drive(name, "tests.families.test_controllers:Watching", traffic, cells=1)
    vehicles = shard.scenario.vehicles
    assert [len(seen) for _, seen in SEEN] == shard.episode["n_steps"].tolist()
    for row, (start, steps) in enumerate(SEEN):
        assert (start.set_speed_mps, steps[0].time_s, steps[0].set_speed_mps) == (SET_SPEED_MPS, 0.0, SET_SPEED_MPS)
        assert (start.lv_name, start.bv_name) == {"lead_brakes": ("", "LV"), "cut_out": ("LV", "SV")}[name]
        trace, visible = shard.traces[row], traffic.script.visible_from[row]
        for step, seen in enumerate(steps):
            gap, leader = ahead_on_lane(trace, step, visible)
            assert (seen.gap_m, seen.lead_speed_mps) == (gap, trace[step, leader, 1])
            if name == "lead_brakes":
                assert math.isnan(seen.lv.position_m)
                assert (*seen.bv, seen.bv_lateral_m, seen.lv_lateral_m) == (*trace[step, 0, [0, 1, 3]], 0.0, 0.0)
                continue
            assert seen.lv == tuple(trace[step, 0, [0, 1, 3]])
            assert math.isnan(seen.bv.position_m) == (step < visible[1]) == (not seen.bv_overlaps)
            assert step < visible[1] or seen.bv == tuple(trace[step, 1, [0, 1, 3]])
            clear, way = step > traffic.script.at[row], seen.lv_lateral_m
            assert leader == vehicles.index("SV" if clear else "LV")
            assert (way >= 0.375 - 1e-9) == (step >= visible[1])
            assert (way == 1.9) == clear == (trace[step, 0, 3] == 1.0)
            assert (seen.lv_lateral_speed_mps > 0.0) == (
                not clear and step > traffic.script.at[row] - traffic.script.lead[row]
            )
            assert seen.bv_lateral_m == 0.0


@pytest.mark.parametrize("name", LADDERS)
def test_a_traci_script_knows_the_vehicles_by_the_scenarios_names(name):
    """Who is not seen yet is not there; a speed's first change is none."""
    traffic = traffic_from(name, 12)
    SEEN.clear()
    shard = drive(name, "tests.families.test_controllers:WatchingTraci", traffic, cells=1)
    assert not shard.failures
    vehicles = shard.scenario.vehicles
    for row, (_, steps) in enumerate(SEEN):
        trace, visible = shard.traces[row], traffic.script.visible_from[row]
        assert len(steps) == shard.episode["n_steps"][row]
        for step, (known, (leader, gap), allowed) in enumerate(steps):
            there = [i for i in range(len(vehicles) - 1) if step >= visible[i]]
            assert set(known) == {*(vehicles[i] for i in there), "AV"}
            assert (gap, vehicles.index(leader)) == ahead_on_lane(trace, step, visible)
            assert allowed == SET_SPEED_MPS
            for i in there:
                position, speed, acceleration, lane, sideways = known[vehicles[i]]
                assert (position, speed, lane) == tuple(trace[step, i, [0, 1, 3]])
                before = trace[step - 1, i, 1] if step > visible[i] else speed
                assert acceleration == (speed - before) / 0.1
                assert 0.0 <= sideways < 1.9
                assert (sideways > 0.0) == (
                    vehicles[i] == "LV"
                    and name == "cut_out"
                    and lane == 0.0
                    and step > traffic.script.at[row] - traffic.script.lead[row]
                )


SEEN = []
"""What was told of a test, and then step by step."""


class Watching(IDM):
    def start(self, episode):
        SEEN.append((episode, []))

    def step(self, seen):
        SEEN[-1][1].append(seen)
        return super().step(seen)


class WatchingTraci(idm_traci_style.IDM):
    """Of each vehicle that is there: position, speed, acceleration, lane, and how far it is from the lane's middle."""

    asked = ("getLanePosition", "getSpeed", "getAcceleration", "getLaneIndex", "getLateralLanePosition")

    def on_start(self, random):
        SEEN.append((random, []))

    def on_step(self, traci, veh_id, time):
        there = traci.vehicle
        known = {name: [getattr(there, ask)(name) for ask in self.asked] for name in there.getIDList()}
        SEEN[-1][1].append((known, there.getLeader(veh_id), there.getAllowedSpeed(veh_id)))
        super().on_step(traci, veh_id, time)


def test_the_headway_of_one_that_stands_when_braking_begins_is_a_number():
    seen = {"event_gap_m": np.array([30.0]), "lead_speed_mps": np.array([20.0]), "event_rate_mps": np.array([20.0])}
    assert HEADWAY.of(seen) == 30.0
