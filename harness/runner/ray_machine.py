"""What stands in for a run on another machine: a Ray actor with a worker process beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

import ray

from harness.compiled import cache_root, source_hash
from harness.controllers.apart import fit_to_travel
from harness.controllers.black_box import Death
from harness.controllers.loading import require_controller
from harness.records.folder import write_bytes
from harness.resolved import Resolved
from harness.runner.executor import Ended, LocalExecutor, WorkerProcess
from harness.runner.manifest import cpu_name
from harness.runner.worker import Done, Spec

Files = Mapping[str, ray.ObjectRef]
"""Content of files in the object store, by their names below some folder."""


@dataclass(frozen=True)
class Machine:
    """What must be equal on all machines, ``made_of``, and what is said of one."""

    made_of: dict[str, str | None]
    cpu: str

    @classmethod
    def this(cls, resolved: Resolved, controller_sha256: str | None) -> Machine:
        """The one that this runs on."""
        packages = ["harness", *(["libsumo"] if resolved.campaign.world.engine == "sumo" else [])]
        made_of: dict[str, str | None] = {package: metadata.version(package) for package in packages}
        made_of["sources of its kernels"] = source_hash()
        made_of["source of the controller"] = controller_sha256
        return cls(made_of, cpu_name())


class OnMachine:
    """What an actor is: it runs shards in a worker process beside it, and tells how that ended if it did."""

    def __init__(self, resolved: Resolved) -> None:
        self._resolved = resolved
        self._folder = TemporaryDirectory(prefix="harness-shadow-runs-")
        self._executor = LocalExecutor(resolved, Path(self._folder.name), n_workers=1)
        self._worker: WorkerProcess | None = None

    def begin(self, cached: Files) -> Machine | Exception:
        """Fill the cache, and say what there is."""
        try:
            _place(cached, cache_root())
            return Machine.this(self._resolved, require_controller(self._resolved.campaign))
        except Exception as error:  # noqa: BLE001 - whatever goes wrong here is the run's to judge
            return fit_to_travel(error)

    def run(self, spec: Spec, doomed: Mapping[int, Death], shadows: Files) -> Done | Ended | Exception:
        """Run a shard; tests may follow from the ``shadows``, files of the run folder."""
        try:
            _place(shadows, Path(self._folder.name))
            worker = self._worker or self._executor.new_worker(0)
            worker.give(spec, doomed)  # if it is dead, it has no answer either
            answer = self._executor.first_to_answer([worker]).answer()
        except Exception as error:  # noqa: BLE001 - as above
            return fit_to_travel(error)
        self._worker = None if isinstance(answer, Ended) else worker
        return answer

    def close(self) -> None:
        """Let the worker release its controllers."""
        if self._worker is not None:
            self._worker.dismiss()
            self._worker.wait()
        self._executor.close()
        self._folder.cleanup()


def _place(files: Files, folder: Path) -> None:
    for name, content in files.items():
        if not (path := folder / name).exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, ray.get(content))
