"""What simulates the vehicles: SUMO in batches, or its twin in compiled code; the only importer of libsumo."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.families import family_named
from harness.vocabulary import VEHICLES, BoolArray, FloatArray, Int8Array, IntArray

if TYPE_CHECKING:
    from harness.campaign.campaign import Campaign


MOST_SUMO_CELLS = 256
"""Roads of the largest committed network."""


class World:
    """K = ``n_cells`` cells, each with V ``vehicles``, the AV last, on a two-lane road of its own.

    ``x``, ``v``, ``lane`` (K, V) are front bumpers' positions (m), speeds (m/s) and lanes (0 right, 1 left), as the
    world reports them. One that ``drives_av`` itself (SUMO's own models, or a program connected to SUMO) does so from
    the start of an episode if it ``acts_before_event``, else from the step after the event.
    """

    drives_av = acts_before_event = False
    lent: Collection[str] = ()  # what others in this process have used of the simulation's own interface

    def __init__(self, n_cells: int, vehicles: Sequence[str] = VEHICLES) -> None:
        self.n_cells, self.vehicles = n_cells, tuple(vehicles)
        self.x: FloatArray = np.zeros((n_cells, len(vehicles)))
        self.v: FloatArray = np.zeros((n_cells, len(vehicles)))
        self.lane: Int8Array = np.zeros((n_cells, len(vehicles)), np.int8)
        self._contact: BoolArray = np.zeros(n_cells, np.bool_)

    def announce(self, cells: IntArray, episodes: IntArray) -> None:
        """Episodes (n,) of the given cells (n,), told before they are placed."""

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray, lane: Int8Array) -> None:
        """Put the vehicles of the given cells (n,) at ``x[cells]``, ``v[cells]``, on ``lane[cells]``.

        ``x`` and ``v`` (K, V) may be the world's own arrays, already overwritten.
        """
        raise NotImplementedError

    def step(self, speed: FloatArray, lane: Int8Array) -> BoolArray:
        """Advance all cells to the speeds (m/s, shape (K, V)) at the end of the step.

        ``lane`` (K, V) are the lanes that vehicles are then on; the AV keeps its own. Returns the cells (K,) in which
        vehicles have come into contact that are on one lane, or were before the step.
        """
        raise NotImplementedError

    def restart(self) -> None:
        """Begin again with all cells idle, after an `AVLostError`."""

    def close(self) -> None:
        """Release what the world holds."""


class AVLostError(Exception):
    """What drives the AVs is gone: all running episodes fail with this cause; ``x``, ``v`` are as before the step."""


def build_world(campaign: Campaign, n_cells: int | None = None) -> World:
    """The world that a campaign names, with its number of cells or another.

    An AV whose SUMO model keeps hidden state gets one cell in any case.
    """
    av, cells, family = campaign.av, n_cells or campaign.world.cells, family_named(campaign.scenario)
    vehicles = family.vehicles
    if campaign.world.engine == "twin":
        from harness.worlds.twin import TwinWorld  # noqa: PLC0415

        return TwinWorld(cells, vehicles)
    cells, early = min(cells, MOST_SUMO_CELLS), av.acts_before_event or family.follows
    if av.traci is not None:
        from harness.worlds.program import TraciWorld  # noqa: PLC0415

        return TraciWorld(cells, av.traci, av.limits, vehicles, acts_before_event=early)
    from harness.worlds.sumo import SumoWorld  # noqa: PLC0415
    from harness.worlds.sumo_driven import FreshWorld, SumoAvWorld, recyclable  # noqa: PLC0415

    if av.sumo is None:
        return SumoWorld(cells, vehicles)
    if recyclable(av.sumo) and not early:  # one that is released at the start remembers the last episode's event
        return SumoAvWorld(cells, av.sumo, vehicles)
    return FreshWorld(av.sumo, campaign.own_seed(campaign.seed), vehicles, acts_before_event=early)
