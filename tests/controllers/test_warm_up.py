"""What controllers are shown before the cut-in: seconds that fill a state, or all of it for those that make room."""

from __future__ import annotations

import importlib
import math
from collections import deque
from contextlib import closing

import numpy as np
import pytest

from examples.idm import IDM, idm_acceleration
from harness.controllers.traci_style import TraciStyleController
from harness.worlds.sumo import SumoWorld
from tests.golden.campaigns import LATERAL
from tests.worlds.running import drive, motion

pytestmark = pytest.mark.slow  # at night

HERE = "tests.controllers.test_warm_up"
SHOWN = 300
DELAY_STEPS = 5


class Line:
    """Half a second of what was measured; where it is not full, now counts."""

    def __init__(self, idm, filled=False):
        self._idm, self._measured = idm, deque([(0.0, 0.0, math.inf)] * (DELAY_STEPS + 1) * filled, DELAY_STEPS + 1)

    def acceleration(self, speed, lead_speed, gap):
        self._measured.append((speed, lead_speed, gap))
        speed, lead_speed, gap = self._measured[0 if len(self._measured) > DELAY_STEPS else -1]
        return 0.0 if math.isinf(gap) else self._idm(speed, lead_speed, gap)


class Delayed:
    """Per vehicle."""

    def __init__(self, filled: bool = False) -> None:
        self._filled = filled

    def start(self, episode):
        self._line = Line(idm_acceleration, self._filled)

    def step(self, seen):
        return self._line.acceleration(seen.speed_mps, seen.lead_speed_mps, seen.gap_m)

    def close(self): ...


class DelayedBatch(Delayed):
    """Over arrays."""

    def start_batch(self, cells, episodes, random):
        started = {int(cell): Line(idm_acceleration, self._filled) for cell in cells}
        self._lines = {**getattr(self, "_lines", {}), **started}

    def step_batch(self, seen):
        rows = zip(seen.cell, seen.speed_mps, seen.lead_speed_mps, seen.gap_m, strict=True)
        return [self._lines[int(cell)].acceleration(*map(float, row)) for cell, *row in rows]


class DelayedScript(TraciStyleController):
    """A TraCI-style script."""

    def on_start(self, random):
        self._line = Line(idm_acceleration)

    def on_step(self, traci, veh_id, time):
        name, gap = traci.vehicle.getLeader(veh_id) or (None, math.inf)
        lead_speed = traci.vehicle.getSpeed(name) if name else math.nan
        a = self._line.acceleration(traci.vehicle.getSpeed(veh_id), lead_speed, gap)
        traci.vehicle.setAcceleration(veh_id, a, 0.1)


class SlowsDownOnce(TraciStyleController):
    """Begins, in its first call, to drive 3 m/s slower within 10 s."""

    def on_start(self, random):
        self._told = False

    def on_step(self, traci, veh_id, time):
        if not self._told:
            traci.vehicle.slowDown(veh_id, traci.vehicle.getSpeed(veh_id) - 3.0, 10.0)
        self._told = True


class Notes(IDM):
    """Writes down what it is shown of the last episode that begins; what it answers meanwhile is nonsense."""

    seen = []

    def start(self, episode):
        self.seen.clear()

    def step(self, seen):
        self.seen.append(seen)
        return "?" if len(self.seen) <= SHOWN else super().step(seen)


def av(form: str, parameters: str = "{}", warm_up_s: float = 2.0) -> str:
    return f"av={{controller: '{HERE}:{form}', parameters: {parameters}, warm_up_s: {warm_up_s}}}"


@pytest.fixture(scope="module")
def filled():
    return motion(av("Delayed", "{filled: true}", warm_up_s=0.0))


@pytest.mark.parametrize("form", ["Delayed", "DelayedBatch", "DelayedScript"])
def test_a_state_that_starts_empty_is_filled_when_the_controller_acts(form, filled):
    assert motion(av(form), cells=7) == filled
    assert motion(av(form, warm_up_s=0.4)) != filled  # not enough
    assert motion(av(form, warm_up_s=0.0)) != filled


@pytest.mark.parametrize("shim", [True, False])
@pytest.mark.parametrize("traffic", [[], [LATERAL]], ids=["one step", "lateral"])
def test_both_worlds_show_the_same(traffic, shim):
    with closing(SumoWorld(5, shim=shim)) as world:
        assert motion(av("Delayed"), *traffic, n=40, world=world) == motion(av("Delayed"), *traffic, n=40)


@pytest.mark.parametrize(("episode", "traffic"), [(0, LATERAL), (1, "environment.cut_in_lead_s=0")])
def test_what_is_shown_is_what_was_and_before_the_test_nobody_changed_speed(episode, traffic):
    shard = drive(av("Notes", warm_up_s=30), traffic, first=episode, n=1, cells=1)
    seen, trace = importlib.import_module(HERE).Notes.seen, shard.traces[0]
    assert shard.failures == {}
    onset = int(shard.episode["onset_step"][0])
    assert [round(10.0 * each.time_s) for each in seen[:SHOWN]] == list(range(onset - SHOWN + 1, onset + 1))
    assert {each.set_speed_mps for each in seen} == {trace[0, 2, 1]}
    for each in seen[: SHOWN + 2]:
        step = round(10.0 * each.time_s)
        there, ago_s = trace[max(step, 0)], max(-step, 0) * 0.1
        vehicles = (each.lv.position_m, each.bv.position_m, each.position_m)
        np.testing.assert_allclose(vehicles, there[:, 0] - ago_s * there[:, 1], rtol=1e-12)
        assert (each.lv.speed_mps, each.bv.speed_mps, each.speed_mps) == tuple(there[:, 1])
    lead_s = shard.episode["lead_steps"][0] * 0.1
    for each in seen[SHOWN:]:
        assert each.bv_overlaps == (each.bv.lane == 0) == math.isfinite(each.gap_m)
        assert each.bv_lateral_speed_mps == pytest.approx(0.0 if each.bv_overlaps else 1.7 / lead_s)
        assert (each.bv_lateral_m < 1.7) != each.bv_overlaps
    for each in seen[:SHOWN]:
        assert (each.gap_m, each.bv.lane, each.lv.lane, each.acceleration_mps2) == (math.inf, 1, 1, 0.0)
        assert (each.bv_lateral_m, each.bv_lateral_speed_mps, each.bv_overlaps) == (0.0, 0.0, False)
        assert math.isnan(each.lead_speed_mps)


def test_a_command_of_the_warm_up_begins_anew_at_the_hand_over():
    runs = [drive(av("SlowsDownOnce", warm_up_s=s), "av.before_event=hold_speed", n=12) for s in (0.0, 2.0, 20.0)]
    for row, trace in runs[0].traces.items():
        onset = int(runs[0].episode["onset_step"][row])
        assert trace[onset + 1, 2, 2] == pytest.approx(-0.3)
    assert [run.failures for run in runs] == [{}] * 3
    assert [run.episode["braked_before"].any() for run in runs] == [False, True, True]  # what it was shown before
    for run in runs:
        run.episode["braked_before"] = 0
    assert all(run.episode.tobytes() == runs[0].episode.tobytes() for run in runs[1:])
