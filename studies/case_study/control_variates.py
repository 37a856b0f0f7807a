"""NADE with and without sparse control variates, as both claim it of the same tests: by number of tests, by stratum."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa

from harness.estimators.block import MAX_CONTROL_STEPS, Block
from harness.estimators.estimate import FailureBounds
from harness.estimators.limits import normal_half_width
from harness.estimators.scv import Scv, StratumFit
from harness.estimators.weighted import Nade
from harness.records.folder import write_bytes
from harness.runner.estimate import stored_blocks
from harness.vocabulary import Method
from studies.case_study.context import Context
from studies.case_study.figures import exactly, figure, marked, tests_for, weights_are_in
from studies.case_study.study_file import ControlVariates
from studies.work import write_table


class Claims:
    """Both estimators, fed with the same blocks; SCV only where it is defined and wanted."""

    def __init__(self, *, with_scv: bool = True) -> None:
        self.nade, self.scv = FailureBounds(Nade()), Scv()
        self._scv, self._with_scv = FailureBounds(self.scv), with_scv
        self._n, self._weight = 0, 0.0
        self._method: Method = "nde"

    def add(self, block: Block) -> None:
        """Add tests."""
        self._method = block.drawn.method
        self._with_scv = self._with_scv and Scv.refusal(block) is None
        self._n += len(block)
        self._weight += float(block.weights().sum())
        self.nade.add(block)
        if self._with_scv:
            self._scv.add(block)

    def row(self, rhw: float, confidence: float) -> dict[str, Any]:
        """Figures of what is claimed so far; ``settled`` says whether it means anything."""
        nade, z = self.nade.result(confidence), normal_half_width(1.0, confidence)
        scv = self._scv.result(confidence) if self._with_scv else None
        mean_weight = self._weight / self._n
        settled = weights_are_in(self._method, mean_weight)
        row: dict[str, Any] = {
            "n": self._n,
            "n_crashes": nade.n_crashes,
            "mean_weight": mean_weight,
            "settled": settled,
            "largest_weight_share": nade.largest_weight_share,
        }
        for name, found in (("nade", nade), ("scv", scv)):
            rate, half = (0.0, 0.0) if found is None else (found.crash_rate, z * found.std_error)
            said = figure(rate, max(rate - half, 0.0), rate + half) if rate > 0.0 else figure(None)
            row[f"{name}_rate"] = marked(said, settled=settled)
            row[f"{name}_rhw"] = half / rate if rate > 0.0 else None
            row[f"{name}_tests"] = tests_for(self._n * (half / z / rate) ** 2, rhw, confidence) if rate > 0.0 else None
        beside = scv if scv is not None and scv.std_error > 0.0 < nade.crash_rate else None
        row["gain_claimed"] = None if beside is None else (nade.std_error / beside.std_error) ** 2
        row["difference"] = None if beside is None else abs(beside.crash_rate / nade.crash_rate - 1.0)
        return row


def compare_control_variates(step: ControlVariates, context: Context) -> dict[str, Any]:
    """Both estimates at every size, in one pass that goes on from the last size; the strata after the last one."""
    run = context.made[step.of]
    sizes = [size for size in step.sizes if size <= run.result["n"]]
    begun = context.parts / "state.pickle"
    # Written by this very step: its folder is named after the code whose objects these are.
    claims, rows = pickle.loads(begun.read_bytes()) if begun.is_file() else (Claims(), [])  # noqa: S301
    done = rows[-1]["n"] if rows else 0
    context.progress.stage(context.name, sizes[-1] if sizes else 0, done=done)
    for block in cut_at(stored_blocks(run.folder / "run", moments=True), sizes):
        n = block.first_episode + len(block)
        if n <= done:
            continue
        if block.first_episode >= max(sizes, default=0):
            break
        claims.add(block)
        context.progress.advance(len(block))
        if n in sizes:
            rows.append(claims.row(context.rhw, context.confidence))
            begun.parent.mkdir(exist_ok=True)
            write_bytes(begun, pickle.dumps((claims, rows)))
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


def cut_at(blocks: Iterator[Block], sizes: list[int]) -> Iterator[Block]:
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
