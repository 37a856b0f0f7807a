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
        "judgements": judgements,
    }
    write_json(folder / RESULTS, finite_json(content))  # of what never crashes nothing relative is known


def coverage_plot(judgements: Sequence[Judgement], confidence: float) -> Plot:
    """Coverage with its own uncertainty on the left, tests on the right, one line for each vehicle and result."""
    n = len(judgements)
    labels = "coverage, 95 % interval", "tests: median, 5 to 95 %"
    figure, left, right = two_panels(1.2 + 0.2 * n, labels, sharey=True)
    coverages, tests = list[Bar](), list[Bar]()
    for one in judgements:
        colour = VERMILLION if one["coverage_too_low"] else GREY if one["p_value_holm"] is None else BLUE
        name = "{subject}: {result}".format_map(one)
        coverages.append(Bar(name, one["coverage"], colour, one["coverage_low"], one["coverage_high"]))
        tests.append(Bar(name, one["tests_median"], INK, one["tests_5"], one["tests_95"]))
    interval_bars(left, coverages)
    interval_bars(right, tests)
    left.axvline(confidence, color=INK, linewidth=0.8)
    right.set_xscale("log")
    low = sum(one["coverage_too_low"] for one in judgements)
    caption = f"{low} of {n} coverages are significantly below {confidence:g}; grey ones are not judged."
    return Plot("coverage", figure, f"Coverage and tests of {n} results. {caption}", caption)


def table_row(one: Judgement) -> dict[str, str]:
    """What a terminal shows of a judgement."""
    judged = "not judged" if one["p_value_holm"] is None else "{p_value_holm:.2g}"
    forms = {
        "subject": "{subject}",
        "result": "{result}",
        "truth": "{truth:.3g}",
        "bias": "" if math.isnan(one["bias"]) else "{bias:+.1%} ± {bias_std_error:.1%}",
        "relvar true": "" if math.isnan(one["true_relvar"]) else "{true_relvar:.3g}",
        "claimed": "" if math.isnan(one["claimed_relvar"]) else "{claimed_relvar:.3g}",
        "coverage [95 %]": "{coverage:.3f} [{coverage_low:.3f}, {coverage_high:.3f}]",
        "p (Holm)": judged + " TOO LOW" * one["coverage_too_low"],
        "tests median [5, 95 %]": "{tests_median:,.0f} [{tests_5:,.0f}, {tests_95:,.0f}]",
        "alarm": "{alarm:.1%}",
        "refused": "{refused:.1%}",
    }
    return {heading: form.format_map(one) for heading, form in forms.items()}
