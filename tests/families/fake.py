"""A family of two events whose rates can be added up by hand: POV comes over close to the AV, or far ahead of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from harness.families.numbers import ParameterFile
from harness.families.protocol import HOLDING, Chosen, Column, Exposure, Family, every_event
from harness.families.script import natural_script

P = {8.0: (0.02, 0.01), 100.0: (0.04, 0.03)}
"""Probabilities of the events, by the gap (m) in the beginning; one is as probable as the other."""
RATE = 0.5 * (0.02 + 0.01)
"""POV drives 20 m/s, the AV 30: 3 or 1 m ahead nobody can brake in time, 93 m ahead nobody arrives within a test."""
P_EVENT = RATE + 0.5 * (0.04 + 0.03)
STEPS = np.arange(60)


class Numbers(ParameterFile):
    folder, replicates = Path(__file__).parent, None


class Fake(Family):
    name, vehicles, principal, ahead, crosses, follows = "fake", ("POV", "AV"), 0, -1, 0, False
    model, default_parameters, ladders, n_uniforms = Numbers, "two-events", {False: "ladder-2"}, 1
    columns = Column("gap_m", pa.float64(), "m", "initial gap"), Column("event", pa.int64(), "1", "of two; -1: none")

    def exposure(self, traffic, parameters):
        return Exposure(2.0, 1.0, 4.0, None, "assumed")

    def start(self, traffic, u):
        return np.where(u < 0.5, *P).astype([("gap_m", float)])[:, 0]

    def events(self, traffic, seed, paths, drivers, recorded=HOLDING, stride=1, offset=None):
        p = np.array([P[gap] for gap in paths.start["gap_m"].tolist()]).reshape(-1, 2)
        everybody = (1 << drivers.drivers.size) - 1
        return every_event(p, np.where(paths.start["gap_m"] == 8.0, everybody, 0)[:, None], stride, offset)

    def choose(self, traffic, seed, paths, event, *, of_pool=True):
        facts = np.rec.fromarrays([paths.start["gap_m"], event], names="gap_m,event")
        return Chosen(facts, np.array([5, 7, -1])[event], np.zeros_like(event))

    def script(self, traffic, chosen):
        n, gap, at = len(chosen.at), chosen.facts["gap_m"], chosen.at[:, None]
        lanes = np.where((at >= 0) & (at <= STEPS), 0, 1).astype(np.int8)[:, :, None]
        x, v = np.stack((105.0 + gap, np.full(n, 100.0)), axis=1), np.tile([20.0, 30.0], (n, 1))
        lane = np.tile(np.array([1, 0], np.int8), (n, 1))
        return natural_script(x, v, lane, np.full(lanes.shape, 20.0), lanes, chosen.at, chosen.lead)


FAKE = Fake()
