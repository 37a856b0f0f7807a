"""Workers that run shards, whose results are handed back in order; what happens to the shard of one that dies.

Here workers are processes of this machine; `harness.runner.ray` makes those of a cluster.
"""

from __future__ import annotations

import json
import pickle
import signal
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
from scipy.special import bdtrc

from harness.controllers.hosts import Death, death_cause
from harness.errors import HarnessError, TooManyFailedError
from harness.estimators.block import Block
from harness.loop.loop import EpisodeLoop
from harness.processes import (
    CLOSED_PIPE_EXIT_CODE,
    OF_EPISODE,
    Apart,
    Call,
    SharedFile,
    WorkerDeath,
    first_to_answer,
    fork_server,
    tell,
    usable_cpus,
    worker_modules,
)
from harness.records.folder import Repeated, encoded, read_table
from harness.records.schemas import ShardTables, shard_tables
from harness.resolved import Resolved
from harness.runner.again import repeat
from harness.sampling import prepare
from harness.sampling.baseline import BaselineResult, as_recorded, learned_in, run_baseline
from harness.sampling.protocol import ShardRequest, Source
from harness.worlds import build_world

ATTEMPTS = 3
"""A shard whose worker dies is given to another one, this many times in all."""
SURELY_TOO_MANY = 1e-4
"""Probability of so many deaths under the allowed share, below which a controller is refused: with the default share
its third at the earliest, its seventh if it dies in all of 96 cells, some ten seconds into the run."""
SENT_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM)
"""Ends that an operator or a shortage of memory brings: a controller is blamed only when its call is hit again."""
CLOSING_S = 10.0
"""Time that a worker gets to release its controllers once all is done."""
REPEATED = b"harness.repeated"
"""Key in the metadata of an episodes file: what repeating showed is there with the shard, or not at all."""


@dataclass(frozen=True)
class ShardResult:
    """A finished shard: what the stop rule needs of it, and causes of failures.

    ``repeated`` is None where no test was run twice; ``parquet`` are its tables as files. Once they are on disk,
    ``files`` are their paths and ``crc32`` their checksums, by table.
    """

    request: ShardRequest
    block: Block
    failures: Counter[str]
    repeated: Repeated | None
    parquet: dict[str, bytes] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    crc32: dict[str, int] = field(default_factory=dict)


Result = ShardResult | BaselineResult
"""What a worker hands back."""
_Result = TypeVar("_Result", bound=Result)


def serve(connection: Connection, resolved: Path, baseline: Path, black_box: Path) -> None:
    """Prepare with the first shard, run shards until the parent is gone or has no more.

    The file ``resolved`` holds the campaign, ``baseline`` the baseline runs that tests follow from, once there are any.
    """
    runner: ShardRunner | None = None

    def run(request: ShardRequest, fatal_episodes: Mapping[int, Death]) -> Result:
        nonlocal runner
        if runner is None:
            runner = ShardRunner(pickle.loads(resolved.read_bytes()), baseline, black_box)  # noqa: S301 - our own
        return runner.run(request, fatal_episodes)

    with suppress(EOFError, OSError):
        while tell(connection, partial(run, *connection.recv())):
            pass
    if runner is not None:
        runner.close()


class ShardRunner:
    """Runs shards of one campaign in one world. It writes nothing: the process that runs the campaign does.

    The file ``black_box`` tells that process in which call of a controller this one died.
    """

    def __init__(self, resolved: Resolved, baseline: Path, black_box: Path | None = None) -> None:
        self._fatal_episodes: dict[int, Death] = {}
        self._baseline = baseline
        self._source = prepare(resolved)
        self._begun = False
        world = build_world(resolved.campaign)
        self._loop: EpisodeLoop = self._source.loop(world, black_box=black_box, fatal_episodes=self._fatal_episodes)

    def close(self) -> None:
        """Release the AV's controllers."""
        self._loop.close()

    def run(self, request: ShardRequest, fatal_episodes: Mapping[int, Death] | None = None) -> Result:
        """Run a shard; episodes in ``fatal_episodes`` fail before the call that ended a process."""
        self._fatal_episodes.clear()  # a baseline run may have the number of a test
        self._fatal_episodes.update(fatal_episodes or {})
        source, paths = self._source, self._source.baseline_paths
        if paths is not None and request.baseline:
            return run_baseline(self._loop, paths, source.resolved, request)
        if paths is not None and not self._begun:
            self._begun = True
            table = read_table(self._baseline)
            source.begin_after(as_recorded(table, source.scenario.max_steps), learned_in(table))
            self._loop = self._loop.beside()
        return self._tests(request)

    def _tests(self, request: ShardRequest) -> ShardResult:
        campaign, shard = self._source.campaign, self._source.run(self._loop, request)
        keep_traces = campaign.records.traces != "none" or campaign.records.trace_share > 0.0
        tables = shard_tables(shard, campaign.seed, keep_traces=keep_traces)
        # A vehicle must show that it does the same again: built-in models do, and outside programs need not.
        if request.index == 0 and campaign.av.model is None and campaign.av.traci is None:
            tables = tables._replace(episodes=with_repeated(tables.episodes, repeat(self._loop, self._source, shard)))
        return replace(finished(self._source, request, tables), parquet=encoded(tables))


