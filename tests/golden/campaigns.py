"""Which golden campaigns there are: overrides of base.yaml by name."""

from __future__ import annotations

from pathlib import Path

import pytest

BASE = Path(__file__).parent / "base.yaml"
SHELLS = ("testing.method=shells", "environment.lane_change_level=1")
SPEEDS = "{controller: 'tests.golden.vehicles:Speeds', before_event: controller, limits: {max_acceleration_mps2: 2}}"
ACTING, FAILING = f"av={SPEEDS}", "av.controller=tests.golden.vehicles:Fails"
BRAKES_LITTLE = "av.parameters.min_acceleration_mps2=-1.5"
LATERAL_FILE = str(Path(__file__).parents[2] / "scenarios" / "validate" / "traffic" / "ndd-overtaking-1-lateral.yaml")
LATERAL = f"environment.parameters={LATERAL_FILE}"
NDE, STEP, MIXTURE, FORCED = (f"testing.method={name}" for name in ("nde", "step_mixture", "episode_mixture", "forced"))

IN_BOTH_WORLDS = {
    "nde": (NDE, "environment.lane_change_level=3e6", "records.traces=crash"),
    "forced": (FORCED,),
    "step-immediate": (STEP, "testing.challenge=immediate", "records.moments=first_9"),
    "step-recursive": (STEP,),
    "mixture": (MIXTURE, "records.trace_share=0.05", "records.traces=crash"),
    "shells": (*SHELLS, "records.traces=all"),
    "forced-acting": (FORCED, ACTING),
    "shells-acting": (*SHELLS, ACTING),
    "forced-lateral": (FORCED, LATERAL, BRAKES_LITTLE),
    "shells-lateral": (*SHELLS, LATERAL, "pool.library=ladder-lateral-1"),
    "forced-failing": (FORCED, FAILING),
    "shells-failing": (*SHELLS, FAILING),
    "shells-controller": (*SHELLS, "av.controller=examples.idm:IDM"),
}
IN_THE_TWIN = {
    "nde-lateral": (NDE, LATERAL, "environment.lane_change_level=1e8", BRAKES_LITTLE),
    "mixture-stops": (MIXTURE, "stop.rhw=0.6", "stop.min_crashes=10", "stop.episodes=2000"),
    "mixture-hold-0.1": (MIXTURE, "environment.acceleration_hold_s=0.1", "records.moments=first_9"),
    "forced-inattentive": (
        FORCED,
        "av={model: fvdm, reaction: {delay_s: 0.2, inattention_probability: 0.2, max_jerk_mps3: 20}}",
        "records.traces=all",
    ),
    "forced-batch": (FORCED, "av.controller=examples.idm_batch:IDM"),
    "forced-reference": (FORCED, LATERAL, "av.model=r157-fsm"),
    "shells-accepted": (*SHELLS, "accept.crash_rate_below=4e-7", "stop.episodes=1500"),
    "shells-inside": (*SHELLS, "testing.shells.statement=library", "stop.rhw=0.5"),
    "shells-refuted": (*SHELLS, "av={model: constant, parameters: {acceleration_mps2: 0}}"),
    "shells-stops": (*SHELLS, "stop.rhw=0.6", "stop.episodes=3000", "av.reaction.delay_s=0.6"),
}
IN_SUMO = {
    "forced-krauss": (FORCED, "av.sumo.carFollowModel=Krauss", "records.traces=all"),
    "forced-traci-style": (FORCED, "av.controller=examples.idm_traci_style:IDM"),
}
RUNS = {
    **{f"{name}-twin": (*sets, "world.engine=twin") for name, sets in IN_BOTH_WORLDS.items()},
    **{f"{name}-sumo": sets for name, sets in IN_BOTH_WORLDS.items()},
    **{name: (*sets, "world.engine=twin") for name, sets in IN_THE_TWIN.items()},
    **IN_SUMO,
}
ACT_OR_FAIL = [f"{method}-{kind}" for method in ("forced", "shells") for kind in ("acting", "failing")]
LONG = {"mixture-hold-0.1", *(f"step-immediate{of}" for of in ("", "-twin", "-sumo"))}
LONG |= {*ACT_OR_FAIL, *(f"{name}-sumo" for name in ACT_OR_FAIL)}
"""For .ci/full: tables that take 40 and 50 s of a core, and in SUMO what is run in the twin."""


def quick(names):
    """Names for a test of each, those that take long marked as slow."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in names]


COMPARED = (
    (*SHELLS, "world.engine=twin", "stop.rhw=0.2", "stop.episodes=1200"),
    "av.parameters.min_acceleration_mps2=-8",
)
"""What both sides share, and what the other vehicle has."""
BEGUN, CONTINUED = "stop.episodes=130", ("forced-twin", "shells-twin", "shells-acting-twin")
"""A budget that ends within a round, and runs that end the same after it."""
