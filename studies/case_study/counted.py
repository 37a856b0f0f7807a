"""What a run claims as it grows: NADE with and without control variates, convergence, the paper's RNoT and AAR."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from harness.estimators.block import Block
from harness.estimators.likelihood import Level
from harness.estimators.one_pass import refusal
from harness.estimators.scv import CHUNK_ROWS as CHUNK
from harness.estimators.scv import Scv, StratumFit, fill_product_columns
from harness.estimators.weighted import Nade
from harness.runner.stored import stored_blocks
from harness.vocabulary import FloatArray
from studies import rnot
from studies.case_study import figures
from studies.case_study.figures import exactly, figure, marked
from studies.case_study.study import Context, ControlVariates, Convergence, Made, RequiredNumbers
from studies.case_study.tested import settled, tests_of
from studies.work import write_table


class Claims:
    """Both estimators, fed with the same blocks; SCV only where it is defined and wanted."""

    def __init__(self, *, with_scv: bool = True) -> None:
        self.nade, self.scv, self._with_scv = Nade(), Scv(), with_scv
        self._weight = 0.0

    def add(self, block: Block) -> None:
        """Add tests."""
        self._method = block.drawn.method
        self._with_scv = self._with_scv and refusal(block, "scv") is None
        self._weight += float(block.weights().sum())
        self.nade.add(block)
        if self._with_scv:
            self.scv.add(block)

    def rates(self) -> tuple[float, float]:
        """Both estimates."""
        of_strata = sum(fit.n * fit.intercept for _, fit in self.scv.fits())
        return self.nade.y.mean(self.nade.n), of_strata / self.nade.n

    def row(self, rhw: float, confidence: float) -> dict[str, Any]:
        """Figures of what is claimed so far; ``settled`` says whether it means anything."""
        nade, z = self.nade.result(confidence), Level.two_sided(confidence).z
        scv = self.scv.result(confidence) if self._with_scv else None
        mean_weight = self._weight / self.nade.n
        settled = figures.weights_are_in(self._method, mean_weight)
        row: dict[str, Any] = {"n": self.nade.n, "mean_weight": mean_weight, "settled": settled}
        row["largest_weight_share"] = nade.largest_weight_share
        for name, found in (("nade", nade), ("scv", scv)):
            rate, half = (0.0, 0.0) if found is None else (found.crash_rate, z * found.std_error)
            interval = figure(rate, max(rate - half, 0.0), rate + half) if rate > 0.0 else figure(None)
            row[f"{name}_rate"] = marked(interval, settled=settled)
            row[f"{name}_rhw"] = half / rate if rate > 0.0 else None
            needed = figures.tests_for(self.nade.n * (half / z / rate) ** 2, rhw, confidence) if rate > 0.0 else None
            row[f"{name}_tests"] = needed
        row |= dict.fromkeys(("gain_claimed", "gain_degrees_of_freedom", "difference"))
        row["n_saturated"] = 0 if scv is None else len(scv.details["gain"]["saturated"])
        if scv is not None and scv.std_error > 0.0 < nade.crash_rate:
            row["gain_degrees_of_freedom"] = scv.details["gain"]["degrees_of_freedom"]
            row["gain_claimed"] = (nade.std_error / scv.std_error) ** 2
            row["difference"] = abs(scv.crash_rate / nade.crash_rate - 1.0)
        return row


def compare_control_variates(step: ControlVariates, context: Context) -> dict[str, Any]:
    """Both estimates at every size, in one pass, and the strata after the last one."""
    n, run = context.made[step.of].result["n"], context.made[step.of].folder / "run"
    shown = [size for size in step.sizes if size <= n]
    between = np.geomspace(min(300, shown[-1]), shown[-1], step.looks) if shown else np.zeros(0)
    sizes = sorted({*shown, *between.astype(int).tolist()})
    claims, rows = Claims(), list[dict[str, Any]]()
    context.progress.stage("both estimates", max(sizes, default=0))
    for block in rnot.cut_at(stored_blocks(run, moments=True), sizes):
        claims.add(block)
        context.progress.advance(len(block))
        if (size := block.first_episode + len(block)) in sizes:
            again = gain_of_parts(run, size, n, step.parts, context.confidence)
            rows.append({**claims.row(context.rhw, context.confidence), "gain_replicated": again})
    fits, answers = claims.scv.fits(), {}
    strata = [
        {"control_steps": level, "columns": fit.n_columns, "rank": fit.rank, **_spread_of([fit])}
        for level, fit in (fits if step.spread_tests else ())
    ]
    if step.spread_tests:
        write_table(context.folder / SPREAD, spread(rnot.first_block(run, min(step.spread_tests, n))))
    if rows:
        late = _spread_of([fit for level, fit in fits if level >= 4])
        left = late["sd_after"] / late["sd_before"] if late["sd_before"] else None
        answers["rate_over_nade"] = exactly(1.0 + max(row["difference"] or 0.0 for row in rows))
        answers["sd_left_from_4"] = marked(figure(left, left, left), settled=rows[-1]["settled"])
    sizes_shown = [row for row in rows if row["n"] in shown]
    return {"looks": rows, "sizes": sizes_shown, "strata": strata, "figures": answers}


def gain_of_parts(run: Path, size: int, n: int, parts: int, confidence: float) -> dict[str, Any]:
    """NADE's variance over SCV's between the estimates of as many parts of a run of n tests, if it has them."""
    if n < parts * size:
        return figure(None)
    claims, rates = Claims(), list[tuple[float, float]]()
    for block in rnot.cut_at(stored_blocks(run, moments=True), [k * size for k in range(1, 1 + parts)]):
        claims.add(block)
        if (block.first_episode + len(block)) % size == 0:
            rates.append(claims.rates())
            claims = Claims()
    return figures.ratio_of_variances([nade for nade, _ in rates], [scv for _, scv in rates], confidence)


SPREAD = "results.parquet"


def spread(block: Block) -> pa.Table:
    """Results of some tests before and after adjustment, Y and Z = Y - Hβ, those that are not 0, by control steps."""
    scv = Scv()
    scv.add(block)
    y, (of_stratum, explained) = block.weighted_crashes(), explained_by(block, scv.fits())
    z = y - explained + of_stratum
    kept = (y != 0.0) | (z != 0.0)
    return pa.table({"control_steps": block.n_control_steps[kept], "y": y[kept], "z": z[kept]})


def explained_by(block: Block, fits: Sequence[tuple[int, StratumFit]]) -> FloatArray:
    """What regressions say of each test: η_l, and η_l + (h - means)·β with each β, (1 + k, n); 0 where l has none."""
    found = np.zeros((1 + len(fits[0][1].beta), len(block)))
    for level, fit in fits:
        at = np.flatnonzero(block.n_control_steps == level)
        for rows in (at[start : start + CHUNK] for start in range(0, len(at), CHUNK)):
            columns = np.empty((len(rows), fit.n_columns), order="F")
            fill_product_columns(block.first_ratios[rows], level, columns)
            found[:, rows] = fit.intercept
            found[1:, rows] += fit.beta @ (columns - fit.means).T
    return found


TESTS_EACH = (1, 5, 20, 100, 1_000)
"""Tests for each principal component of columns that is used: of few, coefficients are worse than none elsewhere."""


class KnownMeans:
    """Results less what columns explain of them, with means and coefficients from other tests, which are not counted.

    Of all `TESTS_EACH` the best counts, in hindsight: what is measured is the most that could be gained.
    """

    def __init__(self, others: Scv) -> None:
        self._fits, self._of_campaigns = others.fits(TESTS_EACH), list[FloatArray]()

    def add(self, block: Block) -> None:
        """Add a campaign: variances of Y, and of Y less what columns explain."""
        y = block.weighted_crashes()
        self._of_campaigns.append(np.vstack([y, y - explained_by(block, self._fits)[1:]]).var(axis=1))

    def row(self, confidence: float) -> dict[str, Any]:
        """NADE's variance over what is left."""
        plain, *columns = np.transpose(self._of_campaigns)
        best = int(np.argmin([np.mean(one) for one in columns]))
        return {"gain_known": figures.ratio_of_means(plain, columns[best], confidence)}


