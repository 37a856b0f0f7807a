"""The shards of a campaign: fixed ranges of episodes, run by worker processes, handed back in order."""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow as pa
from scipy.special import bdtrc

from harness.campaign.models import Campaign
from harness.controllers.black_box import OF_EPISODE, Call, Death
from harness.controllers.time_limit import death_cause
from harness.errors import HarnessError, TooManyFailedError
from harness.pool.shells import PrescribedEpisodes
from harness.records.folder import TABLES, read_table, shard_file, write_shard
from harness.records.tables import ShardTables
from harness.resolved import Resolved
from harness.runner.manifest import Manifest
from harness.runner.processes import WorkerProcess, first_to_answer
from harness.runner.retrace import Retracing
from harness.runner.worker import ShardDone, ShardSpec, failure_causes, shard_block, stored_repeated

ATTEMPTS = 3
"""A shard whose worker dies is given to another one, this many times in all."""
SMALLEST_FAILED_SAMPLE = 200
"""Episodes before the share of failures can end a campaign."""
SURELY_TOO_MANY = 1e-4
"""Probability of so many deaths under the allowed share, below which a controller is refused: with the default share
its third at the earliest, its seventh if it dies in all of 96 cells, some ten seconds into the run."""
SENT_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM)
"""Ends that an operator or a shortage of memory brings: a controller is blamed only when its call is hit again."""


class WorkerLostError(HarnessError):
    """Workers die again and again on the same shard."""

    exit_code = 3


def stored_shard(
    folder: Path,
    campaign: Campaign,
    spec: ShardSpec,
    prescribed: PrescribedEpisodes | None = None,
    retracing: Retracing | None = None,
) -> ShardDone | None:
    """A shard that an earlier run has finished, or None; retraced again.

    Raises
    ------
    RunFolderError
        One of its files is damaged.
    WorldDisagreementError
        The twin retraces an episode differently.
    """
    files = {name: shard_file(name, spec.index) for name in TABLES if (folder / shard_file(name, spec.index)).exists()}
    needed = {"episodes"} | ({"moments"} if campaign.records.moments != "none" else set())
    if not needed <= set(files):
        return None
    tables = {name: read_table(folder / path) for name, path in files.items()}
    if tables["episodes"].num_rows != spec.n_episodes:
        return None  # the last shard of a smaller budget
    if prescribed is not None and not _same_cut_ins(tables["episodes"], prescribed, spec):
        return None  # the last round of a smaller budget
    kept = ShardTables(tables["episodes"], tables.get("moments"), tables.get("traces"))
    n_retraced = 0 if retracing is None else retracing.check(tables["episodes"])
    block, causes = shard_block(campaign, kept, prescribed), failure_causes(kept.episodes)
    repeated = stored_repeated(kept.episodes)
    return ShardDone(spec, block, files, stored=True, n_retraced=n_retraced, failures=causes, repeated=repeated)


def _same_cut_ins(episodes: pa.Table, prescribed: PrescribedEpisodes, spec: ShardSpec) -> bool:
    rows, _ = prescribed.rows(spec.draws)
    stored = episodes.column("pool_cut_in")
    return stored.null_count == 0 and np.array_equal(stored.to_numpy(), rows)


@dataclass
class _Job:
    """A shard that is wanted, with its result once there is one."""

    spec: ShardSpec
    done: ShardDone | None
    deaths: int = 0
    suspected: Call | None = None
    doomed: dict[int, Death] = field(default_factory=dict)


