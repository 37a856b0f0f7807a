"""Events that are milder than those that count: some are driven, so that it is said where the vehicle crashes there.

They enter no rate, and a vehicle that crashes on them is not accepted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from harness.campaign.campaign import Campaign
from harness.families import family_named
from harness.loop.loop import EpisodeLoop
from harness.progress import Progress
from harness.records.schemas import episodes_table
from harness.resolved import Resolved
from harness.sampling.baseline import ALL_MOTION, BaselineResult
from harness.sampling.forced import Forced
from harness.sampling.protocol import ShardRequest

N_TESTS = 36
"""One that crashes on a tenth of them is found out 98 times in 100."""


def run_milder(loop: EpisodeLoop, resolved: Resolved, request: ShardRequest) -> BaselineResult:
    """Drive the loop's vehicle in a range of the milder events, of which there are `N_TESTS`."""
    milder = replace(resolved, environment=resolved.family.milder(resolved.environment))
    tests = Forced(milder, Progress()).tests(0, N_TESTS)
    rows = slice(request.first_episode, request.first_episode + request.n_episodes)
    shard = loop.beside(keep=ALL_MOTION).run(request.first_episode, tests.rows(rows))
    return BaselineResult(request, episodes_table(shard, resolved.campaign.seed))


def milder_of(resolved: Resolved, table: pa.Table) -> dict[str, Any]:
    """Tests, crashes and failures, by their table of episodes, and how many such events an hour of driving has."""
    family, crashes = resolved.family, pc.equal(table.column("outcome").cast(pa.string()), "crash")
    if above := resolved.campaign.crash.counts_above_mps:
        crashes = pc.and_(crashes, pc.fill_null(pc.greater(table.column("impact_speed_mps"), above), fill_value=False))
    exposure = family.exposure(family.milder(resolved.environment), resolved.parameters)
    counts = {"n_tests": len(table), "n_crashes": pc.sum(crashes).as_py()}
    return {**counts, "n_failed": len(table) - table.column("failure").null_count, "per_hour": exposure.per_hour}


def n_left_out(campaign: Campaign, n_before_event: int) -> int:
    """Crashes before the event, where a vehicle that follows is tested around events alone: it needs none to crash.

    Where somebody changes lanes it is not known: a vehicle may see that before the event is done.
    """
    family = family_named(campaign.scenario)
    at_once = family.follows and family.crosses < 0
    return n_before_event if at_once and campaign.testing.method != "nde" else 0


def beyond_scope(milder: Mapping[str, Any] | None) -> int:
    """How many of the milder tests speak against a vehicle: one that has failed may have hidden a crash."""
    return 0 if milder is None else milder["n_crashes"] + milder["n_failed"]
