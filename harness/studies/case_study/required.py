"""Required numbers of tests over shuffles, and their ratios: the paper's averages (RNoT, AAR)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa

from harness.arrays import FloatArray
from harness.estimators.block import Block
from harness.runner.stored_estimates import stored_blocks
from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import figure, quantiles
from harness.studies.case_study.study_file import RequiredNumbers
from harness.studies.case_study.tested import read_tests, write_table
from harness.studies.required_tests import (
    Procedure,
    RequiredTests,
    acceleration,
    joined,
    plain_rhw,
    required_tests,
    scv_rhw,
)


def count_required_tests(step: RequiredNumbers, context: Context) -> dict[str, Any]:
    """RNoT of every step that is named, and of SCV beside NADE on the same shuffles of the same tests."""
    found = {}
    for name in step.of:
        tests = read_tests(context.made[name])
        procedure = Procedure(context.rhw, context.confidence, step.shuffles)
        context.progress.stage(f"shuffles of {name}", step.shuffles)
        rhw = plain_rhw(tests.weight, tests.n, procedure, lambda: context.progress.advance(1), tests.failed)
        found[name] = required_tests(rhw, procedure.grid(tests.n), context.rhw)
    pairs = {f"{step.of[0]}_over_{name}": (found[step.of[0]], found[name]) for name in step.of[1:]}
    if step.scv is not None:
        found |= (both := _with_scv(step, context))
        pairs["nade_over_scv"] = both["nade_beside_scv"], both["scv"]
    for name, each in found.items():
        columns = {"shuffle": np.arange(len(each.n)), "tests": each.n, "never_reached": each.never_reached}
        write_table(context.folder / f"{name}.parquet", pa.table(columns))
    figures = {name: _figure(each, context.confidence) for name, each in found.items()}
    ratios = {name: _ratio(*both, context.confidence) for name, both in pairs.items()}
    return {
        "never_reached": {name: int(np.count_nonzero(each.never_reached)) for name, each in found.items()},
        "shuffles": {name: len(each.n) for name, each in found.items()},
        "figures": figures | ratios,
    }


def _with_scv(step: RequiredNumbers, context: Context) -> dict[str, RequiredTests]:
    run = context.made[str(step.scv)].folder / "run"
    tests = joined(list(_first(stored_blocks(run, moments=True), step.scv_tests)))
    procedure = Procedure(context.rhw, context.confidence, step.scv_shuffles, ratio=step.scv_ratio)
    grid, counted = procedure.grid(len(tests)), tests.crash | tests.failed
    context.progress.stage("shuffles of scv", step.scv_shuffles)
    rhw: dict[str, FloatArray] = {
        "nade_beside_scv": plain_rhw(
            np.exp(tests.log_weight[counted]), len(tests), procedure, failed=tests.failed[counted]
        ),
        "scv": scv_rhw(tests, procedure, lambda: context.progress.advance(1)),
    }
    return {name: required_tests(each, grid, context.rhw) for name, each in rhw.items()}


def _first(blocks: Iterator[Block], n: int) -> Iterator[Block]:
    for block in blocks:
        yield block.take(slice(0, n - block.first_episode))
        if block.first_episode + len(block) >= n:
            return


def _figure(found: RequiredTests, confidence: float) -> dict[str, Any]:
    """Mean over shuffles and the range of single ones; no upper end where some needed more tests than there were."""
    low, high = quantiles(found.n.astype(np.float64), confidence)
    if found.is_lower_limit:
        return figure(None if found.never_reached.all() else found.mean, low)
    return figure(found.mean, low, high)


def _ratio(above: RequiredTests, below: RequiredTests, confidence: float) -> dict[str, Any]:
    """AAR: ratio of the means, and the range of ratios of single shuffles, open where a mean is a lower limit."""
    value, side = acceleration(above, below)
    low, high = quantiles(above.n / below.n, confidence)
    if side == "unknown":
        return figure(None)
    return figure(value, None if side == "at most" else low, None if side == "at least" else high)
