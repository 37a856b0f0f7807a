"""Base of families in which the AV follows a vehicle from the start, and the traffic never looks at it.

So the probability of an event does not depend on the AV, and a pool is exact for any. An event is one of a grid.
"""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa

from harness import elementary
from harness.campaign.sections import EnvironmentSettings
from harness.compiled import unboxed
from harness.families.flow import Flow
from harness.families.following.approach import (
    AV_START_M,
    HOLD_STEPS,
    START_DTYPE,
    FollowingTraffic,
    drawn_accelerations,
    empty_motion,
    starts_from,
)
from harness.families.following.follow import DRIVING_DTYPE, STATE, Tests, drive_others, enumerate_events, move_others
from harness.families.following.parameters import EVENT_DTYPE, NO_EVENT, FollowingParameters
from harness.families.following.words import STAND_INS
from harness.families.protocol import HOLDING, Chosen, Column, Driven, Events, Exposure, Family, Paths, Recorded
from harness.families.script import Script, natural_script
from harness.vehicles.drivers import Followers, driver_records
from harness.vehicles.following import seen_after
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import FloatArray, IntArray, RecordArray

START_FACTS = (
    Column("start_speed_mps", pa.float64(), "m/s", "initial speed of all but a revealed vehicle"),
    Column("natural_headway_s", pa.float64(), "s", "headway that people keep on this path"),
    Column("lead_accelerations", pa.list_(pa.int8()), "0.2 m/s²", "of the vehicle ahead, each second", "n_seconds"),
    Column("event", pa.int64(), "1", "which of the family's grid, -1 for none"),
    Column("lead_speed_mps", pa.float64(), "m/s", "speed of the vehicle ahead at the onset"),
)
N_SPEEDS = 1024
"""Quantiles of the speed over which means are taken."""
MILDEST_MPS2 = 0.5
"""Braking that an event needs: below this nothing is tested [assumed]."""


