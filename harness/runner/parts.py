"""A part of a run whose tests are known beforehand: the very tests that a whole run would make, and no others.

A job array runs each part by itself, on any machine; `harness.runner.merge` makes of all of them what one process
would have left. Shells are planned first: a plan is the first of two phases of a campaign, and the tests that it has
planned for the second. Their number does not depend on what they come to, so that they can be run as parts, and a rate
from them alone is unbiased by stopping.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, CampaignError, RunFolderError
from harness.part import Part
from harness.progress import Progress
from harness.records.folder import link_or_copy, read_manifest, sole_use
from harness.records.stored_manifest import PLAN, StoredPlan, kind_of
from harness.resolved import Resolved
from harness.runner.campaign_run import Run
from harness.runner.manifest import require_no_fewer, require_own_folder
from harness.runner.planner import Planner, ShellPlanner, known_specs, round_specs
from harness.runner.prepare import require_ready
from harness.runner.run_result import conclusion
from harness.runner.shadow_runs import SHADOW
from harness.runner.worker import ShardSpec
from harness.stopped_by import MENDS


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
        progress = progress or Progress()
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


@dataclass(frozen=True)
class PlanResult:
    """What a first phase left, and an ending in a sentence.

    ``n_shards`` is in how many shards the ``n_planned`` tests are, the most parts there can be; ``expected_rhw`` is the
    relative half-width that is expected of them. The exit code is 4 where the budget or the pool allows no tests that
    could reach the asked precision.
    """

    folder: Path
    n_first: int
    n_planned: int
    n_shards: int
    expected_rhw: float
    ending: str
    exit_code: int


@dataclass(frozen=True)
class Plan:
    """A finished plan; ``folder`` is its own, or that of a part, which has all that it needs of it."""

    folder: Path
    campaign: Campaign
    manifest: dict[str, Any]

    @property
    def second(self) -> dict[str, Any]:
        """As the manifest has it; see `StoredPlan`."""
        return dict(self.manifest["plan"])

    def specs(self) -> list[ShardSpec]:
        """Shards of the second phase."""
        tests, drawn = (np.array(self.second[name], np.int64) for name in ("tests", "drawn"))
        first, size = (self.second["first_shard"], self.second["first_episode"]), self.campaign.run.shard_size
        return round_specs(drawn, tests, *first, size)

    def require_same(self, resolved: Resolved) -> None:
        """Refuse (`RunFolderError`) to test another vehicle, or in other traffic, than the first phase."""
        now = {"campaign_hash": resolved.content_hash, "controller_sha256": resolved.controller_sha256}
        for key, value in now.items():
            if self.manifest.get(key) != value:
                raise RunFolderError(
                    str(self.folder),
                    found=f"a plan with {key} {self.manifest.get(key)}",
                    expected=f"{value}, of the campaign or controller as it is now: both phases test the same",
                    mend="Restore what was changed since, or plan again into another folder.",
                )

    def lend_shadows(self, out: Path) -> None:
        """Give a part the shadow runs: its tests follow from them, wherever it is run."""
        for file in sorted((self.folder / SHADOW).glob("*.parquet")):
            if not (to := out / SHADOW / file.name).exists():
                link_or_copy(file, to)

    def require_pool(self, pool: str) -> None:
        """Refuse (`RunFolderError`) another pool: another machine's, or that of a vehicle that does something else."""
        if (planned := self.second["pool"]) != pool:
            raise RunFolderError(
                str(self.folder),
                found=f"a plan for cut-ins of pool {planned}",
                expected=f"pool {pool}, which this campaign has here",
                mend="Use the surrogate library and the version of the harness that it was made with (manifest.json).",
            )


def read_plan(folder: Path) -> Plan:
    """A finished plan, from its folder or from that of a part.

    Raises
    ------
    HarnessError
        There is none, or its first phase has not planned anything.
    """
    manifest = read_manifest(folder)
    if (found := manifest.get("plan")) is None:
        mend = "Name a folder that `harness plan` has written, or the campaign's file."
        raise RunFolderError(str(folder), found=kind_of(manifest), expected=PLAN, mend=mend)
    if not found["tests"] or (kind_of(manifest) == PLAN and manifest["status"] != "done"):
        raise RunFolderError(
            str(folder),
            found=manifest.get("ending") or "a plan that is not finished",
            expected="one whose first phase has planned a second",
            mend="Let `harness plan` go on with --resume.",
        )
    return Plan(folder, load_campaign(folder / "campaign.yaml"), manifest)


