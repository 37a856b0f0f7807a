"""Run a replication experiment: repeat the campaign of each vehicle or chain, judge, write results.

The folder receives results.json, and all replications as Parquet.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pyarrow as pa

from harness.estimators.estimate import finite_json
from harness.progress import Progress
from harness.records.folder import require_place, write_json
from studies.replication.experiment import Experiment
from studies.replication.judgement import Judgement, Row, Subject, corrected, judge
from studies.replication.subjects import subjects
from studies.work import results_of, worker_processes, write_table

TASKS_PER_SUBJECT = 8
RESULTS, REPLICATIONS = "results.json", "replications.parquet"
SHOWN = (
    *("subject", "result", "truth", "bias", "true_relvar", "claimed_relvar"),
    *("coverage", "p_value_holm", "tests_median", "alarm", "refused"),
)
"""What a terminal shows of a judgement."""


def validate(experiment: Experiment, folder: Path, workers: int | None, progress: Progress) -> list[Judgement]:
    """Repeat, judge, and write the results into a folder, whose earlier ones are replaced.

    Worker processes, one per core by default, change no bit.
    """
    require_place(folder)
    n, found = experiment.replications, dict[Subject, list[Row]]()
    size = -(-n // TASKS_PER_SUBJECT)
    jobs = [range(first, min(first + size, n)) for first in range(0, n, size)]
    with worker_processes(workers) as executor:
        for subject, repeated in list(subjects(experiment, executor, progress)):
            parts = results_of(f"replications of {subject.name}", jobs, repeated.run, progress, executor)
            found[subject] = [row for part in parts for row in part]
    judgements = corrected(
        [
            judge(subject, result, [row for row in rows if row.result == result], experiment.nominal_of(result))
            for subject, rows in found.items()
            for result in dict.fromkeys(row.result for row in rows)
        ]
    )
    table = [{"subject": subject.name, **asdict(row)} for subject, rows in found.items() for row in rows]
    write_table(folder / REPLICATIONS, pa.Table.from_pylist(table))
    content = {
        "experiment": experiment.model_dump(mode="json"),
        "confidence": experiment.nominal,
        "truth": "exact, by backward induction" if experiment.chains else "independent enumeration with another seed",
        "largest_relative_error_of_truth": max(subject.relative_error for subject in found),
        "subjects": [asdict(subject) for subject in found],
        "judgements": judgements,
    }
    write_json(folder / RESULTS, finite_json(content))  # of what never crashes nothing relative is known
    return judgements