def finished(source: Source, request: ShardRequest, tables: ShardTables) -> ShardResult:
    """What is to be known of a shard's tables."""
    block = source.block(tables.episodes)
    failures = Counter(tables.episodes.column("failure").drop_null().to_pylist())
    return ShardResult(request, block, failures, repeated_of(tables.episodes))


def with_repeated(episodes: pa.Table, repeated: Repeated) -> pa.Table:
    """The table of the first shard, with what repeating has shown."""
    return episodes.replace_schema_metadata(
        {**(episodes.schema.metadata or {}), REPEATED: json.dumps(asdict(repeated))}
    )


def repeated_of(episodes: pa.Table) -> Repeated | None:
    """What an episodes table says of tests that were run twice; None of all but the first shard's."""
    found = (episodes.schema.metadata or {}).get(REPEATED)
    return None if found is None else Repeated(**json.loads(found))


class WorkerLostError(HarnessError):
    """Workers die again and again, on the same shard or before they have one."""

    exit_code = 3


class WorkerProcess(Apart):
    """A process that runs one shard after another: what any worker is, also one on another machine."""

    def give(self, request: ShardRequest, fatal_episodes: Mapping[int, Death]) -> bool:
        """Give it a shard to run, with the episodes known to end a process; False if it is dead."""
        try:
            self.connection.send((request, dict(fatal_episodes)))
        except OSError:
            return False
        return True

    def dismiss(self) -> None:
        """Tell it, when it is idle, that nothing more comes: it releases its controllers."""
        self.connection.close()


@dataclass
class _Job:
    """A shard that is wanted, with its result once there is one."""

    request: ShardRequest
    result: Result | None
    n_deaths: int = 0
    suspected: Call | None = None
    fatal_episodes: dict[int, Death] = field(default_factory=dict)


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

    def cpus(self) -> set[str]:
        """Names of the processors of other machines that have worked: bits are promised for one family."""
        return set()

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
            if worker.give(waiting[0].request, waiting[0].fatal_episodes):
                self._busy[worker] = waiting.popleft()
            else:
                worker.kill()  # it died while it was idle

    def _collect(self, waiting: deque[_Job]) -> None:
        """Wait for one worker to finish its shard, or to die on it."""
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
        call = death.call
        first_time = call != job.suspected
        job.suspected = call
        cause = death_cause(death.exit_code, self._campaign.av.limits, call)
        own = call is not None and not (death.exit_code in SENT_FROM_OUTSIDE and first_time)  # the controller's own
        own |= death.exit_code == CLOSED_PIPE_EXIT_CODE
        if own and call is not None and call.kind == OF_EPISODE:
            job.fatal_episodes[call.episode] = Death(call.step, cause)
            self._require_few_deaths(job)
            return
        job.n_deaths += 1
        if job.n_deaths == ATTEMPTS:
            how = f"with {'its machine' if death.exit_code is None else f'exit code {death.exit_code}'}"
            mend = "Look for a memory limit (fewer --workers), then continue with --resume."
            if own:
                how = f"because {cause}" + ("" if call is None else f", in {call}")
                mend = "Mend the controller: look for os._exit or a crash of compiled code (`harness av-check`)."
            raise WorkerLostError(
                f"shard {job.request.index} (from episode {job.request.first_episode})",
                f"{ATTEMPTS} worker processes that died, the last {how}",
                "a worker that finishes the shard",
                mend,
            )

    def _require_few_deaths(self, job: _Job) -> None:
        """Each death costs a new process: a controller that dies too often is not run to the end of its shard."""
        share, fatal = self._campaign.run.max_failed_share, job.fatal_episodes
        episode, death = next(reversed(fatal.items()))
        n_begun = max(fatal) - job.request.first_episode + 1
        if float(bdtrc(len(fatal) - 1, n_begun, share)) < SURELY_TOO_MANY:
            raise TooManyFailedError(
                "run.max_failed_share",
                f"{len(fatal)} of the first {n_begun} episodes of shard {job.request.index} ended their worker "
                f"process, the last of them episode {episode}: {death.cause}",
                f"a share of at most {share:g}",
                "Mend the controller (`harness av-check` looks at it in seconds), or raise the share to go on.",
            )


class LocalWorkers(Workers):
    """Processes of this machine, each started when it is first needed."""

    def __init__(self, resolved: Resolved, n_workers: int | None) -> None:
        n_cpus = usable_cpus()
        super().__init__(resolved, n_workers or n_cpus)
        if self.n_workers > n_cpus:
            sys.stderr.write(f"note: {self.n_workers} workers share the {n_cpus} CPUs that this process may use.\n")
        # As a file: what a pipe cannot hold is waited for until the new process has imported all that it needs.
        self._resolved, self._baseline = SharedFile(pickle.dumps(resolved)), SharedFile()
        self._server = fork_server(*worker_modules(resolved.campaign.world.engine))

    def new_worker(self) -> WorkerProcess:
        return WorkerProcess(self._server, serve, self._resolved.path, self._baseline.path)

    def follow_from(self, baseline: bytes) -> None:
        self._baseline.path.write_bytes(baseline)

    def first_to_answer(self, busy: Sequence[WorkerProcess]) -> WorkerProcess:
        return first_to_answer(busy)

    def close(self) -> None:
        super().close()
        self._server.close()
