"""A part of a run whose tests are known beforehand: the very tests that a whole run would make, and no others.

A job array runs each part by itself, on any machine; `harness.runner.merge` makes of all of them what one process
would have left.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.campaign.models import Campaign
from harness.errors import CampaignError, RunFolderError
from harness.part import Part
from harness.progress import Progress, SilentProgress
from harness.records.folder import sole_use
from harness.records.stored_manifest import kind_of
from harness.runner.campaign_run import Run
from harness.runner.manifest import require_own_folder
from harness.runner.planner import Planner, known_specs
from harness.runner.prepare import require_ready
from harness.runner.second_phase import Plan
from harness.runner.worker import ShardSpec


@dataclass(frozen=True)
class PartResult:
    """What a finished part left; its counts are not yet an estimate.

    ``described`` is its number, of how many, its first test and how many it has; ``kind`` says in words which it is.
    """

    folder: Path
    described: dict[str, int]
    kind: str
    n_crashes: int
    n_failed: int


def run_part(
    source: Campaign | Plan,
    part: Part,
    out: Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> PartResult:
    """Run one part of a campaign, or of the second phase that a plan has, into a folder.

    Parameters
    ----------
    source : Campaign or Plan
        The former with a fixed number of tests.
    part : Part
    out, workers, resume, progress
        See `harness.runner.run_campaign`.

    Raises
    ------
    HarnessError
        The campaign decides while it runs what it tests or when it ends; it, or the plan, has fewer shards than parts;
        what is tested is not what was planned for; or as `harness.runner.run_campaign`.
    """
    began = time.monotonic()
    campaign, plan = (source.campaign, source) if isinstance(source, Plan) else (source, None)
    specs = fixed_specs(campaign, part) if plan is None else planned_specs(plan, part)
    resolved = require_ready(campaign)
    first, n_episodes = specs[0].first_episode, sum(spec.n_episodes for spec in specs)
    described = {"number": part.number, "of": part.of, "first_episode": first, "n_episodes": n_episodes}
    facts: dict[str, Any] = {"part": described, **({} if plan is None else {"plan": plan.second})}
    if plan is not None:
        plan.require_same(resolved)
    with sole_use(out):
        earlier = require_own_folder(out, resolved, resume=resume, kind=kind_of(facts))
        progress = progress or SilentProgress()
        run = Run(resolved, out, earlier, workers, progress, began, **facts)
        with run.under_way():
            if plan is not None:
                plan.lend_shadows(out)
            run.make_ready(n_episodes)
            if plan is not None and run.prescribed is not None:
                plan.require_pool(run.prescribed.design.pool)
            run.planner = Planner(run.planner.rule)
            run.run_round(iter(specs))
        run.discard_uncounted()
        run.leave()
        return PartResult(out, described, kind_of(facts), run.prefix.n_crashes, run.prefix.n_failed)


def fixed_specs(campaign: Campaign, part: Part) -> list[ShardSpec]:
    """Shards of a part of a campaign; a `CampaignError` if their number is not fixed, or below that of parts."""
    stop, size = campaign.stop, campaign.run.shard_size
    if campaign.testing.method == "shells":
        raise CampaignError(
            "testing.method",
            found="shells, with --part",
            expected="nde, forced, step_mixture or episode_mixture: shells decide after each round what is tested next",
            mend="Plan it (`harness plan CAMPAIGN --out PLAN`), then `harness run PLAN --part K/N`; or run it on one "
            "machine with many --workers, or choose another method.",
        )
    if stop.rhw is not None:
        raise CampaignError(
            "stop.rhw",
            found=f"{stop.rhw:g}, with --part",
            expected="null: no part knows when all together are precise enough",
            mend=f"Write --set stop.rhw=null; all parts together make stop.episodes ({stop.episodes:,}) tests.",
        )
    n_shards, of_size = -(-stop.episodes // size), stop.episodes // part.of
    if n_shards < part.of:
        again = f"write --set run.shard_size={of_size} for all of them" if of_size else ""
        raise CampaignError(
            "run.shard_size",
            found=f"{size:,}, of which stop.episodes ({stop.episodes:,}) makes {n_shards} in all, for {part.of} parts",
            **_fewer(n_shards, again),
        )
    return list(known_specs(campaign, *part.bounds(n_shards)))


def planned_specs(plan: Plan, part: Part) -> list[ShardSpec]:
    """Shards of a part of the second phase; a `RunFolderError` if it has fewer shards than parts."""
    specs, n_tests = plan.specs(), sum(plan.second["tests"])
    if len(specs) < part.of:
        of_size = n_tests // part.of
        again = f"plan again, into another folder, with --set run.shard_size={of_size}" if of_size else ""
        found = f"a plan of {n_tests:,} tests in {len(specs):,} shards, for {part.of:,} parts"
        raise RunFolderError(str(plan.folder), found=found, **_fewer(len(specs), again))
    return specs[slice(*part.bounds(len(specs)))]


def _fewer(n_shards: int, again: str) -> dict[str, str]:
    """What to say where there are more parts than shards."""
    mend = f"Take at most {n_shards} part{'s' * (n_shards > 1)}." + (f" Or {again}." if again else "")
    return {"expected": "a shard for each part, at least", "mend": mend}
