"""Workers that run shards and hand their results back in order; what happens to the shard of a worker that dies.

Here workers are processes of this machine; `harness.runner.ray` has those of a cluster.
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

from harness.controllers.find import has_foreign_code, in_words
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
"""Workers that a shard is given to, one after the other, if they die."""
SURELY_TOO_MANY = 1e-4
"""A controller is refused where so many deaths are less probable than this under the allowed share: with the default
share at its third at the earliest, at its seventh if it dies in all of 96 cells, some ten seconds into the run."""
SENT_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM, None)
"""Exit codes that an operator or a shortage of memory brings: the controller is blamed only if its test dies again."""
CLOSING_S = 10.0
"""Time that a worker gets to release its controllers once all is done."""


@dataclass(frozen=True)
class ShardResult:
    """A finished shard: its tables, and the block that estimates are made from; ``is_new`` if it is not yet on disk."""

    request: ShardRequest
    tables: Tables
    block: Block
    is_new: bool = True
    repeated: Repeated | None = None
    """How many of its tests were run twice, and which differed, if it is a shard where `is_repeated`."""


Result = ShardResult | BaselineResult
"""What a worker hands back."""
_Result = TypeVar("_Result", bound=Result)


def serve(connection: Connection, resolved: Resolved, baseline: Path) -> None:
    """Run shards until the parent has no more; ``baseline`` is the file of baseline runs, if tests follow from some."""
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
            tell(connection, partial(in_words, resolved.campaign.av, partial(run, *connection.recv())))
    if runner is not None:
        runner.close()


class ShardRunner:
    """Runs shards of one campaign in one world; with a ``connection`` one test at a time, telling it which begins."""

    def __init__(self, resolved: Resolved, baseline: Path, connection: Connection | None = None) -> None:
        self._connection, self.alone = connection, connection is not None
        self._fatal: dict[int, str] = {}
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
        campaign = source.campaign
        shard = source.run(self._loop, request)
        keep_traces = campaign.records.traces != "none" or campaign.records.trace_share > 0.0
        tables = shard_tables(shard, campaign.seed, keep_traces=keep_traces)
        # Built-in models always do the same again, and outside programs need not.
        checked = is_repeated(request) and campaign.av.model is None and campaign.av.traci is None
        repeated = repeat(self._loop, source, shard) if checked else None
        return ShardResult(request, tables, source.block(tables), repeated=repeated)


class WorkerLostError(HarnessError):
    """Workers die again and again, on the same shard or before they have one."""

    exit_code = 3


@dataclass
class _Job:
    """A requested shard, with its result once there is one.

    After a worker's death its tests are run one at a time (``alone``); those that are ``fatal`` are not run at all.
    """

    request: ShardRequest
    result: Result | None
    n_deaths: int = 0
    alone: bool = False
    suspected: int | None = None
    fatal: dict[int, str] = field(default_factory=dict)


class Workers:
    """At most ``n_workers``; when one dies, only its unfinished shard is lost.

    Everything happens in the caller's thread, and no two workers share anything: there is no lock that a killed one
    could keep, and no queue that Ctrl-C could leave half filled.
    """

    where = ""
    """Where they are, for the progress display; empty for this machine."""

    def __init__(self, resolved: Resolved, n_workers: int) -> None:
        self._campaign, self.n_workers = resolved.campaign, n_workers
        self._idle: list[Any] = []
        self._busy: dict[Any, _Job] = {}

    def follow_from(self, baseline: bytes) -> None:
        """Hand over all baseline runs, as a Parquet file, before the first test that follows from them."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop all workers, finished or not; idle ones may release their controllers first."""
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
        """Results in the order of the requests; shards whose result is ``known`` are not run again.

        Two shards per worker are under way, or finished and waiting for their turn: so little is lost at the stop, and
        little is held in memory. Raises `WorkerLostError`: workers died `ATTEMPTS` times on the same shard.
        """
        in_order: deque[_Job] = deque()
        waiting: deque[_Job] = deque()
        while True:
            for request in islice(requests, 2 * self.n_workers + 1 - len(in_order)):
                in_order.append(_Job(request, known(request)))
                if in_order[-1].result is None:
                    waiting.append(in_order[-1])
            if not in_order:
                return
            self._hand_out(waiting)
            while in_order[0].result is None:
                self._collect(waiting)
                self._hand_out(waiting)
            yield in_order.popleft().result  # type: ignore[misc]

    def new_worker(self) -> Any:
        """Another worker beside those that are busy; None as long as none is ready."""
        raise NotImplementedError

    def first_to_answer(self, busy: Sequence[Any]) -> Any:
        """Wait until one of the busy workers has answered or died; None when a new one has become ready instead."""
        raise NotImplementedError

    def _hand_out(self, waiting: deque[_Job]) -> None:
        """Give waiting shards to idle workers, and start new ones up to ``n_workers``."""
        while waiting and len(self._busy) < self.n_workers:
            worker = self._idle.pop() if self._idle else self.new_worker()
            if worker is None:
                return
            if worker.give(waiting[0].request, waiting[0].fatal, waiting[0].alone):
                self._busy[worker] = waiting.popleft()
            else:
                worker.kill()  # it died while it was idle

    def _collect(self, waiting: deque[_Job]) -> None:
        """Take the next answer of a busy worker; the shard of one that died waits again."""
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
        """Find out which test ended a worker, which is then run no more; give up where that remains unknown."""
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
        """Refuse (`TooManyFailedError`) a controller that dies too often: each death costs a new process."""
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
