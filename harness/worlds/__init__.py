"""What simulates the vehicles: SUMO in batches, or its twin in compiled code; the only importer of libsumo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harness.campaign.campaign import Campaign
    from harness.worlds.protocol import World


def build_world(
    campaign: Campaign,
    n_cells: int | None = None,
    *,
    in_sumo: bool = False,
    gui: bool = False,
    options: Sequence[str] = (),
) -> World:
    """The world that a campaign names, or SUMO's, with its number of cells or another.

    An AV whose SUMO model keeps hidden state gets one cell in any case; ``gui`` and ``options``: see `SumoWorld`.
    """
    # A run needs one of them, and not what the others import.
    av, cells = campaign.av, n_cells or campaign.world.cells
    if campaign.world.engine == "twin" and not in_sumo:
        from harness.worlds.twin import TwinWorld  # noqa: PLC0415

        return TwinWorld(cells)
    early = av.acts_before_cut_in
    if av.traci is not None:
        from harness.worlds.program import TraciWorld  # noqa: PLC0415

        return TraciWorld(cells, av.traci, av.limits.step_time_s, acts_before_cut_in=early)
    from harness.worlds.sumo import SumoWorld  # noqa: PLC0415
    from harness.worlds.sumo_driven import FreshWorld, SumoAvWorld, recyclable  # noqa: PLC0415

    if av.sumo is None:
        return SumoWorld(cells, gui=gui, options=options)
    if recyclable(av.sumo) and not early:  # one that is released at the start remembers the last episode's cut-in
        return SumoAvWorld(cells, av.sumo, gui=gui, options=options)
    return FreshWorld(av.sumo, campaign.seed, acts_before_cut_in=early, gui=gui, options=options)
