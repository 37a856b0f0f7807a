"""Work in parts that are kept: what was finished before an interruption is not done again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from harness.progress import Progress
from harness.records.folder import read_table, write_atomically


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table of results."""
    write_atomically(path, lambda file: pq.write_table(table, file, compression="zstd"))


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

    Parameters
    ----------
    folder : Path or None
        Where finished ones are kept; it belongs to these very jobs. None: nowhere.
    name : str
        Of the stage that is shown.
    jobs : sequence
    make : callable
        Makes the table of one of them; a function of the module, where ``run`` is an executor's.
    progress : Progress
    run : callable
        `map`, or that of an executor.
    size : callable
        Units of a job for the progress.
    """
    places = [None if folder is None else folder / f"{k:05d}.parquet" for k in range(len(jobs))]
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    kept = {k: read_table(place) for k, place in enumerate(places) if place is not None and place.is_file()}
    missing = [k for k in range(len(jobs)) if k not in kept]
    progress.stage(name, sum(map(size, jobs)), done=sum(size(jobs[k]) for k in kept))
    for k, table in zip(missing, run(make, [jobs[k] for k in missing]), strict=True):
        if (place := places[k]) is not None:
            write_table(place, table)
        kept[k] = table
        progress.advance(size(jobs[k]))
    return [kept[k] for k in range(len(jobs))]
