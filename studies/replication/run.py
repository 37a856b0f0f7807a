"""Run a replication experiment: repeat the campaign of each vehicle or chain, judge, write results.

The folder receives results.json, all replications as Parquet, and a plot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import pyarrow as pa

from harness.estimators.estimate import finite_json
from harness.progress import Progress
from harness.records.folder import require_place, write_bytes, write_json
from harness.report.style import BLUE, GREY, INK, VERMILLION, Plot, interval_bars, png, two_panels
from harness.report.style import Row as Bar
from studies.replication.experiment import Experiment
from studies.replication.judgement import Judgement, Row, Subject, corrected, judge
from studies.replication.subjects import subjects
from studies.work import results_of, worker_processes, write_table

TASKS_PER_SUBJECT = 8
RESULTS, REPLICATIONS, PLOT = "results.json", "replications.parquet", "coverage.png"


def validate(
    experiment: Experiment, folder: Path, *, workers: int | None = None, progress: Progress | None = None
) -> list[Judgement]:
    """Repeat, judge, and write the results into a folder, whose earlier ones are replaced.

    Worker processes, one per core by default, change no bit.
    """
    progress = progress or Progress()
    require_place(folder)
    n, found = experiment.replications, dict[Subject, list[Row]]()
    size = -(-n // TASKS_PER_SUBJECT)
    jobs = [range(first, min(first + size, n)) for first in range(0, n, size)]
    with worker_processes(workers) as executor:
        for subject, repeated in list(subjects(experiment, executor, progress)):
            stage = f"replications of {subject.name}"
            parts = results_of(stage, jobs, repeated.run, progress, run=executor.map, size=len)
            found[subject] = [row for part in parts for row in part]
    judgements = []
    for subject, rows in found.items():
        for result in dict.fromkeys(row.result for row in rows):
            of_result = [row for row in rows if row.result == result]
            judgements.append(judge(subject, result, of_result, experiment.nominal))
    judgements = corrected(judgements)
    write_results(folder, experiment, judgements, found)
    return judgements


def write_results(
    folder: Path, experiment: Experiment, judgements: Sequence[Judgement], found: Mapping[Subject, Sequence[Row]]
) -> None:
    """Write all files."""
    rows = [{"subject": subject.name, **asdict(row)} for subject, rows in found.items() for row in rows]
    write_table(folder / REPLICATIONS, pa.Table.from_pylist(rows))
    write_bytes(folder / PLOT, png(coverage_plot(judgements, experiment.nominal)))
    content = {
        "experiment": experiment.model_dump(mode="json"),
        "confidence": experiment.nominal,
        "truth": "exact, by backward induction" if experiment.chains else "independent enumeration with another seed",
        "largest_relative_error_of_truth": max(subject.relative_error for subject in found),
        "subjects": [asdict(subject) for subject in found],
        "judgements": [one.to_json() for one in judgements],
    }
    write_json(folder / RESULTS, finite_json(content))  # of what never crashes nothing relative is known


def coverage_plot(judgements: Sequence[Judgement], confidence: float) -> Plot:
    """Coverage with its own uncertainty on the left, tests on the right, one line for each vehicle and result."""
    n = len(judgements)
    labels = "coverage, 95 % interval", "tests: median, 5 to 95 %"
    figure, left, right = two_panels(1.2 + 0.2 * n, labels, sharey=True)
    coverages, tests = list[Bar](), list[Bar]()
    for one in judgements:
        name, colour = f"{one.subject}: {one.result}", BLUE if one.p_value_holm is not None else GREY
        colour = VERMILLION if one.too_low else colour
        coverages.append(Bar(name, one.coverage, colour, one.coverage_low, one.coverage_high))
        tests.append(Bar(name, one.tests_median, INK, one.tests_5, one.tests_95))
    interval_bars(left, coverages)
    interval_bars(right, tests)
    left.axvline(confidence, color=INK, linewidth=0.8)
    right.set_xscale("log")
    low = sum(one.too_low for one in judgements)
    caption = f"{low} of {n} coverages are significantly below {confidence:g}; grey ones are not judged."
    return Plot("coverage", figure, f"Coverage and tests of {n} results. {caption}", caption)


def table_lines(judgements: Sequence[Judgement]) -> list[str]:
    """Lines of a table, aligned for a terminal."""
    table = [_cells(one) for one in judgements]
    columns = [[head, *(cells[head] for cells in table)] for head in table[0]]
    padded = [[cell.ljust(max(map(len, column))) for cell in column] for column in columns]
    return ["  ".join(line) for line in zip(*padded, strict=True)]


def _cells(one: Judgement) -> dict[str, str]:
    p = "not judged" if one.p_value_holm is None else f"{one.p_value_holm:.2g}"
    return {
        "subject": one.subject,
        "result": one.result,
        "truth": f"{one.truth:.3g}",
        "bias": "" if math.isnan(one.bias) else f"{one.bias:+.1%} ± {one.bias_std_error:.1%}",
        "relvar true": "" if math.isnan(one.true_relvar) else f"{one.true_relvar:.3g}",
        "claimed": "" if math.isnan(one.claimed_relvar) else f"{one.claimed_relvar:.3g}",
        "coverage [95 %]": f"{one.coverage:.3f} [{one.coverage_low:.3f}, {one.coverage_high:.3f}]",
        "p (Holm)": p + (" TOO LOW" if one.too_low else ""),
        "tests median [5, 95 %]": f"{one.tests_median:,.0f} [{one.tests_5:,.0f}, {one.tests_95:,.0f}]",
        "alarm": f"{one.alarm:.1%}",
        "refused": f"{one.refused:.1%}",
    }
