"""Work in parts: by worker processes, and kept, so that what was finished before an interruption is not done again."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from harness.processes import leave_signals_to_parent
from harness.progress import Progress
from harness.records.folder import read_table, write_atomically


def sources_of(*patterns: str) -> str:
    """Hash of sources of these studies."""
    files = sorted(path for pattern in patterns for path in Path(__file__).parents[1].glob(pattern))
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()[:16]


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table of results."""
    write_atomically(path, lambda file: pq.write_table(table, file, compression="zstd"))


@contextmanager
def worker_processes(workers: int | None) -> Iterator[ProcessPoolExecutor]:
    """Worker processes that end at once when the work in the parent is interrupted or fails, or it is killed."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = get_context("spawn")
    watched, held = context.Pipe(duplex=False)
    with ProcessPoolExecutor(
        workers or os.cpu_count(), mp_context=context, initializer=_end_with_parent, initargs=(watched,)
    ) as executor:
        try:
            yield executor
        except BaseException:
            held.close()  # or the executor would wait for minutes of work that nobody wants any more
            raise


def _end_with_parent(watched: Connection) -> None:
    """Let this worker process end when its parent closes the other end of the pipe, or is killed."""
    leave_signals_to_parent()
    parent = parent_process()
    ends = [watched] if parent is None else [watched, parent.sentinel]
    threading.Thread(target=_end_after, args=(ends,), daemon=True).start()


def _end_after(ends: list[Connection | int]) -> None:
    wait(ends)
    os._exit(1)


def kept_parts(
    folder: Path | None,
    name: str,
    jobs: Sequence[Any],
    make: Callable[[Any], pa.Table],
    progress: Progress,
    *,
    run: Callable[..., Any] = map,
    size: Callable[[Any], int] = lambda _job: 1,
) -> list[pa.Table]:
    """Tables of all jobs, in their order.

    Finished ones are kept in a folder that belongs to these very jobs, if there is one. ``run`` is `map`, or that of an
    executor, and ``make`` a function of a module then; ``name`` is that of the stage that is shown, of which a job
    takes ``size`` units.
    """
    places = {} if folder is None else {k: folder / f"{k:05d}.parquet" for k in range(len(jobs))}
    kept = {k: read_table(place) for k, place in places.items() if place.is_file()}
    missing = [k for k in range(len(jobs)) if k not in kept]
    progress.stage(name, sum(map(size, jobs)), done=sum(size(jobs[k]) for k in kept))
    for k, table in zip(missing, run(make, [jobs[k] for k in missing]), strict=True):
        if k in places:
            write_table(places[k], table)
        kept[k] = table
        progress.advance(size(jobs[k]))
    return [kept[k] for k in range(len(jobs))]
