"""A campaign repeated: by what its estimates truly scatter, beside what each of them claims."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import figure, quantiles, tests_for
from harness.studies.case_study.study_file import Replications
from harness.studies.experiment import load_experiment
from harness.studies.results import REPLICATIONS
from harness.studies.run import validate


def replicate(step: Replications, context: Context) -> dict[str, Any]:
    """Results of `harness validate`, and what one estimator gains over the one named before it, claimed and true."""
    experiment = load_experiment(Path(step.experiment), step.set)
    done = validate(experiment, context.folder, workers=context.workers, progress=context.progress)
    rows = pq.read_table(context.folder / REPLICATIONS).to_pandas()
    figures: dict[str, Any] = {}
    n = experiment.campaign.stop.episodes
    for one in done.judgements:
        per_relvar = tests_for(n, context.rhw, context.confidence)
        missed = one.bias + 2.0 * one.bias_std_error < 0.0
        figures[f"{one.result}_true"] = _scattered(one.true_relvar * per_relvar, one.replications, missed=missed)
        figures[f"{one.result}_claimed"] = _claimed(rows[rows["result"] == one.result], per_relvar, context.confidence)
        figures[f"{one.result}_covers"] = figure(one.coverage, one.coverage_low, one.coverage_high)
        figures[f"{one.result}_over_truth"] = figure(
            1.0 + one.bias, *(1.0 + one.bias + side * 2.0 * one.bias_std_error for side in (-1.0, 1.0))
        )
    for plain, other in pairwise(dict.fromkeys(rows["result"])):
        a, b = (rows[rows["result"] == name].reset_index(drop=True) for name in (plain, other))
        claimed = (a["std_error"] / b["std_error"]).to_numpy() ** 2
        claimed = claimed[np.isfinite(claimed)]
        if len(claimed):
            figures[f"{other}_gain_claimed"] = figure(
                float(np.median(claimed)), *quantiles(claimed, context.confidence)
            )
        figures[f"{other}_gain_true"] = _gain(a["crash_rate"].to_numpy(), b["crash_rate"].to_numpy())
    judgements = [one.to_json() for one in done.judgements]
    return {"tests": n, "replications": experiment.replications, "judgements": judgements, "figures": figures}


def _claimed(rows: pd.DataFrame, per_relvar: float, confidence: float) -> dict[str, Any]:
    """Tests by what each replication says of its own rate and error: the median, and the range of single ones."""
    found = rows[rows["crash_rate"] > 0.0]
    if found.empty:
        return figure(None)
    relvar = ((found["std_error"] / found["crash_rate"]) ** 2).to_numpy() * per_relvar
    return figure(float(np.median(relvar)), *quantiles(relvar, confidence))


def _scattered(value: float, replications: int, *, missed: bool) -> dict[str, Any]:
    """Tests by the spread of replications, with two standard errors as if errors were normal.

    Where their mean is below the truth, what has not occurred in any of them is missing from the spread, too: it is a
    lower limit.
    """
    if missed:
        return figure(None, value)
    error = value * np.sqrt(2.0 / replications)
    return figure(value, max(value - 2.0 * error, 0.0), value + 2.0 * error)


def _gain(plain: np.ndarray, other: np.ndarray) -> dict[str, Any]:
    """Ratio of the variances of two estimates of the same tests; limits from leaving out one replication at a time."""
    if not (np.var(plain) > 0.0 and np.var(other) > 0.0):
        return figure(None)
    value = float(np.var(plain) / np.var(other))
    left = [float(np.var(np.delete(plain, k)) / np.var(np.delete(other, k))) for k in range(len(plain))]
    error = float(np.std(left)) * np.sqrt(len(left) - 1)
    return figure(value, value - 2.0 * error, value + 2.0 * error)
