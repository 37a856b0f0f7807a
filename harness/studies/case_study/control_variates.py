"""NADE with and without sparse control variates, as Algorithm 1 claims it: by number of tests, and by stratum."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa

from harness.estimators.block import MAX_CONTROL_STEPS, Block
from harness.estimators.estimate import BothWays, Estimate
from harness.estimators.nade import Nade
from harness.estimators.scv import Scv, StratumFit
from harness.runner.stored_estimates import stored_blocks
from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import exactly, figure, z_of
from harness.studies.case_study.study_file import ControlVariates
from harness.studies.case_study.tested import write_table


def compare_control_variates(step: ControlVariates, context: Context) -> dict[str, Any]:
    """Both estimates at every size, in one pass; the strata after the last one."""
    run = context.made[step.of]
    sizes = [size for size in step.sizes if size <= run.result["n"]]
    nade, inner = BothWays(Nade()), Scv()
    scv, rows, n = BothWays(inner), [], 0
    context.progress.stage("control variates", sizes[-1] if sizes else 0)
    for block in _cut_at(stored_blocks(run.folder / "run", moments=True), sizes):
        nade.add(block)
        scv.add(block)
        n += len(block)
        context.progress.advance(len(block))
        if n in sizes:
            rows.append(_row(n, nade.result(context.confidence), scv.result(context.confidence), context.confidence))
        if sizes and n >= sizes[-1]:
            break
    strata = [_stratum(level, fit) for level, fit in inner.fits()]
    write_table(context.folder / "sizes.parquet", pa.Table.from_pylist(rows))
    write_table(context.folder / "strata.parquet", pa.Table.from_pylist(strata))
    return {
        "sizes": rows,
        "left_out": [size for size in step.sizes if size > n],
        "strata": strata,
        "figures": _figures(rows, strata),
    }


def _cut_at(blocks: Iterator[Block], sizes: list[int]) -> Iterator[Block]:
    """The same tests in blocks that end where a size is reached, too."""
    for block in blocks:
        first, stop = block.first_episode, block.first_episode + len(block)
        cuts = [0, *(size - first for size in sizes if first < size < stop), len(block)]
        for start, end in pairwise(cuts):
            yield block.take(slice(start, end))


def _row(n: int, nade: Estimate, scv: Estimate, confidence: float) -> dict[str, Any]:
    """What is claimed after n tests; half-widths are z times the standard error, as in the paper."""
    rate, z = nade.crash_rate, z_of(confidence)
    half = {"nade": z * nade.std_error, "scv": z * scv.std_error}
    return {
        "n": n,
        "n_crashes": nade.n_crashes,
        "nade_rate": rate,
        "scv_rate": scv.crash_rate,
        **{f"{name}_half_width": each for name, each in half.items()},
        **{f"{name}_rhw": each / rate if rate > 0.0 else None for name, each in half.items()},
        "claimed_gain": (nade.std_error / scv.std_error) ** 2 if scv.std_error > 0.0 else None,
        "difference": abs(scv.crash_rate - rate) / rate if rate > 0.0 else None,
    }


def _stratum(level: int, fit: StratumFit) -> dict[str, Any]:
    return {
        "n_control_steps": level,
        "n": fit.n,
        "columns": fit.n_columns,
        "rank": fit.rank,
        "sd_before": float(np.sqrt(fit.total_squares / fit.n)),
        "sd_after": float(np.sqrt(fit.residual_squares / fit.n)),
    }


def _figures(rows: list[dict[str, Any]], strata: list[dict[str, Any]]) -> dict[str, Any]:
    if not rows:
        return {}
    last, most = (
        rows[-1],
        max((row for row in strata if row["n_control_steps"] > 0), key=lambda row: row["n"], default=None),
    )
    few = [row["rank"] for row in strata if row["n_control_steps"] <= MAX_CONTROL_STEPS]
    return {
        **{f"{name}_rhw_{row['n']}": figure(row[f"{name}_rhw"]) for row in rows for name in ("nade", "scv")},
        "claimed_gain": exactly(last["claimed_gain"]) if last["claimed_gain"] is not None else figure(None),
        "difference": figure(last["difference"]),
        "most_frequent_stratum": figure(None) if most is None else exactly(most["n_control_steps"]),
        "largest_rank": exactly(max(few, default=0)),
    }
