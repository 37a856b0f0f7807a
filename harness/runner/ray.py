"""Workers on the machines of a Ray cluster (extra ``harness[ray]``).

On each machine an actor stands in for the run, with a worker process beside it. Shards come back as encoded Parquet,
and are written by the run alone. Pools and tables lie once in each machine's part of the object store, and from there
in its cache.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import numpy as np
import ray
from ray.exceptions import RayError, RayTaskError, RuntimeEnvSetupError
from ray.runtime_env import RuntimeEnv

from harness import cache
from harness.campaign.sections import RaySettings
from harness.compiled import source_hash
from harness.controllers.find import require_controller
from harness.errors import CampaignError, HarnessError
from harness.processes import Child, WorkerDeath, fit_to_travel, usable_cpus
from harness.resolved import Resolved
from harness.runner.workers import CLOSING_S, LocalWorkers, Result, WorkerLostError, Workers
from harness.sampling import source_of
from harness.signals import handlers_restored

LOCAL = "local"
"""Ray's word for a cluster of this machine alone, which ends with the run."""
LOOK_S = 1.0
ANSWER_S = 10.0
"""Time in which a cluster has to answer."""
STARTS = 3
"""As many workers in a row may be lost before they are ready."""

Files = Mapping[str, ray.ObjectRef]
"""Content of files in the object store, by their names below the cache."""


# -- on another machine --


def this_machine(resolved: Resolved, controller_sha256: str | None) -> dict[str, str | None]:
    """Versions and hashes of sources, which must be equal on all machines."""
    packages = ["harness", *(["libsumo"] if resolved.campaign.world.engine == "sumo" else [])]
    versions = {package: metadata.version(package) for package in packages}
    sources = {"sources of its kernels": source_hash(), "source of the controller": controller_sha256}
    return {**versions, **sources}


class OnMachine:
    """An actor: it runs shards in a worker process beside it, and returns errors, which the run judges."""

    def __init__(self, resolved: Resolved) -> None:
        self._resolved = resolved
        self._workers = LocalWorkers(resolved, 1)
        self._worker: Child | None = None
        self._follows = False

    def begin(self, cached: Files) -> dict[str, str | None] | Exception:
        """Fill the cache; returns `this_machine`."""
        try:
            for name, content in cached.items():
                if cache.find(name) is None:
                    cache.keep(name, ray.get(content).data)
            return this_machine(self._resolved, require_controller(self._resolved.campaign.av))
        except Exception as error:  # noqa: BLE001 - see the class
            return fit_to_travel(error)

    def run(self, work: tuple[Any, ...], baseline: Sequence[ray.ObjectRef[bytes]]) -> Result | WorkerDeath | Exception:
        """Run a shard; tests may follow from ``baseline`` runs, which lie in the object store."""
        try:
            if baseline and not self._follows:
                self._workers.follow_from(ray.get(baseline[0]))
                self._follows = True
            worker = self._worker or self._workers.new_worker()
            worker.give(*work)  # if it is dead, it has no answer either
            answer: Result | WorkerDeath = self._workers.first_to_answer([worker]).answer()
        except Exception as error:  # noqa: BLE001 - see the class
            return fit_to_travel(error)
        self._worker = None if isinstance(answer, WorkerDeath) else worker
        return answer

    def close(self) -> None:
        """Let the worker release its controllers."""
        if self._worker is not None:
            self._worker.dismiss()
            self._worker.wait(CLOSING_S)
        self._workers.close()


# -- where the run is --


class RayWorker:
    """An actor, as the run's counterpart of a `Child`; ``pending`` is its answer to come."""

    def __init__(self, actor: Any, pending: ray.ObjectRef[Any], workers: RayWorkers) -> None:
        self._actor, self.pending, self._workers = actor, pending, workers

    def give(self, *work: Any) -> bool:
        # If the actor is dead, its answer says so.
        self.pending = self._actor.run.remote(work, self._workers.baseline)
        return True

    def answer(self) -> Result | WorkerDeath:
        answer = self.result()
        if isinstance(answer, WorkerDeath):
            self._workers.ready.append(self)  # its actor lives, and will start another process
        elif answer is None:
            self.kill()  # it may still run where it cannot be reached
        return answer or WorkerDeath(None, None)

    def result(self) -> Any:
        """The pending answer; None if the actor is lost."""
        try:
            result = ray.get(self.pending)
        except (RayTaskError, RuntimeEnvSetupError):
            raise
        except RayError:
            return None
        if isinstance(result, Exception):
            raise result
        return result

    def kill(self) -> None:
        ray.kill(self._actor)  # its process follows it at once

    def dismiss(self) -> None:
        self.pending = self._actor.close.remote()

    def wait(self, seconds: float) -> None:
        ray.wait([self.pending], timeout=2.0 * seconds)
        self.kill()


