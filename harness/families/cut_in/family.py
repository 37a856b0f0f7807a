"""The cut-in as a family of events: the methods that the core calls, by the kernels of this package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa

from harness.campaign.sections import EnvironmentSettings
from harness.compiled import unboxed
from harness.errors import CampaignError
from harness.families.cut_in.events import FREE_DRAWS_PER_CUT_IN, enumerate_cut_ins, write_maneuvers
from harness.families.cut_in.laws import Environment, InitialStates
from harness.families.cut_in.loading import load_environment, load_parameters, require_sound_laws
from harness.families.cut_in.parameters import DEFAULT, EnvironmentParameters
from harness.families.cut_in.path import empty_trajectory, mean_test_distance
from harness.families.cut_in.script import drive_along, facts_of, script_of
from harness.families.cut_in.vocabulary import STATE_COLUMNS
from harness.families.cut_in.words import AT_OVERLAP, STAND_INS, WORDS
from harness.families.protocol import Chosen, Column, Exposure, Family, Paths
from harness.families.words import CLOSING
from harness.vocabulary import BV, LV, VEHICLES, FloatArray, IntArray, RecordArray

STATE_FACTS = (
    Column("v_bv_mps", pa.float64(), "m/s", "speed of BV"),
    Column("r1_m", pa.float64(), "m", "gap LV-BV, bumper to bumper"),
    Column("r1dot_mps", pa.float64(), "m/s", "rate of R1: v_LV - v_BV"),
    Column("r2_m", pa.float64(), "m", "gap BV-AV, bumper to bumper"),
    Column("r2dot_mps", pa.float64(), "m/s", "rate of R2: v_BV - v_AV"),
)
DISTANCE_SEED = DISTANCE_PATHS = 20_000
"""Paths over which the mean distance of a test is taken; its standard error is below 0.5 %. Tests with a cut-in are too
few (some 3e-5 at level 1) to matter."""

_COUNTED = (
    "cut-ins that begin at more than 5 m/s of closing speed and 22.2 m/s or more, in the trajectories of de Gelder et "
    "al. (2021), doi:10.1109/ACCESS.2021.3136585"
)
EXPOSURE = Exposure(0.048, 0.013, 0.123, (3, 63.0), _COUNTED)


class CutIn(Family):
    """See `harness.families.protocol.Family`."""

    name = "cut_in"
    vehicles = VEHICLES
    principal, ahead = BV, LV
    columns = (
        *(each._replace(doc=f"initial {each.doc}") for each in STATE_FACTS),
        Column("lv_maneuvers", pa.list_(pa.int8()), "1", "LV's draws, in order", "n_lv"),
        Column("bv_maneuvers", pa.list_(pa.int8()), "1", "BV's draws, in order; 31 marks the cut-in", "n_bv"),
    )
    n_uniforms = len(STATE_COLUMNS)

    model, default_parameters = EnvironmentParameters, DEFAULT
    stride, pool_error = 4, 0.005  # `benchmarks.pool_stride` says what other strides would cost
    ladders = {False: "ladder-2", True: "ladder-lateral-1"}

    fitter = "harness.families.cut_in.fitting.fitter:CutInFitter"
    sources = dict.fromkeys(("nde", "step_mixture", "episode_mixture"), "harness.families.cut_in.nade.in_loop:InLoop")
    follows, crosses, words = False, BV, WORDS
    maps = ((AT_OVERLAP, CLOSING),)
    stand_ins = STAND_INS

    parameters = staticmethod(load_parameters)
    traffic = staticmethod(load_environment)
    events = staticmethod(enumerate_cut_ins)
    script = staticmethod(script_of)
    drive = staticmethod(drive_along)

    def traffic_with(
        self, settings: EnvironmentSettings, parameters: EnvironmentParameters, values: Mapping[str, float]
    ) -> Environment | None:
        try:
            environment = load_environment(settings, parameters.with_values(values))
            require_sound_laws(environment, settings.parameters)
        except (CampaignError, ValueError):
            return None
        return environment

    def max_steps(self, traffic: Environment) -> int:
        return int(traffic.numbers["max_steps"])

    def sideways_m(self, traffic: Environment) -> float:
        return traffic.lateral.distance_m

    def shows(self, traffic: Environment) -> bool:
        return traffic.lateral.present

    def mean_distance_m(self, traffic: Environment) -> float:
        states = InitialStates(traffic.numbers).draw(DISTANCE_SEED, 0, DISTANCE_PATHS)
        scratch = empty_trajectory(traffic)
        return float(mean_test_distance(DISTANCE_SEED, states, unboxed(traffic), unboxed(scratch)))

    def mean_speed_mps(self, traffic: Environment) -> float:
        states = InitialStates(traffic.numbers).draw(DISTANCE_SEED, 0, DISTANCE_PATHS)
        return float((states["v_bv_mps"] - states["r2dot_mps"]).mean())

    def exposure(self, traffic: Environment, parameters: Any) -> Exposure:  # counted, whatever the laws
        return EXPOSURE

    def start(self, traffic: Environment, u: FloatArray) -> RecordArray:
        return InitialStates(traffic.numbers).from_uniforms(u)

    def choose(self, traffic: Environment, seed: int, paths: Paths, event: IntArray, *, of_pool: bool = True) -> Chosen:
        maneuvers = write_maneuvers(seed, paths, event, traffic, FREE_DRAWS_PER_CUT_IN if of_pool else 0)
        return Chosen(facts_of(paths.start, maneuvers), event, maneuvers.lead)


CUT_IN = CutIn()
