"""Run a campaign: rounds of tests, shards in order through the stop rule, then estimates and report."""

from __future__ import annotations

import time
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from harness.arguments import AtLeastOne, checked
from harness.campaign.campaign import Campaign
from harness.campaign.files import campaign_of
from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, EXIT_REFUTED, CampaignError
from harness.estimators.answer import ended_by, expected_for, pool_remedy
from harness.estimators.stopping import Rule, Verdict
from harness.files import checksum, remove_unfinished
from harness.pool.moved import assumed_in
from harness.pool.vehicle_pool import BaselinePaths
from harness.progress import Progress
from harness.records.folder import (
    SHELLS,
    TABLES,
    StoppedBy,
    parquet,
    shards_on_disk,
    sole_use,
    write_bytes,
    write_sealed,
    write_shard,
)
from harness.resolved import Resolved, require_ready
from harness.runner.resume import (
    SMALLEST_FAILED_SAMPLE,
    Manifest,
    cpu_name,
    require_few_failed,
    require_no_fewer,
    require_own_folder,
    require_same_pool,
    stored_shard,
)
from harness.runner.stored import estimate_run
from harness.runner.workers import LocalWorkers, ShardResult, Workers
from harness.sampling import prepare
from harness.sampling.baseline import IN_MANIFEST, baseline_file, begin, stored_baseline
from harness.sampling.protocol import Rounds, ShardRequest
from harness.strata import STORED_DESIGN

EXIT_OF: Mapping[Verdict, int] = {"accepted": EXIT_DONE, "rejected": EXIT_REFUTED, "undecided": EXIT_BUDGET_SPENT}
ESTIMATES = "estimates.json"


@dataclass(frozen=True)
class RunResult:
    """What a finished campaign left in its folder, ``estimates.json`` and the page ``report.html`` among it.

    ``stopped_by`` is explained at `harness.records.folder.StoppedBy`. The exit code is 0, or 4 when the budget or the
    pool was spent before the asked precision or decision, or 5 where the crash rate is above the limit that was to be
    kept.
    """

    folder: Path
    report: Path
    estimates: dict[str, Any]
    stopped_by: StoppedBy
    exit_code: int


