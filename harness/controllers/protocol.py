"""What an AV controller implements: per vehicle (easy) or over arrays (fast).

A controller sees its own cell's vehicles and answers with an acceleration for the coming 0.1 s. It never commands
anything but the AV: the motion of LV and BV is what the likelihood ratios are about.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from harness.vocabulary import FloatArray, IntArray


class Neighbour(NamedTuple):
    """Another vehicle of the cell: front-bumper position (m), speed (m/s), lane (0 right, 1 left)."""

    position_m: float
    speed_mps: float
    lane: int


@dataclass(frozen=True, slots=True)
class EpisodeStart:
    """What a per-vehicle controller is told when an episode begins: its index, and the time (s) between two steps.

    ``set_speed_mps`` is the speed at which its vehicle cruises; ``lv_name`` and ``bv_name`` name the vehicles that it
    sees as ``lv`` and ``bv``, empty where there is none. ``random``, seeded by campaign and episode, is the only
    randomness that it may use, so that a replay sees the same.
    """

    episode: int
    step_s: float
    random: np.random.Generator
    set_speed_mps: float = math.nan
    lv_name: str = "LV"
    bv_name: str = "BV"


class Observation(NamedTuple):
    """What a per-vehicle controller sees before a step; filled by `harness.loop.drive.observe`.

    Attributes
    ----------
    time_s : float
        Time since the episode began.
    position_m, speed_mps, acceleration_mps2 : float
        Front bumper, speed, and the acceleration of the last step.
    gap_m, lead_speed_mps : float
        Bumper-to-bumper gap to, and speed of, the vehicle ahead on the AV's lane; infinite and NaN without one.
    bv, lv : Neighbour
        The vehicle that the event is about, and the one ahead of it: BV and LV where vehicles cut in, SV and LV in
        cut-outs, LV and none where that brakes. NaN of one that is not there, or not seen yet.
    bv_lateral_m : float
        How far BV has come over from its lane, from 0 to the way to overlap (1.7 m), where it is counted no further.
        Where cut-ins are one step there is nothing between. In other scenarios it is 0.
    bv_lateral_speed_mps : float
        How fast it comes over; 0 before the onset, and from the overlap on.
    bv_overlaps : bool
        Whether it is seen on the AV's lane. Until a BV is, the gap is infinite: one that sees only its own lane sees
        nobody.
    set_speed_mps : float
        The speed at which the AV cruises where nobody is ahead: that at which the episode began, or the scenario's.
    lv_lateral_m, lv_lateral_speed_mps : float
        In cut-outs how far LV has moved towards the other lane, until the AV's is clear (1.9 m), and how fast; else 0.
    """

    time_s: float
    position_m: float
    speed_mps: float
    acceleration_mps2: float
    gap_m: float
    lead_speed_mps: float
    bv: Neighbour
    lv: Neighbour
    bv_lateral_m: float = 0.0
    bv_lateral_speed_mps: float = 0.0
    bv_overlaps: bool = False
    set_speed_mps: float = math.nan
    lv_lateral_m: float = 0.0
    lv_lateral_speed_mps: float = 0.0


class BatchObservation(NamedTuple):
    """What a batch controller sees before a step: one entry per AV that is to act, all arrays of shape (n,).

    ``cell`` numbers the AV (0 … K − 1) and ``episode`` its episode; the other fields are those of `Observation`, with
    positions and speeds of BV and LV; ``bv_overlaps`` is 0 or 1.
    """

    cell: IntArray
    episode: IntArray
    time_s: FloatArray
    position_m: FloatArray
    speed_mps: FloatArray
    acceleration_mps2: FloatArray
    gap_m: FloatArray
    lead_speed_mps: FloatArray
    bv_position_m: FloatArray
    bv_speed_mps: FloatArray
    bv_lane: IntArray
    lv_position_m: FloatArray
    lv_speed_mps: FloatArray
    lv_lane: IntArray
    bv_lateral_m: FloatArray
    bv_lateral_speed_mps: FloatArray
    bv_overlaps: IntArray
    set_speed_mps: FloatArray
    lv_lateral_m: FloatArray
    lv_lateral_speed_mps: FloatArray


class VehicleController(Protocol):
    """One AV. The class is called once per cell with the campaign's ``av.parameters`` as keyword arguments.

    Optional are ``start(EpisodeStart)``, which begins an episode and forgets the last one, and ``close()`` in the end.
    """

    def step(self, observation: Observation) -> float:
        """Acceleration (m/s²) for the coming step."""


class BatchController(Protocol):
    """All AVs of a worker. The class is called once with the campaign's ``av.parameters`` as keyword arguments.

    Optional are ``start_batch(cells, episodes, random)``, which begins episodes in these cells, each with the only
    randomness that its controller may use, and ``close()`` in the end.
    """

    def step_batch(self, observation: BatchObservation) -> FloatArray:
        """Accelerations (m/s²) for the coming step, shape (n,)."""
