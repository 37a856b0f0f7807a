"""Workers on the machines of a Ray cluster (extra ``harness[ray]``).

On each machine actors stand in for the run (`harness.runner.ray_machine`). Shards come back as encoded Parquet, and are
written by the run alone. Pools and tables lie once in each machine's part of the object store, and from there in its
cache.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ray
from ray.exceptions import RayError, RayTaskError, RuntimeEnvSetupError
from ray.runtime_env import RuntimeEnv

from harness.campaign.sections import RaySettings
from harness.compiled import cache_root
from harness.controllers.black_box import Death
from harness.errors import CampaignError, HarnessError
from harness.interruption import FROM_USER
from harness.resolved import Resolved
from harness.runner.executor import CLOSING_S, Ended
from harness.runner.prepare import cached_files
from harness.runner.ray_machine import Files, Machine, OnMachine
from harness.runner.shadow_runs import SHADOW
from harness.runner.shard_pool import WorkerLostError
from harness.runner.worker import Done, ShardSpec, Spec

LOCAL = "local"
"""Ray's word for a cluster of this machine alone, which ends with the run."""
LOOK_S = 1.0
PATIENCE_S = 30.0
"""After this time without any worker the user is told what is waited for."""
ANSWER_S = 10.0
"""Time in which a cluster has to answer."""
STARTS = 3
"""As many workers in a row may be lost before they are ready."""


class RayWorker:
    """An actor, seen from the run; ``pending`` is what it is asked for."""

    def __init__(self, actor: Any, pending: ray.ObjectRef[Any], executor: RayExecutor) -> None:
        self._actor, self.pending, self._executor = actor, pending, executor

    def give(self, spec: Spec, doomed: Mapping[int, Death]) -> bool:
        """See `harness.runner.executor.Worker`: that it is dead shows in its answer."""
        self.pending = self._actor.run.remote(spec, dict(doomed), self._executor.shadows(spec))
        return True

    def answer(self) -> Done | Ended:
        """See `harness.runner.executor.Worker`."""
        answer = self.result()
        if isinstance(answer, Ended):
            self._executor.take_back(self)  # its actor lives, and will start another process
        elif answer is None:
            self.kill()  # it may live, where it cannot be reached
        return answer or Ended(None, None)

    def result(self) -> Any:
        """What it was asked for; None if it is lost."""
        try:
            found = ray.get(self.pending)
        except (RayTaskError, RuntimeEnvSetupError):
            raise
        except RayError:
            return None
        if isinstance(found, Exception):
            raise found
        return found

    def kill(self) -> None:
        """See `harness.runner.executor.Worker`; its process follows it at once."""
        ray.kill(self._actor)

    def dismiss(self) -> None:
        """See `harness.runner.executor.Worker`."""
        self.pending = self._actor.close.remote()

    def wait(self) -> None:
        """See `harness.runner.executor.Worker`."""
        ray.wait([self.pending], timeout=2.0 * CLOSING_S)
        self.kill()


