"""Required numbers of tests: as rate and half-width settle, and the paper's averages over shuffles (RNoT, AAR)."""

from __future__ import annotations

from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from harness.estimators.block import Block, joined
from harness.runner.estimate import stored_blocks
from harness.vocabulary import FloatArray, IntArray
from studies.case_study.context import Context, Made
from studies.case_study.control_variates import cut_at
from studies.case_study.figures import exactly, figure, marked, mean_of, ratio, ratio_of_means
from studies.case_study.study_file import Convergence, RequiredNumbers
from studies.case_study.tested import Tests, read_tests, settled
from studies.required_tests import (
    Procedure,
    RequiredTests,
    acceleration,
    plain_rhw,
    required_tests,
    scv_rhw_of,
    total_and_half_width,
)
from studies.work import kept_parts, write_table

CURVES = "curves.parquet"


def draw_convergence(step: Convergence, context: Context) -> dict[str, Any]:
    """Curves as Parquet; how many tests each needed in the order in which it was tested; rates over the reference's."""
    procedure = Procedure(context.rhw, context.confidence)
    tables, figures = list[pa.Table](), dict[str, Any]()
    reference = context.made[step.reference].result["figures"]["crash_rate"]
    for name in step.of:
        tests = read_tests(context.made[name])
        n, rate, half = curve(tests, procedure)
        tables.append(pa.table({"step": [name] * len(n), "n": n, "crash_rate": rate, "half_width": half}))
        rhw = np.divide(half, rate, out=np.full(len(n), np.inf), where=rate > 0.0)
        required = required_tests(rhw[None, :], n, procedure.rhw)
        found = {
            "settled": figure(None, tests.n) if required.is_lower_limit else exactly(required.n[0]),
            "rhw": exactly(rhw[-1]) if np.isfinite(rhw[-1]) else figure(None),
            "over_reference": ratio(context.made[name].result["figures"]["crash_rate"], reference),
        }
        is_in = settled(context.made[name])
        figures |= {f"{name}.{key}": marked(each, settled=is_in) for key, each in found.items()}
    write_table(context.folder / CURVES, pa.concat_tables(tables))
    return {"figures": figures}


def curve(tests: Tests, procedure: Procedure) -> tuple[IntArray, FloatArray, FloatArray]:
    """Numbers of tests (g,), and after each the mean of Y and the half-width of its normal interval."""
    n = procedure.grid(tests.n)
    total, half = total_and_half_width(tests.y, np.searchsorted(tests.episode, n), n, procedure.z)
    return n, total / n, half / n


class _Found(NamedTuple):
    """RNoT of every shuffle of some tests, and whether their weights have come in."""

    rnot: RequiredTests
    tests: int
    settled: bool

    def figure(self, confidence: float) -> dict[str, Any]:
        """Mean over shuffles with its interval; a lower limit where some needed more tests than there were."""
        mean = mean_of(self.rnot.n.tolist(), confidence)
        if self.rnot.is_lower_limit:
            mean = figure(None if self.rnot.never_reached.all() else mean["value"], mean["low"] or mean["value"])
        return marked(mean, settled=self.settled)

    def over(self, other: _Found, confidence: float) -> dict[str, Any]:
        """AAR of the other one: ratio of the means, open where one of them is a lower limit."""
        found = ratio_of_means(self.rnot.n.tolist(), other.rnot.n.tolist(), confidence)
        side = acceleration(self.rnot, other.rnot)[1]
        if side == "at least":
            found = figure(found["value"], found["low"] or found["value"])
        elif side == "at most":
            found = figure(found["value"], None, found["high"] or found["value"])
        return marked(figure(None) if side == "unknown" else found, settled=self.settled and other.settled)


def count_required_tests(step: RequiredNumbers, context: Context) -> dict[str, Any]:
    """RNoT of every step that is named, and of SCV beside NADE on the same shuffles of the same tests."""
    asked = context.rhw, context.confidence
    found = {name: _plain(context.made[name], Procedure(*asked, step.shuffles), context) for name in step.of}
    pairs = {f"{step.of[0]}_over_{name}": (step.of[0], name) for name in step.of[1:]}
    if step.scv is not None:
        made, fewer = context.made[step.scv], Procedure(*asked, step.scv_shuffles, ratio=step.scv_ratio)
        found["nade_beside_scv"] = _plain(made, fewer, context, first=step.scv_tests)
        found["scv"] = _scv(made, fewer, context, first=step.scv_tests)
        pairs["nade_over_scv"] = "nade_beside_scv", "scv"
    for name, each in found.items():
        columns = {"shuffle": np.arange(len(each.rnot.n)), "tests": each.rnot.n}
        write_table(context.folder / f"{name}.parquet", pa.table({**columns, "never_reached": each.rnot.never_reached}))
    figures = {name: each.figure(context.confidence) for name, each in found.items()}
    ratios = {name: found[a].over(found[b], context.confidence) for name, (a, b) in pairs.items()}
    return {
        "never_reached": {name: int(np.count_nonzero(each.rnot.never_reached)) for name, each in found.items()},
        "shuffles": {name: len(each.rnot.n) for name, each in found.items()},
        "tests": {name: each.tests for name, each in found.items()},
        "figures": figures | ratios,
    }


def _plain(made: Made, procedure: Procedure, context: Context, *, first: int | None = None) -> _Found:
    """Of the mean of Y, on all tests of a step or its first ones."""
    tests = read_tests(made)
    n = min(tests.n, first or tests.n)
    kept = tests.episode < n
    context.progress.stage(f"shuffles of {made.folder.name.rpartition('-')[0]}", procedure.n_shuffles)
    rhw = plain_rhw(tests.weight[kept], n, procedure, lambda: context.progress.advance(1), tests.failed[kept])
    return _Found(required_tests(rhw, procedure.grid(n), procedure.rhw), n, settled(made))


def _scv(made: Made, procedure: Procedure, context: Context, *, first: int) -> _Found:
    """Of what SCV claims, a part for each shuffle; the tests are read only if any is missing."""
    n, tests = min(made.result["n"], first), list[Block]()

    def rhw_of(shuffle: int) -> pa.Table:
        if not tests:
            blocks = cut_at(stored_blocks(made.folder / "run", moments=True), [n])
            tests.append(joined(list(takewhile(lambda block: block.first_episode < n, blocks))))
        return pa.table({"rhw": scv_rhw_of(tests[0], procedure, shuffle)})

    tables = kept_parts(context.parts, "scv", range(procedure.n_shuffles), rhw_of, context.progress)
    rhw = np.array([table.column("rhw").to_numpy() for table in tables])
    return _Found(required_tests(rhw, procedure.grid(n), procedure.rhw), n, settled(made))