class RayWorkers(Workers):
    """Starts an actor for each worker, as far as the cluster has room, and another for each that is lost.

    ``n_runs`` such runs share the machines: their workers take turns. Raises a `HarnessError` where there is no such
    cluster, or no room in it for one worker.
    """

    def __init__(self, resolved: Resolved, n_workers: int | None, *, n_runs: int = 1) -> None:
        self._settings = settings = resolved.campaign.run.ray
        address = settings.address or os.environ.get("RAY_ADDRESS") or LOCAL
        environment = _runtime_env(settings)
        if is_ours := not ray.is_initialized():
            _connect(address, environment)
        self._is_ours = is_ours
        try:
            super().__init__(resolved, n_workers or _room(settings))
        except HarnessError:
            self._disconnect()
            raise
        n_machines = sum(node["Alive"] for node in ray.nodes())
        self.where = f" on {n_machines} machine{'s' * (n_machines > 1)} at {address}"
        self.ready: list[RayWorker] = []
        self._starting: list[RayWorker] = []
        self._here = this_machine(resolved, resolved.controller_sha256)
        self._lost_at_start = 0
        self.baseline: list[ray.ObjectRef[bytes]] = []
        """Baseline runs, once all are made."""
        self._content = ray.put(resolved)
        names = [] if address == LOCAL else source_of(resolved.campaign).cached_files(resolved)
        files = {name: cache.read(name) for name in names}
        self._cached = {name: ray.put(np.frombuffer(file, np.uint8)) for name, file in files.items() if file}
        self._actor_class = ray.remote(OnMachine).options(
            num_cpus=settings.resources.cpus / n_runs,
            num_gpus=settings.resources.gpus / n_runs,
            runtime_env=None if is_ours else environment,  # of ours it is the whole job's
        )

    def follow_from(self, baseline: bytes) -> None:
        self.baseline = [ray.put(baseline)]

    def new_worker(self) -> RayWorker | None:
        while len(self._busy) + len(self.ready) + len(self._starting) < self.n_workers:
            actor = self._actor_class.remote(self._content)
            self._starting.append(RayWorker(actor, actor.begin.remote(self._cached), self))
        return self.ready.pop() if self.ready else None

    def first_to_answer(self, busy: Sequence[RayWorker]) -> RayWorker | None:
        pending = {worker.pending: worker for worker in [*busy, *self._starting]}
        while not (answered := ray.wait(list(pending), num_returns=1, timeout=LOOK_S)[0]):
            pass  # between waits, signals are handled
        worker = pending[answered[0]]
        if worker not in self._starting:
            return worker
        self._starting.remove(worker)
        self._admit(worker)
        return None

    def _admit(self, worker: RayWorker) -> None:
        try:
            machine = worker.result()
        except RuntimeEnvSetupError as error:
            raise _wrong_environment(error) from error
        if machine is None:
            self._lost_at_start += 1
            if self._lost_at_start == STARTS:
                found, expected = f"{STARTS} workers in a row, lost while they began", "machines on which it starts"
                mend = "Install the same harness on all of them, and look at Ray's logs there (/tmp/ray)."
                raise WorkerLostError("run.executor", found, expected, mend)
            return
        for what, here in self._here.items():
            if (there := machine.get(what)) != here:
                expected = f"{here}, as here: all must run the same code"
                mend = "Install the same versions everywhere; bring a controller along in run.ray.runtime_env "
                mend += "(working_dir), or install its package on all machines."
                raise HarnessError("run.executor", f"a machine with {what} {there}", expected, mend)
        self._lost_at_start = 0
        self.ready.append(worker)

    def close(self) -> None:
        super().close()
        for worker in [*self._starting, *self.ready]:
            worker.kill()
        self._disconnect()

    def _disconnect(self) -> None:
        if self._is_ours:
            ray.shutdown()


def _runtime_env(settings: RaySettings) -> dict[str, Any] | None:
    try:
        return dict(RuntimeEnv(**settings.runtime_env)) or None
    except (TypeError, ValueError) as error:
        raise _wrong_environment(error) from error


def _wrong_environment(error: Exception) -> CampaignError:
    found, mend = f"an environment that Ray cannot set up: {error}", "Correct it; docs/installation.md has an example."
    return CampaignError("run.ray.runtime_env", found, "what ray.init takes as runtime_env", mend)


def _connect(address: str, environment: dict[str, Any] | None) -> None:
    """Begin to use a cluster; signals stay the harness's own."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ours: dict[str, Any] = {"include_dashboard": False} if address == LOCAL else {}
    try:
        with handlers_restored():
            _require_answer(address)
            ray.init(address=address, logging_level=logging.ERROR, runtime_env=environment, **ours)
    except (RayError, OSError, RuntimeError, ValueError) as error:
        expected = "a Ray cluster of the same versions of Ray and Python, RAY_AUTH_MODE and RAY_AUTH_TOKEN"
        mend = "Start it with `ray start --head` and give its address, such as 10.0.0.1:6379, or none for this machine."
        raise HarnessError("run.ray.address", f"{address}: {error}", expected, mend) from error


def _require_answer(address: str) -> None:
    """Raise an OSError where nobody listens: Ray itself would wait for minutes, without a word."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_S).close()


def _room(settings: RaySettings) -> int:
    """Workers that the cluster has room for."""
    wanted = settings.resources
    cpus, gpus = (float(ray.cluster_resources().get(name, 0.0)) for name in ("CPU", "GPU"))
    room = [have / want for have, want in ((cpus, wanted.cpus), (gpus, wanted.gpus)) if want > 0.0]
    n = int(min(room, default=float(usable_cpus())))
    if n == 0:
        expected = f"room for one worker: {wanted.cpus:g} CPUs and {wanted.gpus:g} GPUs on one machine"
        mend = "Ask for less, or give --workers if machines are to come later."
        raise HarnessError("run.ray.resources", f"a cluster of {cpus:g} CPUs and {gpus:g} GPUs", expected, mend)
    return n
