"""NADE with and without sparse control variates, as Algorithm 1 claims it: by number of tests, and by stratum."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from harness.estimators.block import MAX_CONTROL_STEPS, Block
from harness.estimators.scv import StratumFit
from harness.records.folder import write_bytes
from harness.runner.stored_estimates import stored_blocks
from harness.studies.case_study.claimed import Claims
from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import exactly, figure, marked
from harness.studies.case_study.study_file import ControlVariates
from harness.studies.case_study.tested import PARTS
from harness.studies.kept_parts import write_table


def compare_control_variates(step: ControlVariates, context: Context) -> dict[str, Any]:
    """Both estimates at every size, in one pass that goes on from the last size; the strata after the last one."""
    run = context.made[step.of]
    sizes = [size for size in step.sizes if size <= run.result["n"]]
    begun = context.folder / PARTS / "state.pickle"
    # Written by this very step: its folder is named after the code whose objects these are.
    claims, rows = pickle.loads(begun.read_bytes()) if begun.is_file() else (Claims(), [])  # noqa: S301
    done = rows[-1]["n"] if rows else 0
    context.progress.stage(context.name, sizes[-1] if sizes else 0, done=done)
    for block in _cut_at(stored_blocks(run.folder / "run", moments=True), sizes):
        n = block.first_episode + len(block)
        if n <= done:
            continue
        if block.first_episode >= max(sizes, default=0):
            break
        claims.add(block)
        context.progress.advance(len(block))
        if n in sizes:
            rows.append(claims.row(context.rhw, context.confidence))
            _keep(begun, (claims, rows))
    fits = claims.scv.fits()
    beyond = [fit for level, fit in fits if level > MAX_CONTROL_STEPS]
    strata = [{"control_steps": level, **_together([fit])} for level, fit in fits]
    write_table(context.folder / "sizes.parquet", pa.Table.from_pylist(rows))
    write_table(context.folder / "strata.parquet", pa.Table.from_pylist(strata))
    return {
        "sizes": rows,
        "left_out": [size for size in step.sizes if size > run.result["n"]],
        "strata": strata,
        "beyond": _together(beyond),
        "all": _together([fit for _, fit in fits]),
        "figures": _figures(rows, fits),
    }


def _keep(path: Path, state: Any) -> None:
    path.parent.mkdir(exist_ok=True)
    write_bytes(path, pickle.dumps(state))


def _cut_at(blocks: Iterator[Block], sizes: list[int]) -> Iterator[Block]:
    """The same tests in blocks that end where a size is reached, too."""
    for block in blocks:
        first, stop = block.first_episode, block.first_episode + len(block)
        cuts = [0, *(size - first for size in sizes if first < size < stop), len(block)]
        for start, end in pairwise(cuts):
            yield block.take(slice(start, end))


def _together(fits: Sequence[StratumFit]) -> dict[str, Any]:
    """One stratum, or several: their tests and results together, the most columns, the largest rank."""
    n = sum(fit.n for fit in fits)
    mean = sum(fit.n * fit.intercept for fit in fits) / max(n, 1)
    between = sum(fit.n * (fit.intercept - mean) ** 2 for fit in fits)
    spread = {
        name: float(np.sqrt((sum(each) + between) / max(n, 1)))
        for name, each in {
            "sd_before": [fit.total_squares for fit in fits],
            "sd_after": [fit.residual_squares for fit in fits],
        }.items()
    }
    return {
        "n": n,
        "columns": max((fit.n_columns for fit in fits), default=0),
        "rank": max((fit.rank for fit in fits), default=0),
        **spread,
    }


def _figures(rows: list[dict[str, Any]], fits: list[tuple[int, StratumFit]]) -> dict[str, Any]:
    if not rows:
        return {}
    last, most = rows[-1], max(((fit.n, level) for level, fit in fits if level > 0), default=(0, None))[1]
    gain = last["gain_claimed"]
    return {
        "claimed_gain": marked(figure(None) if gain is None else exactly(gain), settled=last["settled"]),
        "difference": figure(last["difference"]),
        "most_frequent_stratum": figure(None) if most is None else exactly(most),
    }
