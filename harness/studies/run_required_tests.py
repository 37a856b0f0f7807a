"""RNoT and AAR of stored runs: what `harness rnot` prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.arrays import BoolArray, FloatArray
from harness.campaign.loading import load_campaign
from harness.errors import HarnessError
from harness.estimators.block import Block, joined
from harness.estimators.estimate import finite_json
from harness.estimators.nade import Nade, Nde
from harness.estimators.scv import Scv
from harness.progress import Progress, SilentProgress
from harness.runner.stored_estimates import stored_blocks
from harness.studies.required_tests import (
    Procedure,
    RequiredTests,
    acceleration,
    plain_rhw,
    required_tests,
    scv_rhw,
)

RnotEstimator = Literal["nde", "nade", "scv"]
_REFUSAL = {"nde": Nde.refusal, "nade": Nade.refusal, "scv": Scv.refusal}
SCV_REMARK = (
    "rests on the variance that scv claims, which is too small (docs/scv-defect.md): this is the number that the "
    "published procedure reports, not the number of tests that is needed"
)


@dataclass(frozen=True)
class _Run:
    """Tests of a run, as far as the asked estimators read them; ``whole`` only where `scv` is to be fitted.

    ``weights`` (k,) are those of the tests that crashed or failed, ``failed`` (k,) says which have failed.
    """

    n_tests: int
    weights: FloatArray
    failed: BoolArray
    sample: Block
    whole: Block | None


def required_tests_of_runs(
    folders: Sequence[Path],
    procedure: Procedure,
    *,
    estimators: Sequence[RnotEstimator] = (),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """RNoT of every run and estimator, and its AAR over the first of them, as JSON content.

    The default estimator is the plain one of each run: ``nde`` for naturalistic tests, ``nade`` for weighted ones.

    Raises
    ------
    HarnessError
        If a folder is not a run, its records are damaged or incomplete, or its tests were drawn from shells.
    """
    told = progress or SilentProgress()
    reference: RequiredTests | None = None
    rows = []
    for folder in folders:
        run = _read(folder, with_ratios="scv" in estimators)
        plain: RnotEstimator = "nde" if run.sample.method == "nde" else "nade"
        tests = {"n_episodes": run.n_tests, "n_crashes": int(np.count_nonzero(~run.failed))}
        for name in dict.fromkeys(estimators or [plain]):
            told.stage(f"{folder.name} {name}", procedure.n_shuffles)
            row = {"run": str(folder), "estimator": name, **tests}
            if reason := _REFUSAL[name](run.sample):
                rows.append({**row, "mean": None, "reason": reason})
                continue
            found = _found(run, name, procedure, told)
            reference = reference or found
            rows.append(row | _row(run, name, found, reference, procedure))
    content: dict[str, Any] = finite_json({**asdict(procedure), "rows": rows})
    return content


def _read(folder: Path, *, with_ratios: bool) -> _Run:
    method = load_campaign(folder / "campaign.yaml", check_files=False).testing.method
    if method == "shells":
        raise HarnessError(
            str(folder),
            found="tests drawn from shells, of which each has its own probability",
            expected="tests that can change places: drawn by nde, forced, step_mixture or episode_mixture",
            mend="For shells the number of tests is what the run itself needed: see docs/shells.md.",
        )
    weights, failed, kept, sample, n = [], [], [], None, 0
    for block in stored_blocks(folder, moments=with_ratios):
        sample = sample or block
        counted = block.crash | block.failed
        weights.append(np.exp(block.log_weight[counted]))
        failed.append(block.failed[counted])
        n += len(block)
        if with_ratios and Scv.refusal(block) is None:
            kept.append(block)
    if sample is None:
        raise HarnessError(str(folder), found="no tests on record", expected="a run", mend="Run the campaign first.")
    return _Run(n, np.concatenate(weights), np.concatenate(failed), sample, joined(kept) if kept else None)


def _found(run: _Run, name: RnotEstimator, procedure: Procedure, progress: Progress) -> RequiredTests:
    def done() -> None:
        progress.advance(1)

    if name == "scv":
        assert run.whole is not None
        rhw = scv_rhw(run.whole, procedure, done)
    else:
        rhw = plain_rhw(run.weights, run.n_tests, procedure, done, run.failed)
    return required_tests(rhw, procedure.grid(run.n_tests), procedure.rhw)


def _row(
    run: _Run, name: RnotEstimator, found: RequiredTests, reference: RequiredTests, procedure: Procedure
) -> dict[str, Any]:
    grid = procedure.grid(run.n_tests)
    ratio, side = acceleration(reference, found)
    return {
        "grid": f"{grid[0]:,} to {grid[-1]:,} by {procedure.ratio - 1.0:.3g} n ({len(grid)} looks)",
        "grid_points": len(grid),
        "total": int(grid[-1]),
        "mean": found.mean,
        "mean_is_lower_limit": found.is_lower_limit,
        "low_5": found.quantile(0.05),
        "high_95": found.quantile(0.95),
        "never_reached": int(np.count_nonzero(found.never_reached)),
        "never_above": int(np.count_nonzero(found.never_above)),
        "aar": None if side == "unknown" else ratio,
        "aar_is": side,
        "remarks": _remarks(run, name, found, int(grid[-1]), procedure),
    }


def _remarks(run: _Run, name: RnotEstimator, found: RequiredTests, total: int, procedure: Procedure) -> list[str]:
    remarks, n_shuffles = [SCV_REMARK] if name == "scv" else [], procedure.n_shuffles
    if run.failed.any():
        remarks.append(
            f"{np.count_nonzero(run.failed)} tests failed: the lower limit counts them as no crash, the upper one "
            "as crashes"
        )
    if found.is_lower_limit:
        remarks.append(
            f"{np.count_nonzero(found.never_reached)} of {n_shuffles} shuffles are above RHW {procedure.rhw:g} at "
            f"{total:,} tests and count as {total:,}: the mean is a lower limit"
        )
    if found.never_above.any():
        remarks.append(
            f"{np.count_nonzero(found.never_above)} of {n_shuffles} shuffles are nowhere above RHW {procedure.rhw:g}: "
            "each counts with the n of its largest RHW, as in the paper"
        )
    if not found.is_lower_limit and found.quantile(0.95) > run.n_tests / 2:
        remarks.append(
            f"above half of the {run.n_tests:,} tests on record shuffles of the same tests hardly differ: ask a longer "
            "run for a mean and a range to rely on"
        )
    return remarks
