"""Work in parts by worker processes, and what identifies the code that does it."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa

from harness.processes import leave_signals_to_parent
from harness.progress import Progress
from harness.records.folder import parquet, write_bytes

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


def sources_of(*patterns: str) -> str:
    """Hash of sources of these studies."""
    files = sorted(path for pattern in patterns for path in Path(__file__).parent.glob(pattern))
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()[:16]


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table of results."""
    write_bytes(path, parquet(table))


@contextmanager
def worker_processes(workers: int | None) -> Iterator[ProcessPoolExecutor]:
    """Worker processes that end at once when the work in the parent is interrupted or fails, or it is killed."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = get_context("spawn")
    with ProcessPoolExecutor(workers or os.cpu_count(), mp_context=context, initializer=_end_with_parent) as executor:
        try:
            yield executor
        except BaseException:
            for worker in active_children():  # or the executor would wait for minutes of work that nobody wants
                worker.kill()  # nothing less ends one that is in a kernel, which holds the interpreter lock
            raise


def _end_with_parent() -> None:
    """Let this worker process end when its parent is killed."""
    leave_signals_to_parent()
    parent: Any = parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def results_of(
    name: str, jobs: Sequence[_Job], make: Callable[[_Job], _Result], progress: Progress, executor: Executor
) -> list[_Result]:
    """Results of all jobs in their order, by a function of a module; ``name`` is that of the stage that is shown."""
    progress.stage(name, len(jobs))
    results = []
    for result in executor.map(make, jobs):
        results.append(result)
        progress.advance(1)
    return results
