"""What an experiment leaves: results.json, all replications as Parquet, a plot, and a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.records.folder import write_atomically, write_bytes, write_json
from harness.report.plot_style import BLUE, FULL_WIDTH_IN, GREY, INK, VERMILLION, Plot, new_figure, png
from harness.studies.experiment import Experiment
from harness.studies.judgement import Judgement, Row, Subject

RESULTS, REPLICATIONS, PLOT = "results.json", "replications.parquet", "coverage.png"
TRUTH_OF_CHAINS = "exact, by backward induction"
TRUTH_OF_VEHICLES = "independent enumeration with another seed"


def write_results(
    folder: Path,
    experiment: Experiment,
    judgements: Sequence[Judgement],
    found: Sequence[tuple[Subject, Sequence[Row]]],
) -> None:
    """Write all files of an experiment; ``found`` are the replications of each subject."""
    folder.mkdir(parents=True, exist_ok=True)
    confidence = experiment.nominal
    flat = [(subject.name, row) for subject, rows in found for row in rows]
    columns = {"subject": [name for name, _ in flat]}
    table = pa.table(columns | {field.name: [getattr(row, field.name) for _, row in flat] for field in fields(Row)})
    write_atomically(folder / REPLICATIONS, lambda file: pq.write_table(table, file, compression="zstd"))
    write_bytes(folder / PLOT, png(coverage_plot(judgements, confidence)))
    write_json(
        folder / RESULTS,
        {
            "experiment": experiment.model_dump(mode="json"),
            "confidence": confidence,
            "truth": TRUTH_OF_CHAINS if experiment.chains else TRUTH_OF_VEHICLES,
            "largest_relative_error_of_truth": max(one.relative_error for one, _ in found),
            "subjects": [asdict(one) for one, _ in found],
            "judgements": [one.to_json() for one in judgements],
        },
    )


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
