"""The shards of a campaign: taken over from an earlier run, or run by worker processes; handed back in order."""

from __future__ import annotations

import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from multiprocessing.connection import wait
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
from scipy.special import bdtrc

from harness.controllers.apart import LOOK_S, end_process, start_process
from harness.controllers.black_box import OF_EPISODE, Call, Death, last_call
from harness.controllers.time_limit import death_cause
from harness.errors import HarnessError, TooManyFailedError
from harness.records.folder import read_table, shard_files
from harness.records.tables import ShardTables
from harness.resolved import Resolved
from harness.runner.gathered_blocks import GatheredBlocks
from harness.runner.prepare import Prepared
from harness.runner.retrace import Retracing
from harness.runner.worker import Done, ShardDone, ShardSpec, Spec, finished, repeated_of, serve
from harness.spawning import spawn_context

ATTEMPTS = 3
"""A shard whose worker dies is given to another one, this many times in all."""
SURELY_TOO_MANY = 1e-4
"""Probability of so many deaths under the allowed share, below which a controller is refused: with the default share
its third at the earliest, its seventh if it dies in all of 96 cells, some ten seconds into the run."""
SENT_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM)
"""Ends that an operator or a shortage of memory brings: a controller is blamed only when its call is hit again."""
CLOSING_S = 10.0
"""Time that a worker gets to release its controllers once all is done."""
CLOSING_LOOK_S = 0.05


_Spec = TypeVar("_Spec", bound=Spec)
_Done = TypeVar("_Done", bound=Done)


class WorkerLostError(HarnessError):
    """Workers die again and again on the same shard."""

    exit_code = 3


def stored_shard(
    folder: Path, prepared: Prepared, retracing: Retracing, gathered: GatheredBlocks | None, spec: ShardSpec
) -> ShardDone | None:
    """A shard that an earlier run has finished, or None; retraced again, unless it has been ``gathered`` after that.

    Raises
    ------
    RunFolderError
        One of its files is damaged.
    WorldDisagreementError
        The twin retraces an episode differently.
    """
    campaign, prescribed = prepared.campaign, prepared.prescribed
    files = shard_files(folder, spec.index)
    needed = {"episodes"} | ({"moments"} if campaign.records.moments != "none" else set())
    if not needed <= files.keys():
        return None
    if gathered is not None and (taken := gathered.take(spec.index, spec.first_episode, spec.n_episodes, files)):
        repeated = repeated_of(taken.shard.metadata)
        return ShardDone(spec, taken.block, taken.shard.n_retraced, taken.failures, repeated, gathered=True)
    tables = {name: read_table(folder / path) for name, path in files.items()}
    kept = ShardTables(tables["episodes"], tables.get("moments"), tables.get("traces"))
    if kept.episodes.num_rows != spec.n_episodes:
        return None  # the last shard of a smaller budget
    if prescribed is not None:
        cut_ins = kept.episodes.column("pool_cut_in")
        if cut_ins.null_count or not np.array_equal(cut_ins.to_numpy(), prescribed.rows(spec.draws)[0]):
            return None  # the last round of a smaller budget
    return finished(spec, kept, campaign, prescribed, retracing, {})


class WorkerProcess:
    """A process that runs one shard after another, at the end of a pipe of its own."""

    def __init__(self, resolved: Resolved, folder: Path, black_box: Path) -> None:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._black_box = black_box
        self.connection, theirs = spawn_context().Pipe()
        self._process = start_process(serve, theirs, resolved, folder, black_box)
        theirs.close()  # or its death would not end the pipe

    def give(self, spec: Spec, doomed: Mapping[int, Death]) -> bool:
        """Give it a shard to run, with the episodes known to end a process; False if it is dead."""
        try:
            self.connection.send((spec, dict(doomed)))
        except OSError:
            return False
        return True

    def answer(self) -> Done | None:
        """The finished shard, or None if the process has died on it.

        Raises
        ------
        Exception
            Whatever running the shard has raised.
        """
        try:
            answer = self.connection.recv() if self.connection.poll() else None
        except (EOFError, OSError):
            return None
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def kill(self) -> int | None:
        """End it at once, whatever it does; returns its exit code."""
        exit_code = end_process(self._process)
        self.connection.close()
        return exit_code

    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.is_alive()

    def last_call(self) -> Call | None:
        """The controller's call that it is in, or has died in."""
        return last_call(self._black_box)

    def dismiss(self) -> None:
        """Tell an idle worker that nothing more comes: it releases its controllers."""
        self.connection.close()

    def wait(self) -> None:
        """Give a dismissed worker a little time; then end it."""
        until = time.monotonic() + CLOSING_S
        while self.is_alive() and time.monotonic() < until:  # a copy of it may keep open what join() waits for
            self._process.join(CLOSING_LOOK_S)
        self.kill()


def first_to_answer(workers: Sequence[WorkerProcess]) -> WorkerProcess:
    """Wait until one of the workers has answered or died."""
    while True:
        dead = [worker for worker in workers if not worker.is_alive()]
        ready = wait([worker.connection for worker in workers], 0.0 if dead else LOOK_S)
        found = [worker for worker in workers if worker.connection in ready] or dead
        if found:
            return found[0]


@dataclass
class _Job:
    """A shard that is wanted, with its result once there is one."""

    spec: Spec
    done: Done | None
    deaths: int = 0
    suspected: Call | None = None
    doomed: dict[int, Death] = field(default_factory=dict)


class ShardPool:
    """Worker processes that run shards; one that dies takes nothing but its unfinished shard along.

    Everything happens in the caller's thread and each worker has a pipe of its own. So there is no lock that a killed
    process could keep, and no queue that Ctrl-C could leave half filled.
    """

    def __init__(self, resolved: Resolved, folder: Path, workers: int) -> None:
        self._resolved, self._campaign, self._folder = resolved, resolved.campaign, folder
        self._n_workers = workers
        self._black_boxes = TemporaryDirectory(prefix="harness-workers-")
        self._numbers = count()
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
        self._black_boxes.cleanup()

    def run(self, specs: Iterator[_Spec], stored: Callable[[_Spec], _Done | None]) -> Iterator[_Done]:
        """Finished shards in index order; those that ``stored`` knows are not run again.

        Two shards per worker are under way or wait for their turn to be handed back: little is lost at the stop.

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
            yield wanted.popleft().done  # type: ignore[misc]

    def _hand_out(self, waiting: deque[_Job]) -> None:
        """Give waiting shards to idle workers, of which there may be up to as many as were asked for."""
        while waiting and len(self._busy) < self._n_workers:
            worker = self._idle.pop() if self._idle else self._new_worker()
            if worker.give(waiting[0].spec, waiting[0].doomed):
                self._busy[worker] = waiting.popleft()
            else:
                worker.kill()  # it died while it was idle

    def _new_worker(self) -> WorkerProcess:
        return WorkerProcess(self._resolved, self._folder, Path(self._black_boxes.name) / str(next(self._numbers)))

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
