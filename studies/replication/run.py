"""Run a replication experiment: repeat the campaign of each vehicle or chain, judge, write results.

The folder receives results.json, all replications as Parquet, and a plot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from harness.estimators.estimate import finite_json
from harness.progress import Progress
from harness.records.folder import require_place, write_bytes, write_json
from harness.report.style import BLUE, FULL_WIDTH_IN, GREY, INK, VERMILLION, Plot, new_figure, png
from studies.replication.experiment import Experiment
from studies.replication.judgement import Judgement, Row, corrected, judge
from studies.replication.subjects import Repeated, Tested, subjects
from studies.replication.work import kept_parts, worker_processes, write_table

TASKS_PER_SUBJECT = 8
RESULTS, REPLICATIONS, PLOT = "results.json", "replications.parquet", "coverage.png"


def validate(
    experiment: Experiment,
    folder: Path,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    parts: Path | None = None,
) -> list[Judgement]:
    """Repeat, judge, and write the results into a folder, whose earlier ones are replaced.

    Worker processes, one per core by default, change no bit. In ``parts`` finished replications of this very experiment
    are kept, and taken from there.
    """
    progress = progress or Progress()
    require_place(folder)
    n, found = experiment.replications, list[tuple[Tested, pa.Table]]()
    size = -(-n // TASKS_PER_SUBJECT)
    jobs = [range(first, min(first + size, n)) for first in range(0, n, size)]
    with worker_processes(workers) as executor:
        for place, (subject, repeated) in enumerate(list(subjects(experiment, executor, progress))):
            kept, stage = parts and parts / str(place), f"replications of {subject.name}"
            make = partial(replications_of, repeated)
            tables = kept_parts(kept, stage, jobs, make, progress, run=executor.map, size=len)
            found.append(((subject, repeated), pa.concat_tables(tables)))
    judgements = []
    for (subject, _), table in found:
        rows = [Row(**row) for row in table.to_pylist()]
        for result in dict.fromkeys(row.result for row in rows):
            of_result = [row for row in rows if row.result == result]
            judgements.append(judge(subject, result, of_result, experiment.nominal))
    judgements = corrected(judgements)
    _write(folder, experiment, judgements, found)
    return judgements


def replications_of(repeated: Repeated, part: range) -> pa.Table:
    """Rows of some replications."""
    return pa.Table.from_pylist([asdict(row) for row in repeated.run(part)])


def _write(
    folder: Path, experiment: Experiment, judgements: Sequence[Judgement], found: Sequence[tuple[Tested, pa.Table]]
) -> None:
    named = [table.add_column(0, "subject", [[one.name] * len(table)]) for (one, _), table in found]
    write_table(folder / REPLICATIONS, pa.concat_tables(named))
    write_bytes(folder / PLOT, png(coverage_plot(judgements, experiment.nominal)))
    content = {
        "experiment": experiment.model_dump(mode="json"),
        "confidence": experiment.nominal,
        "truth": "exact, by backward induction" if experiment.chains else "independent enumeration with another seed",
        "largest_relative_error_of_truth": max(one.relative_error for (one, _), _ in found),
        "subjects": [asdict(one) for (one, _), _ in found],
        "judgements": [one.to_json() for one in judgements],
    }
    write_json(folder / RESULTS, finite_json(content))  # of what never crashes nothing relative is known


def coverage_plot(judgements: Sequence[Judgement], confidence: float) -> Plot:
    """Coverage with its own uncertainty on the left, tests on the right, one line for each vehicle and result."""
    n = len(judgements)
    figure = new_figure(FULL_WIDTH_IN, 1.2 + 0.2 * n)
    left, right = figure.subplots(1, 2, sharey=True)
    for place, one in enumerate(judgements):
        colour = VERMILLION if one.too_low else BLUE if one.p_value_holm is not None else GREY
        left.plot([one.coverage_low, one.coverage_high], [place, place], color=colour)
        left.plot(one.coverage, place, "o", color=colour, markersize=4.0)
        right.plot([one.tests_5, one.tests_95], [place, place], color=GREY)
        right.plot(one.tests_median, place, "o", color=INK, markersize=4.0)
    left.axvline(confidence, color=INK, linewidth=0.8)
    left.set_title("Coverage, 95 % interval")
    right.set_title("Tests: median, 5 to 95 %")
    right.set_xscale("log")
    left.set_yticks(np.arange(n), [f"{one.subject}: {one.result}" for one in judgements])
    left.set_ylim(n - 0.5, -0.5)
    low = sum(one.too_low for one in judgements)
    caption = f"{low} of {n} coverages are significantly below {confidence:g}; grey ones are not judged."
    return Plot("coverage", figure, f"Coverage and tests of {n} results. {caption}", caption)


def table_lines(judgements: Sequence[Judgement]) -> list[str]:
    """Lines of a table, aligned for a terminal."""
    table = [_cells(one) for one in judgements]
    lines = [tuple(table[0]), *(tuple(cells.values()) for cells in table)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]


def _cells(one: Judgement) -> dict[str, str]:
    p = "not judged" if one.p_value_holm is None else f"{one.p_value_holm:.2g}"
    return {
        "subject": one.subject,
        "result": one.result,
        "truth": f"{one.truth:.3g}",
        "bias": f"{one.bias:+.1%} ± {one.bias_std_error:.1%}",
        "relvar true": f"{one.true_relvar:.3g}",
        "claimed": f"{one.claimed_relvar:.3g}",
        "coverage [95 %]": f"{one.coverage:.3f} [{one.coverage_low:.3f}, {one.coverage_high:.3f}]",
        "p (Holm)": p + (" TOO LOW" if one.too_low else ""),
        "tests median [5, 95 %]": f"{one.tests_median:,.0f} [{one.tests_5:,.0f}, {one.tests_95:,.0f}]",
        "alarm": f"{one.alarm:.1%}",
        "refused": f"{one.refused:.1%}",
    }
