"""What an experiment leaves: results.json, all replications as Parquet, a plot, and a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from harness.records.folder import write_atomically, write_bytes, write_json
from harness.report.plot_style import png
from harness.studies.coverage_plot import coverage_plot
from harness.studies.experiment import Experiment
from harness.studies.judgement import Judgement, Subject
from harness.studies.rows import Row

RESULTS, REPLICATIONS, PLOT = "results.json", "replications.parquet", "coverage.png"
TRUTH_OF_CHAINS = "exact, by backward induction"
TRUTH_OF_VEHICLES = "independent enumeration with another seed"


def write_results(
    folder: Path,
    experiment: Experiment,
    subjects: Sequence[Subject],
    judgements: Sequence[Judgement],
    rows: Mapping[str, Sequence[Row]],
) -> None:
    """Write all files of an experiment.

    Parameters
    ----------
    folder : Path
    experiment : Experiment
    subjects : sequence of Subject
    judgements : sequence of Judgement
    rows : mapping
        Replications by subject.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table = _table(rows)
    write_atomically(folder / REPLICATIONS, lambda file: pq.write_table(table, file, compression="zstd"))
    picture = png(coverage_plot(judgements, experiment.campaign.stop.confidence))
    write_bytes(folder / PLOT, picture)
    write_json(
        folder / RESULTS,
        {
            "experiment": experiment.model_dump(mode="json"),
            "confidence": experiment.campaign.stop.confidence,
            "truth": TRUTH_OF_CHAINS if experiment.chains else TRUTH_OF_VEHICLES,
            "largest_relative_error_of_truth": max(one.std_error / one.crash_rate for one in subjects),
            "subjects": [asdict(one) | {"meets_assumption": one.meets_assumption} for one in subjects],
            "judgements": [one.to_json() for one in judgements],
        },
    )


def _table(rows: Mapping[str, Sequence[Row]]) -> pa.Table:
    flat = [(name, row) for name, of_subject in rows.items() for row in of_subject]
    columns = {"subject": [name for name, _ in flat]}
    return pa.table(columns | {field.name: [getattr(row, field.name) for _, row in flat] for field in fields(Row)})


HEADER = (
    "subject",
    "result",
    "truth",
    "bias",
    "relvar true",
    "claimed",
    "coverage [95 %]",
    "p (Holm)",
    "tests median [5, 95 %]",
    "alarm",
)


def table_lines(judgements: Sequence[Judgement], *, markdown: bool = False) -> list[str]:
    """Lines of a table, aligned for a terminal or as Markdown."""
    body = [_cells(one) for one in judgements]
    if markdown:
        return [_row(HEADER), _row(["---"] * len(HEADER)), *map(_row, body)]
    widths = [max(len(line[k]) for line in [HEADER, *body]) for k in range(len(HEADER))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in [HEADER, *body]]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _cells(one: Judgement) -> tuple[str, ...]:
    p = "not judged" if one.p_value_holm is None else f"{one.p_value_holm:.2g}"
    return (
        one.subject,
        one.result,
        f"{one.truth:.3g}",
        f"{one.bias:+.1%} ± {one.bias_std_error:.1%}",
        f"{one.true_relvar:.3g}",
        f"{one.claimed_relvar:.3g}",
        f"{one.coverage:.3f} [{one.coverage_low:.3f}, {one.coverage_high:.3f}]",
        p + (" TOO LOW" if one.too_low else ""),
        f"{one.tests_median:,.0f} [{one.tests_5:,.0f}, {one.tests_95:,.0f}]",
        f"{one.alarm:.1%}",
    )
