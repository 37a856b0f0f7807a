"""Run a replication experiment: repeat the campaign of each vehicle or chain in worker processes, judge, write."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path

import pyarrow as pa

from harness.interruption import leave_signals_to_parent
from harness.progress import Progress, SilentProgress
from harness.records.folder import require_place
from harness.spawning import spawn_context
from harness.studies.experiment import Experiment
from harness.studies.judgement import Judgement, Row, Subject, corrected, judge
from harness.studies.kept_parts import kept_parts
from harness.studies.results import write_results
from harness.studies.subjects import Repeated, subjects

TASKS_PER_SUBJECT = 8


@dataclass(frozen=True)
class ValidationResult:
    """Outcome of an experiment; ``folder`` is where results.json, replications.parquet and the plot are."""

    folder: Path
    subjects: tuple[Subject, ...]
    judgements: tuple[Judgement, ...]


def validate(
    experiment: Experiment,
    folder: Path,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    parts: Path | None = None,
) -> ValidationResult:
    """Repeat, judge, and write the results.

    Parameters
    ----------
    experiment : Experiment
    folder : Path
        Made if it is not there; earlier results in it are replaced.
    workers : int, optional
        Processes; one per core by default. They change no bit.
    progress : Progress, optional
    parts : Path, optional
        Where finished replications of this very experiment are kept, and taken from.
    """
    progress = progress or SilentProgress()
    require_place(folder)
    with worker_processes(workers) as executor:
        tested = list(subjects(experiment, executor, progress))
        rows = [
            _replicate(
                subject.name, repeated, experiment.replications, executor, progress, parts and parts / str(place)
            )
            for place, (subject, repeated) in enumerate(tested)
        ]
    found = [(subject, of_subject) for (subject, _), of_subject in zip(tested, rows, strict=True)]
    judgements = corrected([one for subject, of_subject in found for one in _judge(experiment, subject, of_subject)])
    write_results(folder, experiment, judgements, found)
    return ValidationResult(folder, tuple(subject for subject, _ in found), tuple(judgements))


def _judge(experiment: Experiment, subject: Subject, rows: list[Row]) -> Iterator[Judgement]:
    for result in dict.fromkeys(row.result for row in rows):
        of_result = [row for row in rows if row.result == result]
        yield judge(subject, result, of_result, experiment.nominal)


@contextmanager
def worker_processes(workers: int | None) -> Iterator[ProcessPoolExecutor]:
    """Worker processes that end at once when the work in the parent is interrupted or fails, or it is killed."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = spawn_context()
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


def _replicate(
    name: str,
    repeated: Repeated,
    n: int,
    executor: ProcessPoolExecutor,
    progress: Progress,
    parts: Path | None,
) -> list[Row]:
    size = -(-n // TASKS_PER_SUBJECT)
    jobs = [range(first, min(first + size, n)) for first in range(0, n, size)]
    stage = f"replications of {name}"
    tables = kept_parts(parts, stage, jobs, partial(replications_of, repeated), progress, run=executor.map, size=len)
    return [Row(**row) for table in tables for row in table.to_pylist()]


def replications_of(repeated: Repeated, part: range) -> pa.Table:
    """Rows of some replications."""
    return pa.Table.from_pylist([asdict(row) for row in repeated.run(part)])
