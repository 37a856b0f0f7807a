"""Workers that run shards, whose results are handed back in order; what happens to the shard of one that dies."""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Generic, TypeVar

from scipy.special import bdtrc

from harness.campaign.campaign import Campaign
from harness.controllers.black_box import OF_EPISODE, Call, Death
from harness.controllers.guard import death_cause
from harness.errors import CampaignError, HarnessError, TooManyFailedError
from harness.resolved import Resolved
from harness.runner.executor import AnyWorker, Ended, Executor, LocalExecutor
from harness.runner.worker import Done, Spec

ATTEMPTS = 3
"""A shard whose worker dies is given to another one, this many times in all."""
SURELY_TOO_MANY = 1e-4
"""Probability of so many deaths under the allowed share, below which a controller is refused: with the default share
its third at the earliest, its seventh if it dies in all of 96 cells, some ten seconds into the run."""
SENT_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM)
"""Ends that an operator or a shortage of memory brings: a controller is blamed only when its call is hit again."""

_Spec = TypeVar("_Spec", bound=Spec)
_Done = TypeVar("_Done", bound=Done)


class WorkerLostError(HarnessError):
    """Workers die again and again, on the same shard or before they have one."""

    exit_code = 3


def executor_of(resolved: Resolved, folder: Path, n_workers: int | None, *, n_runs: int = 1) -> Executor[Any]:
    """Where a campaign's shards are run; ``n_runs`` campaigns share it and take turns.

    Raises
    ------
    HarnessError
        The package, the cluster or room in it is missing.
    """
    if resolved.campaign.run.executor == "local":
        return LocalExecutor(resolved, folder, n_workers or os.cpu_count() or 1)
    try:
        from harness.runner.ray_executor import RayExecutor  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise CampaignError(
            "run.executor",
            found="ray, but no package ray",
            expected="the extra for clusters",
            mend="Install it here and on all machines of the cluster: pip install 'harness[ray]'.",
        ) from error
    return RayExecutor(resolved, folder, n_workers, n_runs=n_runs)


@dataclass
class _Job:
    """A shard that is wanted, with its result once there is one."""

    spec: Spec
    done: Done | None
    deaths: int = 0
    suspected: Call | None = None
    doomed: dict[int, Death] = field(default_factory=dict)


class ShardPool(Generic[AnyWorker]):
    """Workers that run shards; one that dies takes nothing but its unfinished shard along.

    Everything happens in the caller's thread, and no two workers share anything. So there is no lock that a killed one
    could keep, and no queue that Ctrl-C could leave half filled.
    """

    def __init__(self, campaign: Campaign, executor: Executor[AnyWorker]) -> None:
        self._campaign, self._executor = campaign, executor
        self._idle: list[AnyWorker] = []
        self._busy: dict[AnyWorker, _Job] = {}

    def close(self) -> None:
        """Stop all workers, finished or not; those that are idle may release their controllers first."""
        for worker in self._busy:
            worker.kill()
        for worker in self._idle:
            worker.dismiss()
        for worker in self._idle:
            worker.wait()
        self._idle, self._busy = [], {}
        self._executor.close()

    def run(self, specs: Iterator[_Spec], stored: Callable[[_Spec], _Done | None]) -> Iterator[_Done]:
        """Finished shards in index order; those that ``stored`` knows are not run again.

        Two shards per worker are under way or wait for their turn to be handed back: little is lost at the stop, and
        little is held in memory.

        Raises
        ------
        WorkerLostError
            Workers died `ATTEMPTS` times on the same shard.
        """
        wanted: deque[_Job] = deque()
        waiting: deque[_Job] = deque()
        while True:
            for spec in islice(specs, 2 * self._executor.n_workers + 1 - len(wanted)):
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
        while waiting and len(self._busy) < self._executor.n_workers:
            worker = self._idle.pop() if self._idle else self._executor.new_worker(len(self._busy))
            if worker is None:
                return
            if worker.give(waiting[0].spec, waiting[0].doomed):
                self._busy[worker] = waiting.popleft()
            else:
                worker.kill()  # it died while it was idle

    def _collect(self, waiting: deque[_Job]) -> None:
        """Wait for one worker to finish its shard, or to die on it."""
        worker = self._executor.first_to_answer(list(self._busy))
        if worker is None:
            return
        job = self._busy[worker]
        answer = worker.answer()
        del self._busy[worker]
        if not isinstance(answer, Ended):
            job.done = answer
            self._idle.append(worker)
            return
        waiting.appendleft(job)
        self._blame(job, answer)

    def _blame(self, job: _Job, ended: Ended) -> None:
        """Say whose doing the death of a worker was: a test's that is run no more, or nobody's knows."""
        call = ended.call
        first_time = call != job.suspected
        job.suspected = call
        cause = death_cause(ended.exit_code, self._campaign.av.limits.step_time_s)
        own = call is not None and not (ended.exit_code in SENT_FROM_OUTSIDE and first_time)  # the controller's own
        if own and call is not None and call.kind == OF_EPISODE:
            job.doomed[call.episode] = Death(call.step, cause)
            self._require_few_deaths(job)
            return
        job.deaths += 1
        if job.deaths == ATTEMPTS:
            raise self._lost(job, ended.exit_code, f"{cause}, in {call}" if own else None)

    def _lost(self, job: _Job, exit_code: int | None, blamed: str | None) -> WorkerLostError:
        """What to say of a shard that no worker survives; ``blamed`` is what the controller did, if it did."""
        found = f"{ATTEMPTS} worker processes that died, the last " + (
            f"because {blamed}"
            if blamed
            else f"with {'its machine' if exit_code is None else f'exit code {exit_code}'}"
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
