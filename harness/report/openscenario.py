"""An episode as OpenSCENARIO XML 1.2 on an OpenDRIVE road, by scenariogeneration (extra ``harness[export]``).

Every vehicle follows a polyline with a point for each step of 0.1 s, so that a player shows what was simulated and
decides nothing. A lane change goes on sideways as fast as it began; one of a single step takes 0.1 s.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
from scenariogeneration import xodr, xosc

from harness.files import write_atomically
from harness.report.player import LANE_M, ReplayResult, share_over, tracks_of
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

WIDTH_M, HEIGHT_M = 1.9, 1.5
"""Of every vehicle [assumed]: their length alone is simulated."""
AXLES_M, WHEEL_M, OVERHANG_M = 2.8, 0.6, 1.1
"""Between axles, diameter of a wheel, from the rear bumper to the rear axle, OpenSCENARIO's origin [assumed]."""
FASTEST_MPS, HARDEST_MPS2 = 100.0, 15.0
"""Limits that the format asks for; nothing reaches them."""
AHEAD_M = 200.0
"""Road beyond the last position."""


def write_openscenario(result: ReplayResult, file: Path) -> list[Path]:
    """Write the motion of an episode as ``file`` (.xosc), and its road beside it (.xodr)."""
    roads, init, entities = file.with_suffix(".xodr"), xosc.Init(), xosc.Entities()
    tracks = tracks_of(result.trace)
    story = xosc.StoryBoard(init, _at((len(tracks["AV"]) - 1) * STEP_S, "stop"))
    for name, track in tracks.items():
        positions = _positions(track)
        speed = xosc.AbsoluteSpeedAction(
            track.column("v_mps")[0].as_py(),
            xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0),
        )
        entities.add_scenario_object(name, _car(name))
        init.add_init_action(name, xosc.TeleportAction(positions[0]))
        init.add_init_action(name, speed)
        story.add_maneuver(_follows(name, positions), name, _at(0.0, "start"))
    network = xodr.OpenDrive(file.stem)
    last_m = max(track.column("x_m")[-1].as_py() for track in tracks.values())
    network.add_road(xodr.create_road(xodr.Line(last_m + AHEAD_M), 0, 0, 2, lane_width=LANE_M))
    network.adjust_roads_and_lanes()
    scenario = xosc.Scenario(
        file.stem, "harness", xosc.ParameterDeclarations(), entities, story, xosc.RoadNetwork(roads.name),
        xosc.Catalog(), osc_minor_version=2,
    )  # fmt: skip
    write_atomically(roads, lambda unfinished: network.write_xml(str(unfinished)))
    write_atomically(file, lambda unfinished: scenario.write_xml(str(unfinished)))
    return [file, roads]


def _positions(track: pa.Table) -> list[xosc.WorldPosition]:
    """Of a vehicle's rear axle in each step: x along the road, y from the left edge of the left lane to the left."""
    x = track.column("x_m").to_numpy() - VEHICLE_LENGTH_M + OVERHANG_M
    y = -LANE_M * (0.5 + share_over(track)[: x.size])
    return [xosc.WorldPosition(*place, 0.0, 0.0, 0.0, 0.0) for place in zip(x.tolist(), y.tolist(), strict=True)]


def _car(name: str) -> xosc.Vehicle:
    centre_m, between_wheels_m = VEHICLE_LENGTH_M / 2.0 - OVERHANG_M, WIDTH_M - WHEEL_M / 2.0
    box = xosc.BoundingBox(WIDTH_M, VEHICLE_LENGTH_M, HEIGHT_M, centre_m, 0.0, HEIGHT_M / 2.0)
    front = xosc.Axle(0.5, WHEEL_M, between_wheels_m, AXLES_M, WHEEL_M / 2.0)
    rear = xosc.Axle(0.0, WHEEL_M, between_wheels_m, 0.0, WHEEL_M / 2.0)
    return xosc.Vehicle(name, xosc.VehicleCategory.car, box, front, rear, FASTEST_MPS, HARDEST_MPS2, HARDEST_MPS2)


def _follows(name: str, positions: list[xosc.WorldPosition]) -> xosc.Maneuver:
    line = xosc.Trajectory(f"motion of {name}", closed=False)
    line.add_shape(xosc.Polyline((np.arange(len(positions)) * STEP_S).round(1).tolist(), positions))
    action = xosc.FollowTrajectoryAction(line, xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1.0, 0.0)
    event = xosc.Event(f"{name} moves", xosc.Priority.override)
    maneuver = xosc.Maneuver(f"{name} moves")
    event.add_action(f"{name} follows its motion", action)
    event.add_trigger(_at(0.0, "start"))
    maneuver.add_event(event)
    return maneuver


def _at(time_s: float, side: str) -> xosc.ValueTrigger:
    when = xosc.SimulationTimeCondition(time_s, xosc.Rule.greaterOrEqual)
    return xosc.ValueTrigger(f"{side} at {time_s:.1f} s", 0.0, xosc.ConditionEdge.none, when, side)
