"""Workers that run shards, whose results are handed back in order; what happens to the shard of one that dies.

Here workers are processes of this machine; `harness.runner.ray` makes those of a cluster.
"""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from scipy.special import bdtrc

from harness.controllers.find import has_foreign_code
from harness.controllers.hosts import death_cause
from harness.errors import HarnessError, TooManyFailedError
from harness.estimators.block import Block
from harness.loop.loop import EpisodeLoop
from harness.processes import Began, Child, SharedFile, WorkerDeath, first_to_answer, start_server, tell, usable_cpus
from harness.records.folder import MILDER, Repeated, Tables, read_table
from harness.records.schemas import shard_tables
from harness.resolved import Resolved
from harness.runner.again import is_repeated, repeat
from harness.sampling import prepare
from harness.sampling.paths import BaselineResult, as_recorded, run_baseline, run_milder
from harness.sampling.protocol import ShardRequest
from harness.worlds import build_world

ATTEMPTS = 3
"""A shard whose worker dies is given to another one, this many times in all."""
SURELY_TOO_MANY = 1e-4
"""Probability of so many deaths under the allowed share, below which a controller is refused: with the default share
its third at the earliest, its seventh if it dies in all of 96 cells, some ten seconds into the run."""
SENT_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM, None)
"""Ends that an operator or a shortage of memory brings: a controller is blamed only when its test is hit again."""
CLOSING_S = 10.0
"""Time that a worker gets to release its controllers once all is done."""


@dataclass(frozen=True)
class ShardResult:
    """A finished shard: its tables, and what the stop rule and estimates need of them; a new one is not on disk."""

    request: ShardRequest
    tables: Tables
    block: Block
    is_new: bool = True
    repeated: Repeated | None = None
    """What tests have shown that were run twice, of a shard where `is_repeated`."""


Result = ShardResult | BaselineResult
"""What a worker hands back."""
_Result = TypeVar("_Result", bound=Result)


def serve(connection: Connection, resolved: Resolved, baseline: Path) -> None:
    """Run shards until the parent has no more; the file ``baseline`` holds what tests follow from, if anything."""
    runner: ShardRunner | None = None

    def run(request: ShardRequest, fatal: Mapping[int, str], alone: bool) -> Result:
        nonlocal runner
        if runner is not None and runner.alone != alone:
            runner.close()
            runner = None
        runner = runner or ShardRunner(resolved, baseline, connection if alone else None)
        return runner.run(request, fatal)

    with suppress(EOFError, OSError):
        while True:
            tell(connection, partial(run, *connection.recv()))
    if runner is not None:
        runner.close()


class ShardRunner:
    """Runs shards of one campaign in one world; with a ``connection`` test by test, each told as it begins."""

    def __init__(self, resolved: Resolved, baseline: Path, connection: Connection | None = None) -> None:
        self._connection, self.alone, self._fatal = connection, connection is not None, dict[int, str]()
        self._baseline = baseline
        self._source = prepare(resolved)
        self._begun = False
        self._world = build_world(resolved.campaign, 1 if self.alone else None)
        self._loop: EpisodeLoop = self._source.loop(self._world, before_test=self._before_test)

    def _before_test(self, episode: int) -> str | None:
        if self._connection is not None:
            self._connection.send(Began(episode))
        return self._fatal.get(episode)

    def close(self) -> None:
        """Release the AV's controllers, and the world."""
        self._loop.close()
        self._world.close()

    def run(self, request: ShardRequest, fatal: Mapping[int, str] | None = None) -> Result:
        """Run a shard; tests that are known to be ``fatal`` fail before they begin, with these causes."""
        self._fatal = dict(fatal or {})
        source, paths = self._source, self._source.baseline_paths
        if request.before == MILDER:
            return run_milder(self._loop, source.resolved, request)
        if request.before and paths is not None:
            return run_baseline(self._loop, paths, source.resolved, request)
        if paths is not None and not self._begun:
            self._begun = True
            source.begin_after(as_recorded(read_table(self._baseline), source.scenario.max_steps))
            self._loop = self._loop.beside()
        campaign, shard = source.campaign, source.run(self._loop, request)
        keep_traces = campaign.records.traces != "none" or campaign.records.trace_share > 0.0
        tables = shard_tables(shard, campaign.seed, keep_traces=keep_traces)
        # A vehicle must show that it does the same again: built-in models do, and outside programs need not.
        shows = is_repeated(request) and campaign.av.model is None and campaign.av.traci is None
        repeated = repeat(self._loop, source, shard) if shows else None
        return ShardResult(request, tables, source.block(tables), repeated=repeated)


class WorkerLostError(HarnessError):
    """Workers die again and again, on the same shard or before they have one."""

    exit_code = 3


@dataclass
class _Job:
    """A shard that is wanted, with its result once there is one.

    After a worker's death its tests are run one at a time (``alone``), and those that are ``fatal`` not at all.
    """

    request: ShardRequest
    result: Result | None
    n_deaths: int = 0
    alone: bool = False
    suspected: int | None = None
    fatal: dict[int, str] = field(default_factory=dict)