class FollowingFamily(Family):
    """A family of this kind adds its parameters, vehicles and facts; drivers know from when on they see an event."""

    n_uniforms, follows, stand_ins = 2, True, STAND_INS
    outside_kept = 2  # 39,000 to 45,000 tests without a crash show that a rate is below 0.3 of the competent driver's
    model: type[FollowingParameters]

    def traffic(self, settings: EnvironmentSettings, parameters: FollowingParameters | None = None) -> FollowingTraffic:
        parameters = parameters or self.parameters(settings)
        values = parameters.values()
        onset = round(values["approach__duration_s"] / STEP_S)
        steps = {"onset": onset, "max_steps": onset + round(values["approach__after_s"] / STEP_S)}
        clear = {name: values.get(f"leaving__{name}", math.nan) for name in ("clear_m", "visible_from_m")}
        scope = {name: values.get(f"leaving__{name}", 0.0) for name in ("scope_mps2", "scope_headway_s")}
        scope["below_mps2"] = math.inf
        sections = ("fit_range__", "initial_state__", "free_driving__", "approach__")
        kernel_numbers = {name: value for name, value in values.items() if name.startswith(sections)} | clear | scope
        dtype = [*((name, "f8") for name in kernel_numbers), *((name, "i8") for name in steps)]
        numbers = np.array([(*kernel_numbers.values(), *steps.values())], dtype)[0]
        Flow(numbers).require_sound(settings.parameters)
        return FollowingTraffic(numbers, *parameters.grid())

    def max_steps(self, traffic: FollowingTraffic) -> int:
        return int(traffic.numbers["max_steps"])

    def sideways_m(self, traffic: FollowingTraffic) -> float:
        return float(np.nan_to_num(traffic.numbers["clear_m"]))

    def mean_speed_mps(self, traffic: FollowingTraffic) -> float:
        """Of the vehicle ahead, during the approach."""
        uneventful = self.choose(traffic, 0, _usual_paths(traffic), np.full(N_SPEEDS, -1))
        _, speed, _ = self._moved(traffic, uneventful.facts)
        return float(speed[:, : int(traffic.numbers["onset"]), 0].mean())

    def share_in_scope(self, traffic: FollowingTraffic) -> float:
        """Share of events that are in scope."""
        events = self.events(traffic, 0, _usual_paths(traffic), Followers(driver_records([])))
        return float(elementary.exp(events.log_any).mean())

    def exposure(self, traffic: FollowingTraffic, parameters: FollowingParameters) -> Exposure:
        rate, share = parameters.counted(), self.share_in_scope(traffic)
        counted = rate.counted and (rate.counted[0], rate.counted[1] / share)
        return Exposure(rate.per_hour * share, rate.low * share, rate.high * share, counted, rate.source)

    def milder(self, traffic: FollowingTraffic) -> FollowingTraffic | None:
        if (scope := float(traffic.numbers["scope_mps2"])) <= MILDEST_MPS2:
            return None
        numbers = traffic.numbers.copy()
        numbers["scope_mps2"], numbers["below_mps2"] = MILDEST_MPS2, scope
        return traffic._replace(numbers=numbers)

    def start(self, traffic: FollowingTraffic, u: FloatArray) -> RecordArray:
        return starts_from(traffic.numbers, u)

    def events(
        self,
        traffic: FollowingTraffic,
        seed: int,
        paths: Paths,
        drivers: Followers,
        recorded: Recorded = HOLDING,  # what the AV does moves no probability
        stride: int = 1,
        offset: IntArray | None = None,
    ) -> Events:
        n, n_events, n_drivers = paths.number.size, traffic.grid.size, drivers.drivers.size
        events = Events(np.zeros((n, n_events)), np.zeros((n, n_events), np.int64), np.zeros(n), np.zeros(n))
        first = np.zeros(n, np.int64) if offset is None else offset
        accelerations = drawn_accelerations(traffic.numbers, seed, paths.number, paths.start["speed_mps"])
        given = unboxed(traffic), unboxed(drivers), unboxed(empty_motion(traffic))
        now, at_onset = np.zeros(n_drivers, DRIVING_DTYPE), np.zeros((n_drivers, STATE))
        enumerate_events(paths.start, accelerations, stride, first, *given, now, at_onset, unboxed(events))
        return events

    def choose(
        self, traffic: FollowingTraffic, seed: int, paths: Paths, event: IntArray, *, of_pool: bool = True
    ) -> Chosen:
        onset = int(traffic.numbers["onset"])
        seconds = -(-onset // HOLD_STEPS)
        lists = [("lead_accelerations", np.int8, (seconds,)), ("n_seconds", np.int64)]
        real = [(each.name, np.float64) for each in self.columns if each.kind == pa.float64()]
        facts: RecordArray = np.zeros(event.size, np.dtype([*real, ("event", np.int64), *lists]))
        facts["start_speed_mps"] = paths.start["speed_mps"]
        facts["natural_headway_s"] = paths.start["natural_headway_s"]
        facts["n_seconds"], facts["event"] = seconds, event
        # A pool has many events of each path: its motion is computed once.
        _, first, path = np.unique(paths.number, return_index=True, return_inverse=True)
        accelerations = drawn_accelerations(traffic.numbers, seed, paths.number[first], paths.start["speed_mps"][first])
        facts["lead_accelerations"] = accelerations[path]
        _, speed, _ = self._moved(traffic, facts[first])
        facts["lead_speed_mps"] = speed[path, onset - 1, 0]
        _, first, kind = np.unique(event, return_index=True, return_inverse=True)
        _, _, clear_of_kind = self._moved(traffic, facts[first])
        clear = clear_of_kind[kind]
        for name, values in self.facts_of(traffic, events_of(traffic, event), facts["lead_speed_mps"]).items():
            facts[name] = np.where(event < 0, np.nan, values)
        lead = np.where(clear - onset < traffic.numbers["max_steps"], clear - onset - 1, 0)
        return Chosen(facts, np.where(event < 0, -1, onset + lead), np.where(event < 0, 0, lead))

    def onset(self, traffic: FollowingTraffic, chosen: Chosen) -> IntArray:
        return np.where(chosen.at < 0, -1, int(traffic.numbers["onset"]))  # records keep no lead

    def first_onset(self, traffic: FollowingTraffic) -> int:
        return int(traffic.numbers["onset"])

    def facts_of(self, traffic: FollowingTraffic, events: RecordArray, speed_mps: FloatArray) -> dict[str, FloatArray]:
        """Facts of the family's own, of events (n,) behind a vehicle at a speed; by default the fields of the grid."""
        return {each.name: events[each.name] for each in self.columns if each.name in (EVENT_DTYPE.names or ())}

    def _moved(self, traffic: FollowingTraffic, facts: RecordArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Motion of the others in tests (n,); see `move_others`."""
        n, others = len(facts), len(self.vehicles) - 1
        x, speed = np.zeros((n, others)), np.zeros((n, self.max_steps(traffic), others))
        clear = np.zeros(n, np.int64)
        move_others(_tests(traffic, facts), unboxed(traffic), unboxed(empty_motion(traffic)), x, speed, clear)
        return x, speed, clear

    def script(self, traffic: FollowingTraffic, chosen: Chosen) -> Script:
        facts, onset = chosen.facts, int(traffic.numbers["onset"])
        ahead, speed, clear = self._moved(traffic, facts)
        n, steps, others = speed.shape
        x = np.column_stack((ahead, np.full(n, AV_START_M)))
        v = np.tile(facts["start_speed_mps"][:, None], (1, others + 1))
        lane, lanes = np.zeros((n, others + 1), np.int8), np.zeros(speed.shape, np.int8)
        visible = np.zeros((n, others), np.int64)
        lateral = events_of(traffic, facts["event"])["lateral_mps"]
        if others > 1:
            v[:, 1] = speed[:, 0, 1]
            lanes[:, :, 0] = np.arange(1, steps + 1) >= clear[:, None]
            visible[:, 1] = [
                onset + seen_after(float(traffic.numbers["visible_from_m"]), w, c - onset) if w > 0.0 else steps + 1
                for w, c in zip(lateral.tolist(), clear.tolist(), strict=True)
            ]
        return natural_script(x, v, lane, speed, lanes, chosen.at, chosen.lead)._replace(
            acts_from=np.zeros(n, np.int64),
            visible_from=visible,
            headway_s=facts["natural_headway_s"].copy(),
            sideways_mps=np.nan_to_num(lateral),
            set_speed_mps=np.full(n, float(traffic.numbers["approach__set_speed_mps"])),
        )

    def drive(
        self, traffic: FollowingTraffic, chosen: Chosen, start: FloatArray, drivers: RecordArray, *, last: bool = False
    ) -> Driven:
        steps, facts = self.max_steps(traffic), chosen.facts  # (not ``start``: a follower drives from the beginning)
        end, tracks = np.zeros((len(facts), len(drivers)), np.int64), np.zeros((len(drivers), steps + 1, 2))
        room = empty_motion(traffic)
        now = np.zeros(len(drivers), DRIVING_DTYPE)
        drive_others(_tests(traffic, facts), unboxed(traffic), drivers, unboxed(room), now, tracks, end)
        ahead = np.stack((room.x[:, self.principal], room.v[:, self.principal]), axis=1)
        return Driven(end, tracks if last else np.zeros((0, 0, 0)), ahead if last else np.zeros((0, 0)))


def _tests(traffic: FollowingTraffic, facts: RecordArray) -> Tests:
    """Tests (n,) by their facts, for kernels."""
    start: RecordArray = np.zeros(len(facts), START_DTYPE)
    start["speed_mps"], start["natural_headway_s"] = facts["start_speed_mps"], facts["natural_headway_s"]
    accelerations = np.ascontiguousarray(facts["lead_accelerations"])
    return unboxed(Tests(start, accelerations, events_of(traffic, facts["event"])))


def events_of(traffic: FollowingTraffic, number: IntArray) -> RecordArray:
    """Events (n,) by their numbers in the grid; for -1 one in which nothing happens."""
    return np.append(traffic.grid, NO_EVENT)[number]


def _usual_paths(traffic: FollowingTraffic) -> Paths:
    u = (np.arange(N_SPEEDS) + 0.5) / N_SPEEDS
    return Paths(np.arange(N_SPEEDS), starts_from(traffic.numbers, np.column_stack((u, u))))