class RayExecutor:
    """Starts an actor for each worker, as far as the cluster has room, and others for those that it loses.

    ``n_runs`` such runs share the machines: their workers take turns.

    Raises
    ------
    HarnessError
        There is no such cluster, or it has no room for one worker.
    """

    def __init__(self, resolved: Resolved, folder: Path, n_workers: int | None, *, n_runs: int = 1) -> None:
        self._folder = folder
        self._settings = settings = resolved.campaign.run.ray
        address = settings.address or os.environ.get("RAY_ADDRESS") or LOCAL
        environment = _runtime_env(settings)
        if is_ours := not ray.is_initialized():
            _connect(address, environment)
        self._is_ours = is_ours
        self._here = Machine.this(resolved, resolved.controller_sha256)
        self._there: set[str] = set()
        self._starting: list[RayWorker] = []
        self._ready: list[RayWorker] = []
        try:
            self.n_workers = n_workers or _room(settings)
        except HarnessError:
            self.close()
            raise
        n_machines = sum(node["Alive"] for node in ray.nodes())
        self.where = f" on {n_machines} machine{'s' * (n_machines > 1)} at {address}"
        self._lost_at_start = 0
        self._told = False
        self._since = time.monotonic()
        self._shadows: Files | None = None
        self._content = ray.put(resolved)
        self._cached = {} if address == LOCAL else _stored(cached_files(resolved), cache_root())
        self._actor_class = ray.remote(OnMachine).options(
            num_cpus=settings.resources.cpus / n_runs,
            num_gpus=settings.resources.gpus / n_runs,
            runtime_env=None if is_ours else environment,  # of ours it is the whole job's
        )

    def cpus(self) -> set[str]:
        """See `harness.runner.executor.Executor`."""
        return self._there

    def shadows(self, spec: Spec) -> Files:
        """Shadow runs that tests follow from: they have all been written before the first test."""
        if not isinstance(spec, ShardSpec):
            return {}
        if self._shadows is None:
            self._shadows = _stored(sorted((self._folder / SHADOW).glob("*.parquet")), self._folder)
        return self._shadows

    def new_worker(self, n_there: int) -> RayWorker | None:
        """See `harness.runner.executor.Executor`."""
        while n_there + len(self._ready) + len(self._starting) < self.n_workers:
            actor = self._actor_class.remote(self._content)
            self._starting.append(RayWorker(actor, actor.begin.remote(self._cached), self))
        return self._ready.pop() if self._ready else None

    def first_to_answer(self, busy: Sequence[RayWorker]) -> RayWorker | None:
        """See `harness.runner.executor.Executor`."""
        waited_for = {worker.pending: worker for worker in [*busy, *self._starting]}
        while not (answered := ray.wait(list(waited_for), num_returns=1, timeout=LOOK_S)[0]):
            if not busy:
                self._tell_of_waiting()
        worker = waited_for[answered[0]]
        if worker not in self._starting:
            return worker
        self._starting.remove(worker)
        self._admit(worker)
        return None

    def take_back(self, worker: RayWorker) -> None:
        """Keep a worker for another shard."""
        self._ready.append(worker)

    def _admit(self, worker: RayWorker) -> None:
        """Let a worker in that is ready, if it is one of ours."""
        try:
            machine: Machine | None = worker.result()
        except RuntimeEnvSetupError as error:
            raise _wrong_environment(error) from error
        if machine is None:
            self._lost_at_start += 1
            if self._lost_at_start == STARTS:
                raise WorkerLostError(
                    "run.executor",
                    found=f"{STARTS} workers in a row that were lost while they began",
                    expected="machines on which the harness starts",
                    mend="Install the same harness on all of them, and look at Ray's logs there (/tmp/ray).",
                )
            return
        for what, here in self._here.made_of.items():
            if (there := machine.made_of.get(what)) != here:
                raise HarnessError(
                    "run.executor",
                    found=f"a machine with {what} {there}",
                    expected=f"{here}, as here: all must run the same code",
                    mend="Install the same versions everywhere; bring a controller along in run.ray.runtime_env "
                    "(working_dir), or install its package on all machines.",
                )
        self._lost_at_start = 0
        self._there.add(machine.cpu)
        self._ready.append(worker)

    def _tell_of_waiting(self) -> None:
        if not self._told and time.monotonic() - self._since > PATIENCE_S:
            self._told = True
            wanted = self._settings.resources
            sys.stderr.write(  # nothing is wrong yet: machines may come
                f"waiting for {wanted.cpus:g} CPUs and {wanted.gpus:g} GPUs of one machine; free are "
                f"{_said(ray.available_resources())} of {_said(ray.cluster_resources())} in all\n"
            )

    def close(self) -> None:
        """See `harness.runner.executor.Executor`."""
        for worker in [*self._starting, *self._ready]:
            worker.kill()
        if self._is_ours:
            ray.shutdown()


def _runtime_env(settings: RaySettings) -> dict[str, Any] | None:
    try:
        return dict(RuntimeEnv(**settings.runtime_env)) or None
    except (TypeError, ValueError) as error:
        raise _wrong_environment(error) from error


def _wrong_environment(error: Exception) -> CampaignError:
    return CampaignError(
        "run.ray.runtime_env",
        found=f"an environment that Ray cannot set up: {error}",
        expected="what ray.init takes as runtime_env",
        mend="Correct it; docs/ray.md has an example.",
    )


def _connect(address: str, environment: dict[str, Any] | None) -> None:
    """Begin to use a cluster; signals stay the harness's own."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in FROM_USER} if in_main_thread else {}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ours: dict[str, Any] = {"include_dashboard": False} if address == LOCAL else {}
    ended_by: int | None = None
    try:
        _require_answer(address)
        ray.init(address=address, logging_level=logging.ERROR, runtime_env=environment, **ours)
    except SystemExit as error:  # Ray's own answer to SIGTERM, while it connects
        ended_by = int(error.code or 0)
    except (RayError, OSError, RuntimeError, ValueError) as error:
        raise HarnessError(
            "run.ray.address",
            found=f"{address}: {error}",
            expected="the address of a Ray cluster whose machines have the same versions of Ray and Python, and "
            "the same RAY_AUTH_MODE and RAY_AUTH_TOKEN",
            mend="Start it with `ray start --head` and give its address, such as 10.0.0.1:6379, or none for a cluster "
            "of this machine.",
        ) from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if ended_by is not None:
        signal.raise_signal(ended_by)


def _require_answer(address: str) -> None:
    """Raise an OSError where nobody listens: Ray itself would wait for minutes, without a word."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_S).close()


def _room(settings: RaySettings) -> int:
    """How many workers the cluster has room for."""
    have, want = ray.cluster_resources(), settings.resources
    room = [have.get(name, 0.0) / n for name, n in (("CPU", want.cpus), ("GPU", want.gpus)) if n > 0.0]
    n = int(min(room, default=float(os.cpu_count() or 1)))
    if n == 0:
        raise HarnessError(
            "run.ray.resources",
            found=f"a cluster of {_said(have)}",
            expected=f"room for one worker: {want.cpus:g} CPUs and {want.gpus:g} GPUs on one machine",
            mend="Ask for less, or give --workers if machines are to come later.",
        )
    return n


def _said(resources: Mapping[str, float]) -> str:
    return f"{resources.get('CPU', 0.0):g} CPUs and {resources.get('GPU', 0.0):g} GPUs"


def _stored(paths: Sequence[Path], folder: Path) -> Files:
    """Put files into the object store."""
    return {str(path.relative_to(folder)): ray.put(np.fromfile(path, np.uint8)) for path in paths}
