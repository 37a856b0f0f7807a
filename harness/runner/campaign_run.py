"""Run a campaign: shards in order through the stop rule, then estimates and report."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from harness.campaign.models import Campaign
from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE
from harness.methods import SAMPLING
from harness.progress import Progress, SilentProgress
from harness.records.folder import SHELLS, TABLES, shard_file, sole_use, write_json
from harness.resolved import Resolved
from harness.runner.manifest import Manifest, require_no_fewer, require_own_folder
from harness.runner.planner import Planner, planner_of
from harness.runner.prefix import Prefix
from harness.runner.prepare import (
    Prepared,
    distance_per_test_m,
    prepare,
    require_ready,
    require_same_pool,
)
from harness.runner.retrace import Retracing
from harness.runner.shards import ShardPool, stored_shard
from harness.runner.stored_estimates import estimate_run
from harness.runner.table_accuracy import table_errors
from harness.runner.worker import ShardDone, ShardSpec
from harness.stopped_by import StoppedBy, ending

MANIFEST_INTERVAL_S = 5.0


@dataclass(frozen=True)
class RunResult:
    """What a finished campaign left.

    Attributes
    ----------
    folder : Path
    report : Path
        The page ``report.html``.
    estimates : dict
        Content of ``estimates.json``.
    stopped_by : {"rhw", "episodes", "pool", "pool_error"}
        See `harness.stopped_by`.
    ending : str
        When it ended and which condition decided, in a sentence.
    exit_code : int
        0, or 4 when the budget or the pool was spent before the asked precision.
    """

    folder: Path
    report: Path
    estimates: dict[str, Any]
    stopped_by: StoppedBy
    ending: str
    exit_code: int


def run_campaign(
    campaign: Campaign,
    out: Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    shorten: bool = False,
    progress: Progress | None = None,
) -> RunResult:
    """Run a campaign into a folder.

    Parameters
    ----------
    campaign : Campaign
    out : Path
        New, empty, or (with ``resume``) the folder of this campaign.
    workers : int, optional
        Worker processes; as many as there are cores by default. Never changes a result.
    resume : bool
        Continue a run that was interrupted, or to a smaller RHW.
    shorten : bool
        Whether it may end with fewer tests than the folder holds; the others stay on disk, uncounted.
    progress : Progress, optional

    Raises
    ------
    HarnessError
        The campaign, the folder or the AV is at fault; nothing that was finished is lost.
    """
    return run_resolved(
        require_ready(campaign), out, workers=workers, resume=resume, shorten=shorten, progress=progress
    )


def run_resolved(
    resolved: Resolved,
    out: Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    shorten: bool = False,
    progress: Progress | None = None,
) -> RunResult:
    """`run_campaign` of what `require_ready` has resolved."""
    with sole_use(out):
        return _run_alone(resolved, out, workers, progress or SilentProgress(), resume=resume, shorten=shorten)


def _run_alone(
    resolved: Resolved,
    out: Path,
    workers: int | None,
    progress: Progress,
    *,
    resume: bool,
    shorten: bool,
) -> RunResult:
    """`run_resolved` in a folder that no other process uses."""
    started = time.monotonic()
    campaign = resolved.campaign
    earlier = require_own_folder(out, resolved.content_hash, resolved.controller_sha256, resume=resume)
    if not shorten:
        require_no_fewer(out, earlier, campaign.stop.episodes)
    prepared = prepare(resolved, progress)
    distance = distance_per_test_m(resolved.environment)
    n_workers = workers or os.cpu_count() or 1
    manifest = Manifest(
        out,
        campaign,
        resolved.content_hash,
        earlier,
        controller_sha256=resolved.controller_sha256,
        workers=n_workers,
        distance_per_test_m=distance,
        table_errors=table_errors(campaign, resolved.environment, prepared.tables),
    )
    if prepared.prescribed is not None:
        require_same_pool(out, prepared)
        write_json(out / SHELLS, prepared.prescribed.design.to_json())
    retracing = Retracing(resolved)
    planner = planner_of(campaign, prepared.prescribed, held=0 if earlier is None else int(earlier["n_episodes"]))
    prefix = Prefix(campaign)
    _run_shards(
        resolved,
        prepared,
        out,
        n_workers,
        progress,
        manifest,
        lambda: time.monotonic() - started,
        prefix,
        planner,
        retracing,
    )
    if not shorten:
        require_no_fewer(out, earlier, prefix.n_episodes)
        _discard_beyond(out, len(prefix.specs))
    elapsed = time.monotonic() - started
    stopped_by = _stopped_by(campaign, planner, prefix.n_episodes)
    retraced = retracing.summary(prefix.n_retraced)
    asked = campaign.stop.rhw is not None
    ended = ending(stopped_by, prefix.n_episodes, planner.rule.waited_for, precision_asked=asked)
    manifest.write(
        prefix.specs,
        prefix.files,
        status="done",
        elapsed_s=elapsed,
        stopped_by=stopped_by,
        ending=ended,
        retraced=retraced,
        repeated=prefix.repeated,
    )
    progress.stage("estimates and report", None)
    estimates = estimate_run(out)
    write_json(out / "estimates.json", estimates)
    # No worker loads matplotlib, and it has been loaded here while workers were busy.
    from harness.report import write_report  # noqa: PLC0415

    report = write_report(out)
    missed = asked and not planner.rule.reached
    return RunResult(out, report, estimates, stopped_by, ended, EXIT_BUDGET_SPENT if missed else EXIT_DONE)


def _stopped_by(campaign: Campaign, planner: Planner, n_episodes: int) -> StoppedBy:
    if planner.rule.reached:
        return "rhw"
    if planner.rule.pool_error_above_target:  # whatever else is spent: more of it would not help
        return "pool_error"
    return "episodes" if n_episodes >= campaign.stop.episodes else "pool"


def _run_shards(
    resolved: Resolved,
    prepared: Prepared,
    out: Path,
    workers: int,
    progress: Progress,
    manifest: Manifest,
    elapsed: Callable[[], float],
    prefix: Prefix,
    planner: Planner,
    retracing: Retracing,
) -> None:
    """Run shards until the stop rule is content; the manifest follows so that an interrupted run can be read."""
    campaign = resolved.campaign
    pool = ShardPool(resolved, out, workers)
    written = elapsed()

    def stored(spec: ShardSpec) -> ShardDone | None:
        return stored_shard(out, campaign, spec, prepared.prescribed, retracing)

    progress.stage("episodes", campaign.stop.episodes, done=_episodes_on_disk(out))
    threading.Thread(target=import_module, args=("harness.report",), daemon=True).start()
    try:
        for done in (done for specs in planner.rounds() for done in pool.run(specs, stored, manifest)):
            prefix.add(done)
            stop = planner.add(done.block)
            progress.advance(0 if done.stored else done.spec.n_episodes)
            progress.status(**_figures(campaign, prefix.n_crashes, planner))
            if elapsed() - written > MANIFEST_INTERVAL_S:
                written = elapsed()
                _note(manifest, prefix, "running", written)
            if stop:
                break
        prefix.require_few_failed()
    except BaseException:
        _note(manifest, prefix, "interrupted", elapsed())
        raise
    finally:
        pool.close()


def _figures(campaign: Campaign, n_crashes: int, planner: Planner) -> dict[str, int | float]:
    """What a progress bar shows: crashes, and what the stop rule saw at its last look.

    Only what a rule asks for is called ``rhw``: a bar reckons from it when the campaign will stop.
    """
    watched = "half_width" if campaign.stop.rhw is None else "rhw"
    figures: dict[str, int | float] = {"crashes": n_crashes, watched: planner.rule.rhw}
    weighted = SAMPLING[campaign.testing.method].forces
    return figures | ({"heaviest": planner.rule.heaviest} if weighted else {})


def _note(manifest: Manifest, prefix: Prefix, status: str, elapsed_s: float) -> None:
    manifest.write(prefix.specs, prefix.files, status=status, elapsed_s=elapsed_s, repeated=prefix.repeated)


def _episodes_on_disk(folder: Path) -> int:
    """Episodes that an earlier run has finished, for the progress bar."""
    n = 0
    for path in (folder / "episodes").glob("shard-*.parquet"):
        with suppress(OSError, pa.ArrowException):  # a damaged file is refused when its turn comes
            n += pq.read_metadata(path).num_rows
    return n


def _discard_beyond(folder: Path, n_shards: int) -> None:
    """Remove what was run beyond the stop: a result must not depend on how many workers were ahead."""
    last = {table: Path(shard_file(table, n_shards - 1)).name for table in TABLES}
    for table in TABLES:
        for path in sorted((folder / table).glob("shard-*.parquet")):
            if path.name > last[table]:
                path.unlink()
        for path in (folder / table).glob(".*.part"):
            path.unlink()