class ShardPool:
    """Worker processes that run shards; one that dies takes nothing but its shard's unfinished work along.

    Everything happens in the caller's thread and each worker has a pipe of its own. So there is no lock that a killed
    process could keep, and no queue that Ctrl-C could leave half filled.
    """

    def __init__(self, resolved: Resolved, folder: Path, workers: int) -> None:
        self._resolved, self._campaign, self._folder = resolved, resolved.campaign, folder
        self._n_workers = workers
        self._idle: list[WorkerProcess] = []
        self._busy: dict[WorkerProcess, _Job] = {}

    def close(self) -> None:
        """Stop all workers, finished or not; those that are idle may release their controllers first."""
        for worker in self._busy:
            worker.kill()
        for worker in self._idle:
            worker.dismiss()
        for worker in self._idle:
            worker.wait()
        self._idle, self._busy = [], {}
        for left in self._folder.glob(".black-box-*"):  # of an earlier run that was killed
            left.unlink()

    def run(
        self, specs: Iterator[ShardSpec], stored: Callable[[ShardSpec], ShardDone | None], manifest: Manifest
    ) -> Iterator[ShardDone]:
        """Finished shards in index order; those that ``stored`` knows are not run again.

        Two shards per worker are under way or wait for their turn to be handed back: little is lost at the stop. Each
        is written when its turn comes, so that the stop rule has not been content before; nobody else writes.

        Raises
        ------
        WorkerLostError
            Workers died `ATTEMPTS` times on the same shard.
        """
        wanted: deque[_Job] = deque()
        waiting: deque[_Job] = deque()
        while True:
            for spec in islice(specs, 2 * self._n_workers + 1 - len(wanted)):
                wanted.append(_Job(spec, stored(spec)))
                if wanted[-1].done is None:
                    waiting.append(wanted[-1])
            if not wanted:
                return
            self._hand_out(waiting)
            while wanted[0].done is None:
                self._collect(waiting)
                self._hand_out(waiting)
            yield self._written(wanted.popleft().done, manifest)  # type: ignore[arg-type]

    def _written(self, done: ShardDone, manifest: Manifest) -> ShardDone:
        """The shard on disk; the manifest forgets what it takes the place of."""
        if done.stored:
            return done
        manifest.forget_replaced(done.spec)
        return replace(done, files=write_shard(self._folder, done.spec.index, done.parquet), parquet={})

    def _hand_out(self, waiting: deque[_Job]) -> None:
        """Give waiting shards to idle workers, of which there may be up to as many as were asked for."""
        while waiting and len(self._busy) < self._n_workers:
            worker = self._idle.pop() if self._idle else WorkerProcess(self._resolved, self._folder)
            if worker.give(waiting[0].spec, waiting[0].doomed):
                self._busy[worker] = waiting.popleft()
            else:
                worker.kill()  # it died while it was idle

    def _collect(self, waiting: deque[_Job]) -> None:
        """Wait for one worker to finish its shard, or to die on it."""
        worker = first_to_answer(list(self._busy))
        job = self._busy[worker]
        job.done = worker.answer()
        del self._busy[worker]
        if job.done is not None:
            self._idle.append(worker)
            return
        call = worker.last_call()
        exit_code = worker.kill()
        waiting.appendleft(job)
        first_time = call != job.suspected
        job.suspected = call
        cause = death_cause(exit_code, self._campaign.av.limits.step_time_s)
        own = call is not None and not (exit_code in SENT_FROM_OUTSIDE and first_time)  # the controller's own doing
        if own and call is not None and call.kind == OF_EPISODE:
            job.doomed[call.episode] = Death(call.step, cause)
            self._require_few_deaths(job)
            return
        job.deaths += 1
        if job.deaths == ATTEMPTS:
            raise self._lost(job, exit_code, f"{cause}, in {call}" if own else None)

    def _lost(self, job: _Job, exit_code: int | None, blamed: str | None) -> WorkerLostError:
        """What to say of a shard that no worker survives; ``blamed`` is what the controller did, if it did."""
        found = f"{ATTEMPTS} worker processes that died, the last " + (
            f"with exit code {exit_code}" if blamed is None else f"because {blamed}"
        )
        mend = "Look for a memory limit (fewer --workers), then continue with --resume."
        if blamed is not None:
            mend = "Mend the controller: look for os._exit, or a crash of compiled code (`harness av-check`)."
        where = f"shard {job.spec.index} (from episode {job.spec.first_episode})"
        return WorkerLostError(where, found=found, expected="a worker that finishes the shard", mend=mend)

    def _require_few_deaths(self, job: _Job) -> None:
        """Each death costs a new process: a controller that dies too often is not run to the end of its shard."""
        share = self._campaign.run.max_failed_share
        episode, death = next(reversed(job.doomed.items()))
        n_deaths, n_begun = len(job.doomed), max(job.doomed) - job.spec.first_episode + 1
        if float(bdtrc(n_deaths - 1, n_begun, share)) < SURELY_TOO_MANY:
            raise TooManyFailedError(
                "run.max_failed_share",
                found=f"{n_deaths} of the first {n_begun} episodes of shard {job.spec.index} ended their worker "
                f"process, the last of them episode {episode}: {death.cause}",
                expected=f"a share of at most {share:g}",
                mend="Mend the controller (`harness av-check` looks at it in seconds), or raise the share to go on.",
            )