def plan_second_phase(
    campaign: Campaign,
    out: Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> PlanResult:
    """Run the first phase of a shells campaign in two phases, and plan the second.

    Parameters
    ----------
    campaign : Campaign
        Its ``testing.shells.stopping`` becomes ``two_phase``, whatever it says.
    out, workers, resume, progress
        See `harness.runner.run_campaign`.

    Raises
    ------
    HarnessError
        No second phase can be planned for such a campaign; or as `harness.runner.run_campaign`.
    """
    began = time.monotonic()
    resolved = require_ready(_in_two_phases(campaign))
    with sole_use(out):
        earlier = require_own_folder(out, resolved, resume=resume, kind=PLAN)
        require_no_fewer(out, earlier, resolved.campaign.stop.episodes)
        unplanned, progress = StoredPlan().model_dump(), progress or Progress()
        run = Run(resolved, out, earlier, workers, progress, began, plan=unplanned)
        with run.under_way():
            run.make_ready(campaign.stop.episodes)
            for specs in run.planner.rounds():
                if run.planner.reported_from or run.run_round(specs):
                    break
        require_no_fewer(out, earlier, run.prefix.n_episodes)
        run.discard_uncounted()
        return _leave(run, resolved.campaign, out)


def _in_two_phases(campaign: Campaign) -> Campaign:
    """The campaign as it is planned."""
    if (method := campaign.testing.method) != "shells":
        expected = "shells: with other methods the number of tests is known without a plan"
        mend = "Run the parts at once: `harness run CAMPAIGN --set stop.rhw=null --part K/N`."
        raise CampaignError("testing.method", found=f"{method}, with `harness plan`", expected=expected, mend=mend)
    if campaign.accept is not None:
        found, expected = "a limit, with `harness plan`", "none: a decision plans no second phase"
        mend = "Delete accept and plan for a precision, or let `harness run` decide on one machine."
        raise CampaignError("accept", found=found, expected=expected, mend=mend)
    if campaign.stop.rhw is None:
        found, expected = "null, with `harness plan`", "the precision that the second phase is planned for"
        raise CampaignError("stop.rhw", found=found, expected=expected, mend="Write e.g. --set stop.rhw=0.3.")
    shells = campaign.testing.shells.model_copy(update={"stopping": "two_phase"})
    return campaign.model_copy(update={"testing": campaign.testing.model_copy(update={"shells": shells})})


def _leave(run: Run, campaign: Campaign, out: Path) -> PlanResult:
    """Write what is planned, or why nothing is, and say it."""
    planner, n_first, stop = run.planner, run.prefix.n_episodes, campaign.stop
    if not isinstance(planner, ShellPlanner) or run.prescribed is None or stop.rhw is None:
        raise TypeError("only shells in two phases are planned")
    if (tests := planner.planned) is None or not tests.any():
        missing = ("room for a second phase",)
        by, said = conclusion(campaign, planner.rule, n_first, planner.reported_from, missing)
        run.leave(stopped_by=by, ending=said)
        return PlanResult(out, n_first, 0, 0, planner.expected_rhw, said, EXIT_BUDGET_SPENT)
    drawn = np.where(tests > 0, planner.drawn - tests, 0)
    n_shards = len(round_specs(drawn, tests, 0, 0, campaign.run.shard_size))
    first = {"first_shard": len(run.prefix.shards), "first_episode": n_first}
    run.leave(plan={"tests": tests.tolist(), "drawn": drawn.tolist(), "pool": run.prescribed.design.pool, **first})
    n_planned, expected = int(tests.sum()), planner.expected_rhw
    said, code = f"Planned {n_planned:,} tests after a first phase of {n_first:,}", EXIT_DONE
    if expected > stop.rhw:
        mend = MENDS["episodes" if n_first + n_planned >= stop.episodes else "pool"]
        said += f"; an RHW of {expected:.2g} is expected of them, and not stop.rhw ({stop.rhw:g}): {mend}"
        code = EXIT_BUDGET_SPENT
    return PlanResult(out, n_first, n_planned, n_shards, expected, f"{said}.", code)
