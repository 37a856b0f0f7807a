"""How crash rates and their relative half-widths settle as tests come in: the paper's first result figures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyarrow as pa

from harness.arrays import FloatArray, IntArray
from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import exactly, figure, is_settled, marked
from harness.studies.case_study.study_file import Convergence
from harness.studies.case_study.tested import Tests, read_tests, settled
from harness.studies.kept_parts import write_table
from harness.studies.required_tests import Procedure, required_tests, total_and_half_width

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
    total, half = total_and_half_width(tests.y, np.searchsorted(tests.episode, n), n, procedure.z())
    return n, total / n, half / n


def ratio(above: dict[str, Any], below: dict[str, Any]) -> dict[str, Any]:
    """Ratio of two independent results, its limits from theirs on the logarithmic scale (Zou and Donner's MOVER)."""
    if not above["value"] or not below["value"]:
        return figure(None)
    value = above["value"] / below["value"]
    if not (above["low"] and below["low"]):
        return figure(value)
    down = math.hypot(math.log(above["value"] / above["low"]), math.log(below["high"] / below["value"]))
    up = math.hypot(math.log(above["high"] / above["value"]), math.log(below["value"] / below["low"]))
    return marked(figure(value, value * math.exp(-down), value * math.exp(up)), settled=is_settled(above, below))