class Workers:
    """``n_workers`` at most; one that dies takes nothing but its unfinished shard along.

    Everything happens in the caller's thread, and no two workers share anything. So there is no lock that a killed one
    could keep, and no queue that Ctrl-C could leave half filled.
    """

    where = ""
    """Said of the workers where their work is shown; empty for this machine."""

    def __init__(self, resolved: Resolved, n_workers: int) -> None:
        self._campaign, self.n_workers = resolved.campaign, n_workers
        self._idle: list[Any] = []
        self._busy: dict[Any, _Job] = {}

    def follow_from(self, baseline: bytes) -> None:
        """Hand over all baseline runs, as a Parquet file, before the first test that follows from them."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop all workers, finished or not; those that are idle may release their controllers first."""
        for worker in self._busy:
            worker.kill()
        for worker in self._idle:
            worker.dismiss()
        for worker in self._idle:
            worker.wait(CLOSING_S)
        self._idle, self._busy = [], {}

    def run(
        self, requests: Iterator[ShardRequest], known: Callable[[ShardRequest], _Result | None]
    ) -> Iterator[_Result]:
        """Results in the order of the requests; shards that are ``known`` are not run again.

        Two shards per worker are under way or wait for their turn to be handed back: little is lost at the stop, and
        little is held in memory. Raises a `WorkerLostError` when workers died `ATTEMPTS` times on the same shard.
        """
        wanted: deque[_Job] = deque()
        waiting: deque[_Job] = deque()
        while True:
            for request in islice(requests, 2 * self.n_workers + 1 - len(wanted)):
                wanted.append(_Job(request, known(request)))
                if wanted[-1].result is None:
                    waiting.append(wanted[-1])
            if not wanted:
                return
            self._hand_out(waiting)
            while wanted[0].result is None:
                self._collect(waiting)
                self._hand_out(waiting)
            yield wanted.popleft().result  # type: ignore[misc]

    def new_worker(self) -> Any:
        """Another worker beside those that are busy; None as long as none is ready."""
        raise NotImplementedError

    def first_to_answer(self, busy: Sequence[Any]) -> Any:
        """Wait until one of the busy workers has answered or died; None when a new one has become ready instead."""
        raise NotImplementedError

    def _hand_out(self, waiting: deque[_Job]) -> None:
        """Give waiting shards to idle workers, of which there may be up to as many as were asked for."""
        while waiting and len(self._busy) < self.n_workers:
            worker = self._idle.pop() if self._idle else self.new_worker()
            if worker is None:
                return
            if worker.give(waiting[0].request, waiting[0].fatal, waiting[0].alone):
                self._busy[worker] = waiting.popleft()
            else:
                worker.kill()  # it died while it was idle

    def _collect(self, waiting: deque[_Job]) -> None:
        worker = self.first_to_answer(list(self._busy))
        if worker is None:
            return
        job, answer = self._busy[worker], worker.answer()
        del self._busy[worker]
        if isinstance(answer, WorkerDeath):
            waiting.appendleft(job)
            self._blame(job, answer)
        else:
            job.result = answer
            self._idle.append(worker)

    def _blame(self, job: _Job, death: WorkerDeath) -> None:
        """Say whose doing the death of a worker was: a test's that is run no more, or nobody's knows."""
        exit_code, episode = death
        again = episode is not None and episode == job.suspected
        if episode is not None and episode not in job.fatal and (again or exit_code not in SENT_FROM_OUTSIDE):
            job.fatal[episode] = death_cause(exit_code, self._campaign.av.limits)
            job.n_deaths = 0
            self._require_few_deaths(job)
            return
        job.suspected, job.alone = episode, job.alone or exit_code is not None
        job.n_deaths += 1
        if job.n_deaths < ATTEMPTS:
            return
        how = f"with {'its machine' if exit_code is None else f'exit code {exit_code}'}"
        mend = "Look for a memory limit (fewer --workers), then continue with --resume."
        if exit_code not in SENT_FROM_OUTSIDE and has_foreign_code(self._campaign.av):
            how = f"because {death_cause(exit_code, self._campaign.av.limits)}"
            mend = "Fix the controller: look for os._exit or a crash of compiled code (`harness av-check`)."
        where = f"shard {job.request.index} (from test {job.request.first_episode})"
        found = f"{ATTEMPTS} worker processes that died, the last {how}"
        raise WorkerLostError(where, found, "a worker that finishes the shard", mend)

    def _require_few_deaths(self, job: _Job) -> None:
        """Each death costs a new process: a controller that dies too often is not run to the end of its shard."""
        share, fatal = self._campaign.run.max_failed_share, job.fatal
        episode, cause = next(reversed(fatal.items()))
        n_begun = max(fatal) - job.request.first_episode + 1
        if float(bdtrc(len(fatal) - 1, n_begun, share)) < SURELY_TOO_MANY:
            found = f"{len(fatal)} of the first {n_begun} tests of shard {job.request.index} ended their worker process"
            found += f", the last of them test {episode}: {cause}"
            mend = "Fix the controller (`harness av-check` looks at it in seconds)."
            raise TooManyFailedError("run.max_failed_share", found, f"a share of at most {share:g}", mend)


class LocalWorkers(Workers):
    """Processes of this machine, each started when it is first needed."""

    def __init__(self, resolved: Resolved, n_workers: int | None) -> None:
        super().__init__(resolved, n_workers or usable_cpus())
        start_server()
        self._resolved, self._baseline = resolved, SharedFile()

    def new_worker(self) -> Child:
        return Child(serve, self._resolved, self._baseline.path)

    def follow_from(self, baseline: bytes) -> None:
        self._baseline.path.write_bytes(baseline)

    def first_to_answer(self, busy: Sequence[Child]) -> Child:
        return first_to_answer(busy)
