"""A campaign repeated: by what its estimates truly scatter, beside what each of them claims."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import (
    figure,
    marked,
    mean_of,
    ratio_of_means,
    ratio_of_variances,
    tests_for,
)
from harness.studies.case_study.study_file import Replications
from harness.studies.experiment import load_experiment
from harness.studies.run import REPLICATIONS, validate


def replicate(step: Replications, context: Context) -> dict[str, Any]:
    """Results of `harness validate`, and what one estimator gains over the one named before it, claimed and true.

    Where the mean of all replications is below the truth by more than chance, what each of them claims means nothing.
    """
    experiment, parts = load_experiment(Path(step.experiment), step.set), context.parts
    judgements = validate(experiment, context.folder, workers=context.workers, progress=context.progress, parts=parts)
    rows = pq.read_table(context.folder / REPLICATIONS).to_pandas()
    n, confidence = experiment.campaign.stop.episodes, context.confidence
    per_relvar = tests_for(n, context.rhw, confidence)
    figures: dict[str, Any] = {}
    claims, rates, settled = {}, {}, True
    for one in judgements:
        missed = one.bias + 2.0 * one.bias_std_error < 0.0
        settled &= not missed
        own = rows[rows["result"] == one.result]
        rates[one.result] = own["crash_rate"].to_numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            claims[one.result] = (own["std_error"].to_numpy() / rates[one.result]) ** 2 * per_relvar
        found = {
            "true": _scattered(one.true_relvar * per_relvar, one.replications, missed=missed),
            "claimed": marked(mean_of(claims[one.result], confidence), settled=not missed),
            "covers": figure(one.coverage, one.coverage_low, one.coverage_high),
            "over_truth": figure(
                1.0 + one.bias, *(1.0 + one.bias + side * 2.0 * one.bias_std_error for side in (-1.0, 1.0))
            ),
        }
        figures |= {f"{one.result}_{key}": each for key, each in found.items()}
    for plain, other in pairwise(claims):
        gain = ratio_of_means(claims[plain], claims[other], confidence)
        figures[f"{other}_gain_claimed"] = marked(gain, settled=settled)
        figures[f"{other}_gain_true"] = ratio_of_variances(rates[plain], rates[other], confidence)
    said = [one.to_json() for one in judgements]
    return {"tests": n, "replications": experiment.replications, "judgements": said, "figures": figures}


def _scattered(value: float, replications: int, *, missed: bool) -> dict[str, Any]:
    """Tests by the spread of replications, with two standard errors as if errors were normal.

    Where their mean is below the truth, what has not occurred in any of them is missing from the spread, too: it is a
    lower limit.
    """
    if missed:
        return figure(None, value)
    error = value * np.sqrt(2.0 / replications)
    return figure(value, max(value - 2.0 * error, 0.0), value + 2.0 * error)
