"""What a campaign will cost, before it is run."""

from __future__ import annotations

import os
from typing import Any

from harness.campaign.models import Campaign
from harness.criticality.tables import tables_cached
from harness.importance.build import needs_tables
from harness.pool.storage import cached_pool
from harness.resolved import Resolved
from harness.runner.measured_cost import seconds_per_test
from harness.runner.prepare import require_ready
from harness.sumo.shim import shim_library

EPISODES_PER_SECOND_PER_CORE = {
    "sumo": {"nde": 3500, "forced": 1500, "step_mixture": 1600, "episode_mixture": 2000, "shells": 1700},
    "sumo with shim": {"nde": 6000, "forced": 2500, "step_mixture": 2700, "episode_mixture": 3000, "shells": 2700},
    "twin": {"nde": 70000, "forced": 32000, "step_mixture": 25000, "episode_mixture": 18000, "shells": 30000},
}
"""Orders of magnitude, recording included, measured on one core of a 2020s server; `benchmarks/` measures yours."""
POOL_S = "about 15 s"
KB_PER_EPISODE = 0.2
KB_PER_MOMENT = 0.1
MOMENTS_PER_EPISODE = {"all": 70, "first_9": 9, "none": 0}


def plan_campaign(campaign: Campaign) -> dict[str, Any]:
    """Cost of a campaign that runs to its budget of episodes.

    Returns
    -------
    dict
        ``episodes``, ``episodes_per_second_estimate`` (all cores), ``seconds_estimate``, ``tables`` (in words) and
        ``disk_mb``; of an AV that is not built in ``av_ms_per_test``, measured, or in words why there is none.

    Raises
    ------
    CampaignError
        A run would refuse the campaign before it starts.
    """
    resolved = require_ready(campaign)
    engine = "sumo with shim" if campaign.world.engine == "sumo" and shim_library() else campaign.world.engine
    per_core: float = EPISODES_PER_SECOND_PER_CORE[engine][campaign.testing.method]
    measured = None if campaign.av.model is not None else seconds_per_test(campaign)
    if isinstance(measured, float):
        moved_by_sumo = campaign.av.source in ("sumo", "traci")
        per_core = 1.0 / (measured + (0.0 if moved_by_sumo else 1.0 / per_core))
    rate = _rounded(per_core * (os.cpu_count() or 1))
    moments = MOMENTS_PER_EPISODE[campaign.records.moments] if needs_tables(campaign) else 0
    episodes = campaign.stop.episodes
    return {
        "episodes": episodes,
        "episodes_per_second_estimate": rate,
        "seconds_estimate": round(episodes / rate),
        "tables": _tables(resolved),
        "disk_mb": round(episodes * (KB_PER_EPISODE + KB_PER_MOMENT * moments) / 1000.0, 1),
        **(
            {}
            if measured is None
            else {"av_ms_per_test": measured if isinstance(measured, str) else _rounded(1e3 * measured)}
        ),
    }


def _rounded(value: float) -> float:
    """Two digits: more are not known."""
    return float(f"{value:.2g}")


def _tables(resolved: Resolved) -> str:
    campaign = resolved.campaign
    if campaign.testing.method == "shells":
        return "pool of cut-ins: " + ("cached" if cached_pool(resolved) else f"to build ({POOL_S} on two cores)")
    if not needs_tables(campaign):
        return "none needed"
    if tables_cached(resolved.environment, resolved.surrogates, campaign.testing.challenge):
        return "cached"
    seconds = 5 if campaign.environment.acceleration_hold_s >= 0.5 else 40
    return f"to build (about {seconds * len(campaign.surrogates)} s of one core)"