def _spread_of(fits: Sequence[StratumFit]) -> dict[str, Any]:
    """Tests of strata together, and the spread of their results before and after adjustment."""
    n = sum(fit.n for fit in fits)
    mean = sum(fit.n * fit.intercept for fit in fits) / max(n, 1)
    between = sum(fit.n * (fit.intercept - mean) ** 2 for fit in fits)
    left = {"before": sum(fit.total_squares for fit in fits), "after": sum(fit.residual_squares for fit in fits)}
    return {"n": n, **{f"sd_{key}": float(np.sqrt((one + between) / max(n, 1))) for key, one in left.items()}}


CURVES = "curves.parquet"


def draw_convergence(step: Convergence, context: Context) -> dict[str, Any]:
    """Curves as Parquet; how many tests each needed in the order in which it was tested; rates over the reference's."""
    procedure = rnot.Procedure(context.rhw, context.confidence)
    curves, answers = list[pd.DataFrame](), dict[str, Any]()
    reference = context.made[step.reference].result["figures"]["crash_rate"]
    for name in step.of:
        tests = tests_of(context.made[name])
        n = procedure.grid(tests.n)
        total, half = rnot.total_and_half_width(tests.y, np.searchsorted(tests.episode, n), n, procedure.z)
        curves.append(pd.DataFrame({"step": name, "n": n, "crash_rate": total / n, "half_width": half / n}))
        rhw = np.divide(half / n, total / n, out=np.full(len(n), np.inf), where=total > 0.0)
        required = rnot.required_tests(rhw[None, :], n, procedure.rhw)
        found = {
            "settled": figure(None, tests.n) if required.is_lower_limit else exactly(required.n[0]),
            "over_reference": figures.ratio(context.made[name].result["figures"]["crash_rate"], reference),
        }
        is_in = settled(context.made[name])
        answers |= {f"{name}.{key}": marked(each, settled=is_in) for key, each in found.items()}
    write_table(context.folder / CURVES, pa.Table.from_pandas(pd.concat(curves), preserve_index=False))
    return {"figures": answers}


