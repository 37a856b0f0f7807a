"""Run a campaign: shards in order through the stop rule, then estimates and report."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.pool.enumeration import ShadowRuns
from harness.pool.shells import PrescribedEpisodes
from harness.pool.vehicle_pool import ShadowPaths
from harness.progress import Progress
from harness.records.folder import (
    SHELLS,
    TABLES,
    shards_on_disk,
    sole_use,
    write_bytes,
    write_json,
    write_shard,
)
from harness.records.manifest import StoppedBy
from harness.resolved import Resolved
from harness.runner.manifest import (
    SMALLEST_FAILED_SAMPLE,
    Manifest,
    Prefix,
    cpu_name,
    require_few_failed,
    require_no_fewer,
    require_own_folder,
)
from harness.runner.planner import Planner, planner_of
from harness.runner.prepare import Prepared, distance_per_test_m, prepare, require_ready, require_same_pool
from harness.runner.retrace import Retracing
from harness.runner.run_result import ESTIMATES, RunResult, conclusion, exit_code
from harness.runner.shadow_runs import (
    as_recorded,
    shadow_file,
    shadow_specs,
    stored_shadows,
)
from harness.runner.stored_estimates import estimate_run
from harness.runner.stored_shards import stored_shard
from harness.runner.worker import ShardDone, ShardSpec
from harness.runner.workers import workers_of
from harness.strata import STORED_DESIGN
from harness.vocabulary import SAMPLING


def run_campaign(
    campaign: Campaign | Resolved,
    out: Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> RunResult:
    """Run a campaign into a folder.

    Parameters
    ----------
    campaign : Campaign or Resolved
        The latter from `require_ready`.
    out : Path
        New, empty, or (with ``resume``) the folder of this campaign.
    workers : int, optional
        Worker processes; as many as there are cores by default. Never changes a result.
    resume : bool
        Continue a run that was interrupted, or to a smaller RHW.
    progress : Progress, optional

    Raises
    ------
    HarnessError
        The campaign, the folder or the AV is at fault; nothing that was finished is lost.
    """
    began = time.monotonic()
    resolved = campaign if isinstance(campaign, Resolved) else require_ready(campaign)
    with sole_use(out):
        earlier = require_own_folder(out, resolved, resume=resume)
        require_no_fewer(out, earlier, resolved.campaign.stop.episodes)
        run = Run(resolved, out, earlier, workers, progress or Progress(), began)
        run.run_all()
        require_no_fewer(out, earlier, run.prefix.n_episodes)
        run.discard_uncounted()
        return run.finish()


class Run:
    """A campaign on its way into a folder, in which nobody but this process writes.

    ``prefix`` is what is finished, ``prescribed`` are cut-ins to draw from, if there are; another ``planner`` may take
    the place of the campaign's own before the first round. ``n_runs`` are at work in turns.
    """

    def __init__(
        self,
        resolved: Resolved,
        out: Path,
        earlier: dict[str, Any],
        workers: int | None,
        progress: Progress,
        began: float,
        *,
        n_runs: int = 1,
    ) -> None:
        self._resolved, self._campaign, self._out, self._progress = resolved, resolved.campaign, out, progress
        for left in out.rglob(".*.part"):  # of an earlier run that was killed
            left.unlink()
        prepared = prepare(resolved, progress)
        self._workers = workers_of(resolved, out, workers, n_runs=n_runs)
        self._retracing = Retracing(resolved)
        self.prescribed: PrescribedEpisodes | None = None
        self._prepared, self._held = prepared, int(earlier["n_episodes"])
        self.prefix = Prefix()
        with ExitStack() as refused:
            refused.callback(self._workers.close)
            self._manifest = Manifest(
                out,
                resolved,
                earlier,
                began=began,
                workers=self._workers.n_workers,
                distance_per_test_m=distance_per_test_m(resolved.environment),
            )
            if prepared.shadow_paths is None:
                self._plan(prepared)
            refused.pop_all()

    def run_all(self) -> None:
        """Run shadow runs, if there are any to make, and then rounds of shards until the stop rule is content."""
        with self.under_way():
            # Until a decision nobody knows how many.
            self.make_ready(self._campaign.stop.episodes if self._campaign.accept is None else None)
            for specs in self.planner.rounds():
                if self.run_round(specs):
                    break

    def make_ready(self, most: int | None) -> None:
        """Run shadow runs, if there are any to make: rounds of ``most`` tests may begin (None: not known)."""
        if (paths := self._prepared.shadow_paths) is not None:
            self._plan(self._prepared.after(self._run_shadows(paths)))
        self._progress.stage(f"episodes{self._workers.where}", most, done=self._held)

    def run_round(self, specs: Iterator[ShardSpec]) -> bool:
        """Run the shards of a round; True, at once, when the campaign is to stop."""
        return any(self._is_enough(done) for done in self._workers.run(specs, self._stored))

    @contextmanager
    def under_way(self) -> Iterator[None]:
        """Rounds are run within this: the manifest follows, so that an interrupted run can be read, and workers end."""
        try:
            yield
            self.prefix.require_few_failed(self._campaign)
        except BaseException:
            self._manifest.write(self.prefix, "interrupted")
            raise
        finally:
            self._workers.close()

    def _plan(self, prepared: Prepared) -> None:
        """Begin to test what has been prepared."""
        if prepared.prescribed is not None:
            require_same_pool(self._out, prepared)
            write_json(self._out / SHELLS, STORED_DESIGN.dump_python(prepared.prescribed.design, mode="json"))
        self.prescribed = prepared.prescribed
        self._prepared = prepared
        self.planner: Planner = planner_of(self._campaign, prepared.prescribed, held=self._held)

    def _stored(self, spec: ShardSpec) -> ShardDone | None:
        """See `stored_shard`; workers are about to be busy with the first shard that it does not know."""
        done = stored_shard(self._out, self._prepared, self._retracing, spec)
        if done is None:
            load_report_meanwhile()
        return done

    def _run_shadows(self, paths: ShadowPaths) -> ShadowRuns:
        """Drive the vehicle along all paths without a cut-in, but for what an earlier run has done of it."""
        environment, n = self._resolved.environment, len(paths)
        self._progress.stage(f"shadow runs{self._workers.where}", n)
        tables, causes = [], Counter[str]()
        for done in self._workers.run(shadow_specs(n), partial(stored_shadows, self._out, paths)):
            if done.parquet:
                write_bytes(shadow_file(self._out, done.spec), done.parquet)
            tables.append(done.table)
            causes += done.failures
            self._progress.advance(done.spec.n_episodes)
            self._manifest.note(shadow_runs={"n_runs": sum(map(len, tables)), "n_failed": causes.total()})
            self._manifest.follow(self.prefix)
        most, where = self._campaign.run.max_failed_share, "the run folder's shadow/ tables"
        require_few_failed(causes.total(), n, causes, most, "shadow runs", where)
        runs = as_recorded(tables, environment)
        self._manifest.note(distance_per_test_m=runs.mean_distance_m(paths.weight))
        return runs

    def _is_enough(self, done: ShardDone) -> bool:
        """Take the next shard; True when the campaign is to stop."""
        files = done.files
        if done.parquet:
            self._manifest.forget_replaced(done.spec)
            files = write_shard(self._out, done.spec.index, done.parquet)
        self.prefix.add(done, files)
        self.prefix.require_few_failed(self._campaign, at_least=SMALLEST_FAILED_SAMPLE)
        enough = self.planner.add(done.block)
        self.prefix.reported_from = self.planner.reported_from
        self._progress.advance(min(max(self.prefix.n_episodes - self._held, 0), done.spec.n_episodes))
        self._progress.status(**self._figures())
        self._manifest.follow(self.prefix)
        return enough

    def _figures(self) -> dict[str, int | float]:
        """What a progress bar shows: crashes, and what the stop rule saw at its last look.

        Only what a rule asks for is called ``rhw``: a bar reckons from it when the campaign will stop.
        """
        watched = "half_width" if self._campaign.stop.rhw is None else "rhw"
        figures: dict[str, int | float] = {"crashes": self.prefix.n_crashes, watched: self.planner.rule.look.rhw}
        weighted = SAMPLING[self._campaign.testing.method].forces
        return figures | ({"one_more_crash": self.planner.rule.look.one_more_crash} if weighted else {})

    def discard_uncounted(self) -> None:
        """Remove shards that an earlier, longer run has left beyond the stop."""
        counted = {self._out / file for shard in self.prefix.shards for file in shard["files"].values()}
        for path in {path for table in TABLES for path in shards_on_disk(self._out, table)} - counted:
            path.unlink()

    def leave(self, *, stopped_by: StoppedBy | None = None, ending: str | None = None, **facts: Any) -> None:
        """Write the manifest of what is finished."""
        if others := self._workers.cpus():  # bits may have come from any of them
            self._manifest.note(cpu=", ".join(sorted({cpu_name(), *others})))
        self._manifest.note(**facts)
        retraced = self._retracing.summary(self.prefix.n_retraced)
        self._manifest.write(self.prefix, "done", stopped_by=stopped_by, ending=ending, retraced=retraced)

    def finish(self) -> RunResult:
        """Write manifest, estimates and report."""
        rule, prefix = self.planner.rule, self.prefix
        stopped_by, said = conclusion(self._campaign, rule, prefix.n_episodes, prefix.reported_from)
        if stopped_by == "rhw" and self.planner.remark:
            said += f" {self.planner.remark}"
        decided = {} if rule.look.decision is None else {"decision": rule.look.decision.to_json()}
        self.leave(stopped_by=stopped_by, ending=said, **decided)
        self._progress.stage("estimates and report", None)
        estimates = estimate_run(self._out)
        write_json(self._out / ESTIMATES, estimates)
        # No worker loads matplotlib, and it has been loaded here while workers were busy.
        from harness.report import write_report  # noqa: PLC0415

        report = write_report(self._out)
        verdict = None if rule.look.decision is None else rule.look.decision.verdict
        code = exit_code(self._campaign, stopped_by, verdict)
        return RunResult(self._out, report, estimates, stopped_by, said, code)


@cache
def load_report_meanwhile() -> None:
    """Load matplotlib beside busy workers, once: no earlier, because it would slow down what makes them wait."""
    threading.Thread(target=import_module, args=("harness.report",), daemon=True).start()
