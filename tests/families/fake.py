"""A family of two events whose rates can be added up by hand: POV comes over close to the AV, or far ahead of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from harness.families.cut_in.words import CLOSING, GAP, STAND_INS, WORDS
from harness.families.numbers import ParameterFile
from harness.families.protocol import HOLDING, Chosen, Column, Driven, Events, Exposure, Family
from harness.families.script import natural_script

AT = np.array([5, 7])
"""Steps of the two events."""
NEAR_M, FAR_M = 8.0, 100.0
"""Gaps at the beginning, as probable as each other; POV drives 20 m/s, the AV 30."""
P = {NEAR_M: (0.02, 0.01), FAR_M: (0.04, 0.03)}
P_EVENT = 0.5 * (0.02 + 0.01) + 0.5 * (0.04 + 0.03)
RATE = 0.5 * (0.02 + 0.01)
"""3 m or 1 m ahead nobody can brake in time; 93 m ahead nobody arrives within the six seconds of a test."""
STEPS = 60


class Numbers(ParameterFile):
    """Of which none can be another."""

    folder, blocks, replicates = Path(__file__).parent, {}, None


class Fake(Family):
    """See `harness.families.protocol.Family`."""

    name = "fake"
    vehicles = ("POV", "AV")
    principal, ahead = 0, -1
    columns = (
        Column("gap_m", pa.float64(), "m", "initial gap"),
        Column("event", pa.int64(), "1", "which of the two, -1 for none"),
    )
    n_uniforms = 1
    default_parameters, follows, stride, pool_error = "two-events", False, 4, 0.005
    shipped = Path(__file__).parent
    words = WORDS._replace(rests=lambda *_: "the numbers of this file", limits="")
    fitter, crosses, maps, stand_ins = "", 0, ((GAP, CLOSING),), STAND_INS
    ladders = {False: "ladder-2", True: "ladder-2"}

    def parameters(self, settings):
        return Numbers()

    def traffic_with(self, settings, parameters, values):
        return None

    def traffic(self, settings, parameters=None):
        return "fake"

    def digest(self, traffic):
        return traffic

    def max_steps(self, traffic):
        return STEPS

    def sideways_m(self, traffic):
        return 1.7

    def exposure(self, traffic, parameters):
        return Exposure(2.0, 1.0, 4.0, None, "assumed")

    def mean_distance_m(self, traffic):
        return 180.0

    def mean_speed_mps(self, traffic):
        return 30.0

    def start(self, traffic, u):
        return np.array([(NEAR_M if one < 0.5 else FAR_M,) for one in u[:, 0]], [("gap_m", float)])

    def events(self, traffic, seed, paths, drivers, recorded=HOLDING, stride=1, offset=None):
        exact = np.array([P[gap] for gap in paths.start["gap_m"].tolist()]).reshape(-1, 2)
        first = np.zeros(len(exact), np.int64) if offset is None else offset
        asked = np.arange(2) % stride == first[:, None]
        all_of_them = (1 << drivers.drivers.size) - 1
        crashes = np.where(asked & (paths.start["gap_m"] == NEAR_M)[:, None], all_of_them, 0)
        return Events(np.where(asked, stride * exact, 0.0), crashes, np.log(exact.sum(1)), np.zeros(len(exact)))

    def choose(self, traffic, seed, paths, event, *, of_pool=True):
        facts = np.zeros(len(event), [("gap_m", float), ("event", np.int64)])
        facts["gap_m"], facts["event"] = paths.start["gap_m"], event
        return Chosen(facts, np.where(event < 0, -1, AT[event]), np.zeros(len(event), np.int64))

    def onset(self, traffic, chosen):
        return chosen.at

    def script(self, traffic, chosen):
        n = len(chosen.facts)
        x, v = np.tile([105.0, 100.0], (n, 1)), np.tile([20.0, 30.0], (n, 1))
        x[:, 0] += chosen.facts["gap_m"]
        lanes = np.where((chosen.at >= 0)[:, None] & (np.arange(STEPS) >= chosen.at[:, None]), 0, 1)
        lane = np.tile(np.array([1, 0], np.int8), (n, 1))
        speed = np.full((n, STEPS, 1), 20.0)
        return natural_script(x, v, lane, speed, lanes.astype(np.int8)[:, :, None], chosen.at, chosen.lead)

    def drive(self, traffic, chosen, start, drivers, *, last=False):
        """Drivers who do nothing: near ones touch POV when the gap is used up at 1 m a step."""
        crash = (chosen.facts["gap_m"] == NEAR_M) & (chosen.at >= 0)
        end = np.repeat(np.where(crash, int(NEAR_M) + 1, -1)[:, None], len(drivers), axis=1)
        step = np.arange(STEPS + 1)
        av = np.column_stack((100.0 + 3.0 * step, np.full(step.size, 30.0)))
        ahead = np.column_stack((105.0 + chosen.facts["gap_m"][-1] + 2.0 * step, np.full(step.size, 20.0)))
        av[(step <= chosen.at[-1]) | ((step > end[-1, 0]) & crash[-1])] = 0.0
        return Driven(end, np.tile(av, (len(drivers), 1, 1)) if last else np.zeros((0, 0, 0)), ahead)

    def avoidable(self, traffic, facts, where, drivers):
        return None


FAKE = Fake()
