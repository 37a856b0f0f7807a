"""What controllers see of a BV that comes over, in every form that they may have."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest

from examples import idm_batch
from examples.idm import IDM, idm_acceleration
from harness.controllers.protocol import Observation
from harness.controllers.traci_style import TraciStyleController
from tests.controllers.driving import LATERAL, drive, make_fmu
from tests.worlds.running import ROOT

HERE = "tests.controllers.test_lateral"
SEEN: list[Observation] = []
"""What `Notes` has seen: of this module as the campaign imports it, which is another one than pytest's."""


def episodes(*overrides: str) -> np.ndarray:
    shard = drive(*overrides, n=400)
    assert shard.failures == {}
    return shard.results.episode


class Notes(IDM):
    """Keeps its speed and writes down what it sees."""

    def step(self, seen):
        SEEN.append(seen)
        return 0.0


class YieldsBatch(idm_batch.IDM):
    """`examples.sees_lateral` over arrays."""

    def step_batch(self, seen):
        comes = (seen.bv_lateral_speed_mps > 0.0) & (seen.bv_lateral_m >= 0.375 - 1e-9)
        gap = seen.bv_position_m - 5.0 - seen.position_m
        follows = super().step_batch(seen._replace(gap_m=gap, lead_speed_mps=seen.bv_speed_mps))
        return np.where(comes | (seen.bv_overlaps == 1), follows, 0.0)


class YieldsScript(TraciStyleController):
    """The same as a TraCI script, which knows lanes and positions in them."""

    def on_step(self, traci, veh_id, time):
        vehicle = traci.vehicle
        over = -vehicle.getLateralLanePosition("BV")
        comes = vehicle.getLateralSpeed("BV") < 0.0 and over >= 0.375 - 1e-9
        if not comes and vehicle.getLaneIndex("BV") == 1:
            return
        gap = vehicle.getLanePosition("BV") - vehicle.getLength("BV") - vehicle.getLanePosition(veh_id)
        a = idm_acceleration(vehicle.getSpeed(veh_id), vehicle.getSpeed("BV"), gap)
        vehicle.setAcceleration(veh_id, a, 0.1)


YIELDS_FMU = """
gap = self.x_bv - 5.0 - self.x
comes = self.moves > 0.0 and self.over >= 0.375 - 1e-9
self.a = idm_acceleration(self.v, self.v_bv, gap) if comes or self.overlaps else 0.0
"""


@pytest.fixture(scope="module")
def built_in():
    return episodes(LATERAL)


@pytest.mark.parametrize("form", ["examples.sees_lateral:Yields", f"{HERE}:YieldsBatch", f"{HERE}:YieldsScript", "fmu"])
def test_a_controller_that_sees_it_is_the_built_in_model_to_the_last_bit(form, built_in, tmp_path):
    av = f"{{controller: '{form}'}}"
    if form == "fmu":
        imports, files = "from idm import idm_acceleration", [ROOT / "examples/idm.py"]
        fmu = make_fmu(tmp_path, "YieldsFmu", "x v x_bv v_bv over moves overlaps", YIELDS_FMU, imports, files)
        inputs = "position_m: x, speed_mps: v, bv_position_m: x_bv, bv_speed_mps: v_bv, bv_lateral_m: over"
        inputs += ", bv_lateral_speed_mps: moves, bv_overlaps: overlaps"
        av = f"{{fmu: {{file: '{fmu}', inputs: {{{inputs}}}, output: a}}}}"
    assert episodes(LATERAL, f"av={av}").tobytes() == built_in.tobytes()


def test_one_that_waits_for_the_overlap_is_another_vehicle(built_in):
    """The sibling that must fail; it is the built-in model that is blind until then."""
    waits = episodes(LATERAL, "av={controller: 'examples.sees_lateral:Yields', parameters: {perceives_m: 2.0}}")
    assert waits.tobytes() != built_in.tobytes()
    blind = episodes(LATERAL, "av.reaction.perceives_lateral_m=2.0")
    assert waits.tobytes() == blind.tobytes()


@pytest.mark.parametrize("lead_s", [0.0, 1.0])
def test_what_is_seen_of_a_lead(lead_s):
    SEEN = importlib.import_module(HERE).SEEN  # noqa: N806 - the other one
    SEEN.clear()
    episodes(f"environment.cut_in_lead_s={lead_s}", f"av={{controller: '{HERE}:Notes', warm_up_s: 0}}", "world.cells=1")
    assert len(SEEN) > 10_000
    assert all(seen.bv_overlaps == (seen.bv.lane == 0) == math.isfinite(seen.gap_m) for seen in SEEN)
    assert all((seen.bv_lateral_m == 1.7) and (seen.bv_lateral_speed_mps == 0.0) for seen in SEEN if seen.bv_overlaps)
    assert {seen.bv_lateral_speed_mps for seen in SEEN if not seen.bv_overlaps} == ({1.7} if lead_s else set())
