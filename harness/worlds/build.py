"""The SUMO world that a campaign's AV needs."""

from __future__ import annotations

from collections.abc import Sequence

from harness.campaign.campaign import Campaign
from harness.worlds.av_type import recyclable
from harness.worlds.protocol import World
from harness.worlds.sumo import SumoWorld
from harness.worlds.sumo_driven import FreshWorld, SumoAvWorld


def build_sumo_world(
    campaign: Campaign, n_cells: int | None = None, *, gui: bool = False, options: Sequence[str] = ()
) -> World:
    """World for a campaign with engine ``sumo``, with ``world.cells`` cells or another number.

    An AV whose SUMO model keeps hidden state gets one cell in any case; ``gui`` and ``options``: see `SumoWorld`.

    Raises `CampaignError`: SUMO refuses the AV's attributes.
    """
    cells = n_cells or campaign.world.cells
    av = campaign.av
    early = av.acts_before_cut_in
    if av.traci is not None:
        from harness.worlds.traci_driven import TraciWorld  # noqa: PLC0415 - few campaigns need it

        return TraciWorld(cells, av.traci, av.limits.step_time_s, acts_before_cut_in=early)
    if av.sumo is None:
        return SumoWorld(cells, gui=gui, options=options)
    if recyclable(av.sumo) and not early:  # one that is released at the start remembers the last episode's cut-in
        return SumoAvWorld(cells, av.sumo, gui=gui, options=options)
    return FreshWorld(av.sumo, campaign.seed, acts_before_cut_in=early, gui=gui, options=options)
