"""Run a replication experiment: repeat the campaign of each vehicle or chain in worker processes, judge, write."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path

from harness.environment.loading import load_environment
from harness.interruption import leave_signals_to_parent
from harness.pool.library import load_library
from harness.progress import Progress, SilentProgress
from harness.records.folder import require_place
from harness.spawning import spawn_context
from harness.strata import LIBRARY_STATEMENT
from harness.studies.chains.named import CHAINS
from harness.studies.chains.shells import ChainShells
from harness.studies.experiment import Experiment
from harness.studies.judgement import Judgement, Row, Subject, corrected, judge
from harness.studies.results import write_results
from harness.studies.shell_campaign import ShellCampaign, result_of
from harness.studies.shell_source import OvertakingShells, overtaking_shells
from harness.studies.super_population import Drivers, Truth, enumerate_paths, truths
from harness.studies.weighted_campaign import ChainEpisodes, TwinEpisodes, WeightedCampaign

TASKS_PER_SUBJECT = 8

Repeated = ShellCampaign | WeightedCampaign
"""A campaign that can be repeated, in any process."""


@dataclass(frozen=True)
class ValidationResult:
    """Outcome of an experiment; ``folder`` is where results.json, replications.parquet and the plot are."""

    folder: Path
    subjects: tuple[Subject, ...]
    judgements: tuple[Judgement, ...]


def validate(
    experiment: Experiment, folder: Path, *, workers: int | None = None, progress: Progress | None = None
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
    """
    progress = progress or SilentProgress()
    require_place(folder)
    tested = list(_chains(experiment) if experiment.chains else _vehicles(experiment, progress))
    progress.stage("replications", len(tested) * experiment.replications)
    with worker_processes(workers) as executor:
        rows = [_replicate(repeated, experiment.replications, executor, progress) for _, repeated in tested]
    found = [(subject, of_subject) for (subject, _), of_subject in zip(tested, rows, strict=True)]
    judgements = corrected([one for subject, of_subject in found for one in _judge(experiment, subject, of_subject)])
    write_results(folder, experiment, judgements, found)
    return ValidationResult(folder, tuple(subject for subject, _ in found), tuple(judgements))


def _judge(experiment: Experiment, subject: Subject, rows: list[Row]) -> Iterator[Judgement]:
    for result in dict.fromkeys(row.result for row in rows):
        of_result = [row for row in rows if row.result == result]
        confidence = experiment.campaign.stop.confidence
        yield judge(subject, result, of_result, confidence)


def _chains(experiment: Experiment) -> Iterator[tuple[Subject, Repeated]]:
    campaign, method = experiment.campaign, experiment.campaign.testing.method
    for place, name in enumerate(experiment.chains):
        chain, seed = CHAINS[name], experiment.seed_of(place)
        if method == "shells":
            source = ChainShells(chain, experiment.super_population.pool_paths)
            subject = Subject(
                name, chain.crash_rate, crashes_outside={result_of(LIBRARY_STATEMENT): source.crashes_outside}
            )
            yield subject, ShellCampaign(campaign, source, seed, experiment.fault)
        else:
            episodes = ChainEpisodes(chain, method, seed)
            yield Subject(name, chain.crash_rate), WeightedCampaign(campaign, episodes, experiment.results)


def _vehicles(experiment: Experiment, progress: Progress) -> Iterator[tuple[Subject, Repeated]]:
    campaign, size, seed = experiment.campaign, experiment.super_population, experiment.seed
    environment, library = load_environment(campaign.environment), load_library(campaign.pool.library)
    drivers, pools = Drivers.of(library, experiment.avs, see_onset=environment.lateral.present), None
    if campaign.testing.method == "shells":
        pools = enumerate_paths(environment, drivers, seed, size.paths, progress)
    known = truths(environment, drivers, seed + 1, size.reference_paths, progress)
    for place, (name, av) in enumerate(experiment.avs.items()):
        tested, own_seed, truth = experiment.subject(name), experiment.seed_of(place), known[name]
        if pools is None:
            episodes = TwinEpisodes(tested, own_seed, experiment.results)
            repeated: Repeated = WeightedCampaign(tested, episodes, experiment.results)
            yield Subject(name, truth.crash_rate, truth.std_error), repeated
        else:
            source = overtaking_shells(library, pools, av, drivers.vehicles[name], size.pool_paths)
            repeated = ShellCampaign(tested, source, own_seed, experiment.fault)
            yield _subject(name, source, truth), repeated
            for made_name, made in experiment.adversaries.items():
                if made.of == name:
                    adversary = source.as_adversary(made)
                    repeated = ShellCampaign(tested, adversary, own_seed, experiment.fault)
                    yield _subject(made_name, adversary, Truth(adversary.crash_rate, 0.0)), repeated


def _subject(name: str, source: OvertakingShells, truth: Truth) -> Subject:
    outside = {result_of(each): share for each, share in source.crashes_outside.items()}
    facts = outside, source.left_out, source.template.library.boundary
    return Subject(name, truth.crash_rate, truth.std_error, *facts)


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


def _replicate(repeated: Repeated, n: int, executor: ProcessPoolExecutor, progress: Progress) -> list[Row]:
    rows: list[Row] = []
    size = -(-n // TASKS_PER_SUBJECT)
    parts = [range(first, min(first + size, n)) for first in range(0, n, size)]
    for part, found in zip(parts, executor.map(repeated.run, parts), strict=True):
        rows += found
        progress.advance(len(part))
    return rows