def count_required_tests(step: RequiredNumbers, context: Context) -> dict[str, Any]:
    """RNoT of every step that is named, and of SCV beside NADE on the same shuffles of the same tests."""
    asked = context.rhw, context.confidence
    found = {name: _required(context.made[name], rnot.Procedure(*asked, step.shuffles), context) for name in step.of}
    pairs = {f"{step.of[0]}_over_{name}": (step.of[0], name) for name in step.of[1:]}
    if step.scv is not None:
        made, fewer = context.made[step.scv], rnot.Procedure(*asked, step.scv_shuffles, ratio=step.scv_ratio)
        found["nade_beside_scv"] = _required(made, fewer, context, step.scv_tests)
        found["scv"] = _required(made, fewer, context, step.scv_tests, scv=True)
        pairs["nade_over_scv"] = "nade_beside_scv", "scv"
    answers = {name: each.figure(context.confidence) for name, each in found.items()}
    ratios = {name: found[a].over(found[b], context.confidence) for name, (a, b) in pairs.items()}
    return {"figures": answers | ratios}


def _required(
    made: Made, procedure: rnot.Procedure, context: Context, first: int | None = None, *, scv: bool = False
) -> rnot.RequiredTests:
    """Of the mean of Y, or of what SCV claims, on all tests of a step or its first ones."""
    tests = tests_of(made).first(first)
    context.progress.stage(f"shuffles of {made.folder.name.rpartition('-')[0]}", None)
    block = rnot.first_block(made.folder / "run", tests.n) if scv else None
    return rnot.over_shuffles(tests, procedure, settled=settled(made), scv_of=block)