@checked("harness.run")
def run_campaign(
    campaign: Campaign | Resolved | str | Path,
    out: str | Path,
    *,
    workers: AtLeastOne | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> RunResult:
    """Run a campaign, or the one that a path or a vehicle's name stands for, into a folder.

    That is new or empty or, with ``resume``, holds a run of this campaign that was interrupted, or is to go on to a
    smaller RHW. The number of ``workers``, by default as many as there are cores, never changes a result.

    Raises `HarnessError`: the campaign, the folder or the AV is at fault; nothing that was finished is lost.
    """
    resolved = campaign if isinstance(campaign, Resolved) else require_ready(campaign_of(campaign))
    out = Path(out)
    with sole_use(out):
        earlier = require_own_folder(out, resolved, resume=resume)
        require_no_fewer(out, earlier, resolved.campaign.stop.episodes)
        with Run(resolved, out, earlier, workers, progress or Progress()).under_way() as run:
            run.make_ready()
            rounds = run.source.rounds(run.held)
            run_rounds(run, rounds)
        require_no_fewer(out, earlier, run.manifest.n_episodes)
        return run.finish(rounds.rule)


def run_rounds(run: Run, rounds: Rounds) -> None:
    """Run rounds of tests until there are enough."""
    for requests in rounds:
        for shard in run.results(requests):
            enough = rounds.enough(shard.block)
            run.follow(rounds.rule, shard)
            if enough:
                return


class Run:
    """A campaign on its way into a folder, in which nobody but this process writes.

    ``source`` is what its tests are drawn from, ``manifest`` tells what is finished, ``held`` how many tests the folder
    held before.
    """

    def __init__(
        self,
        resolved: Resolved,
        out: Path,
        earlier: dict[str, Any],
        n_workers: int | None,
        progress: Progress,
        *,
        n_runs: int = 1,
    ) -> None:
        self.resolved, self.campaign, self.out, self._progress = resolved, resolved.campaign, out, progress
        began = time.monotonic()
        remove_unfinished(out.rglob(".*.part"))
        self.source = prepare(resolved, progress)
        self.held = int(earlier["n_episodes"])
        self._workers = workers_of(resolved, n_workers, n_runs=n_runs)
        with ExitStack() as refused:
            refused.callback(self._workers.close)
            facts = {
                "workers": self._workers.n_workers,
                "cut_ins_take_time": resolved.family.shows(resolved.environment),
                "distance_per_test_m": resolved.family.mean_distance_m(resolved.environment),
            }
            self.manifest = Manifest(out, resolved, earlier, began=began, **facts)
            refused.pop_all()

    @contextmanager
    def under_way(self) -> Iterator[Run]:
        """Tests are run within this: the manifest follows, so that an interrupted run can be read, and workers end."""
        try:
            self._keep_design()
            self.manifest.note(assumed=assumed_in(self.resolved, self.source.design, self._progress))
            yield self
            self.manifest.require_few_failed()
        except BaseException:
            self.manifest.write("interrupted")
            raise
        finally:
            self._workers.close()

    def make_ready(self) -> None:
        """Make baseline runs, if tests follow from some, and say how many tests there will be at most."""
        if (paths := self.source.baseline_paths) is not None:
            self._make_baseline(paths)
            self._keep_design()
        stop = self.campaign.stop
        # Until a precision or a decision nobody knows how many.
        most = stop.episodes if self.campaign.accept is None and stop.rhw is None else None
        self._progress.stage(f"episodes{self._workers.where}", most, done=self.held)

    def results(self, requests: Iterator[ShardRequest]) -> Iterator[ShardResult]:
        """Finished shards in order, each in the folder and counted."""
        for shard in self._workers.run(requests, self._known):
            self._add(shard)
            yield shard

    def follow(self, rule: Rule, shard: ShardResult) -> None:
        """Show how far it is, and let the manifest follow."""
        self._progress.advance(min(max(self.manifest.n_episodes - self.held, 0), shard.request.n_episodes))
        self._progress.status(crashes=self.manifest.n_crashes, rhw=rule.look.rhw)
        self.manifest.follow()

    def _known(self, request: ShardRequest) -> ShardResult | None:
        """See `stored_shard`."""
        return stored_shard(self.out, self.source, self.manifest.listed(request), request)

    def _add(self, shard: ShardResult) -> None:
        """Write a shard that is not there yet, and count it."""
        if shard.parquet:
            self.manifest.forget_replaced(shard.request)
            files = write_shard(self.out, shard.request.index, shard.parquet)
            crc32 = {name: zlib.crc32(content) for name, content in shard.parquet.items()}
            shard = replace(shard, files=files, crc32=crc32)
        self.manifest.add(shard)
        self.manifest.require_few_failed(at_least=SMALLEST_FAILED_SAMPLE)

    def _make_baseline(self, paths: BaselinePaths) -> None:
        """Drive the vehicle along all paths without a cut-in, and in pilot tests that it is learned from."""
        table, runs = begin(self.source, partial(self._drive, paths))
        self.manifest.note(distance_per_test_m=runs.mean_distance_m(paths.weight))
        self._workers.follow_from(parquet(table))

    def _drive(self, paths: BaselinePaths, what: str, requests: Sequence[ShardRequest]) -> pa.Table:
        """What comes before tests that count, but for what an earlier run has done of it; the manifest follows."""
        n, (counted, listed) = sum(each.n_episodes for each in requests), IN_MANIFEST[what]
        self._progress.stage(f"{what}{self._workers.where}", n)
        tables, causes, crc32 = [], Counter[str](), []
        known = partial(stored_baseline, self.out, paths, self.manifest.earlier(listed))
        for result in self._workers.run(iter(requests), known):
            file = baseline_file(self.out, result.request)
            if result.parquet:
                write_bytes(file, result.parquet)
            crc32.append(checksum(file))
            tables.append(result.table)
            causes += result.failures
            self._progress.advance(result.request.n_episodes)
            counts = {"n_runs": sum(map(len, tables)), "n_failed": causes.total()}
            self.manifest.note(**{counted: counts, listed: crc32})
            self.manifest.follow()
        most, where = self.campaign.run.max_failed_share, f"the run folder's {file.parent.name}/ tables"
        require_few_failed(causes.total(), n, causes, most, what, where)
        return pa.concat_tables(tables)

    def _keep_design(self) -> None:
        """Write the strata, without which nothing can be estimated, where the folder has no others."""
        require_same_pool(self.out, self.source)
        if self.source.design is not None:
            write_sealed(self.out / SHELLS, STORED_DESIGN.dump_python(self.source.design, mode="json"))

    def finish(self, rule: Rule) -> RunResult:
        """Write manifest, estimates and report once the rule has seen enough; no shard beyond the stop is left."""
        manifest, decision, decided = self.manifest, rule.look.decision, dict[str, Any]()
        counted = {self.out / file for shard in manifest.shards for file in shard["files"].values()}
        for path in {path for table in TABLES for path in shards_on_disk(self.out, table)} - counted:
            path.unlink()
        stopped_by = ended_by(self.campaign, rule, manifest.n_episodes)
        missed = self.campaign.stop.rhw is not None and stopped_by not in ("rhw", "below_reference")
        expected = expected_for(rule, self.campaign, manifest.n_episodes) if missed else None
        code = EXIT_BUDGET_SPENT if missed else EXIT_DONE
        if decision is not None:
            code = EXIT_OF[decision.verdict]
            decided["decision"] = decision.to_json()
        if others := self._workers.cpus():  # bits may have come from any of them
            manifest.note(cpu=", ".join(sorted({cpu_name(), *others})))
        decided |= {"expected": expected, "remedy": pool_remedy(rule, self.campaign, stopped_by)}
        manifest.write("done", stopped_by=stopped_by, unmet=rule.look.unmet, **decided)
        self._progress.stage("writing estimates and report", None)
        estimates = estimate_run(self.out)
        write_sealed(self.out / ESTIMATES, estimates)
        from harness.report.page import write_report  # noqa: PLC0415

        return RunResult(self.out, write_report(self.out), estimates, stopped_by, code)


def workers_of(resolved: Resolved, n_workers: int | None, *, n_runs: int = 1) -> Workers:
    """Where a campaign's shards are run; ``n_runs`` campaigns share it and take turns.

    Raises `HarnessError`: the package, the cluster or room in it is missing.
    """
    if resolved.campaign.run.executor == "local":
        return LocalWorkers(resolved, n_workers)
    try:
        from harness.runner.ray import RayWorkers  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise CampaignError(
            "run.executor",
            "ray, but no package ray",
            "the extra for clusters",
            "Install it in the harness's folder, on all machines: pip install -c requirements.lock -e '.[ray]'.",
        ) from error
    return RayWorkers(resolved, n_workers, n_runs=n_runs)
