"""Campaigns repeated, of one vehicle or in several forms: what they claim, beside what they truly scatter by."""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.runner.run import run_campaign
from harness.vocabulary import EstimatorName, FloatArray
from studies.case_study.counted import Claims
from studies.case_study.figures import figure, marked, mean_of, ratio_of_means, ratio_of_variances, tests_for
from studies.case_study.study import Context, Replications, Variants
from studies.case_study.tested import AT_ONCE, IN_THE_TWIN, figures_of_shells
from studies.replication.experiment import load_experiment
from studies.replication.run import REPLICATIONS, validate
from studies.replication.weighted import prepared_twin, twin_episodes
from studies.work import write_table


def replicate(step: Replications, context: Context) -> dict[str, Any]:
    """Results of a validation, and what one estimator gains over the one named before it, claimed and true.

    Where the mean of all replications is below the truth by more than chance, what each of them claims means nothing.
    """
    experiment = load_experiment(Path(step.experiment), step.set)
    judgements = validate(experiment, context.folder, workers=context.workers, progress=context.progress)
    rows = pq.read_table(context.folder / REPLICATIONS).to_pandas()
    n, confidence = experiment.campaign.stop.episodes, context.confidence
    per_relvar = tests_for(n, context.rhw, confidence)
    figures: dict[str, Any] = {}
    claims, rates, settled = dict[str, FloatArray](), dict[str, FloatArray](), True
    for one in judgements:
        name, centre, error = one["result"], 1.0 + one["bias"], 2.0 * one["bias_std_error"]
        settled &= not (missed := centre + error < 1.0)
        own = rows[rows["result"] == name]
        rates[name] = own["crash_rate"].to_numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            claims[name] = (own["std_error"].to_numpy() / rates[name]) ** 2 * per_relvar
        figures |= {
            f"{name}_true": _scattered(one["true_relvar"] * per_relvar, one["replications"], missed=missed),
            f"{name}_claimed": marked(mean_of(claims[name], confidence), settled=not missed),
            f"{name}_covers": figure(one["coverage"], one["coverage_low"], one["coverage_high"]),
            f"{name}_over_truth": figure(centre, centre - error, centre + error),
        }
    for plain, other in pairwise(claims):
        gain = ratio_of_means(claims[plain], claims[other], confidence)
        figures[f"{other}_gain_claimed"] = marked(gain, settled=settled)
        figures[f"{other}_gain_true"] = ratio_of_variances(rates[plain], rates[other], confidence)
    return {"tests": n, "replications": experiment.replications, "judgements": judgements, "figures": figures}


def _scattered(value: float, replications: int, *, missed: bool) -> dict[str, Any]:
    """Tests by the spread of replications, with two standard errors as if errors were normal.

    Where their mean is below the truth, what has not occurred in any of them is missing from the spread, too: it is a
    lower limit.
    """
    if missed:
        return figure(None, value)
    error = value * np.sqrt(2.0 / replications)
    return figure(value, max(value - 2.0 * error, 0.0), value + 2.0 * error)


def variants_of(step: Variants, *, shells: bool = False) -> dict[str, Campaign]:
    """The campaign in each of its forms, in the twin, by name; or the one of shells for the same vehicles."""
    file, always = (step.shells, step.shells_set) if shells else (step.campaign, step.set)
    if file is None:
        return {}
    always = [*always, *IN_THE_TWIN]
    settings = dict(step.settings)
    for chosen in product(*(options.items() for options in step.each_of)) if step.each_of else ():
        settings[", ".join(name for name, _ in chosen)] = [value for _, values in chosen for value in values]
    vehicles = {name: load_campaign(file, always, av=name) for name in step.avs}
    return vehicles | {name: load_campaign(file, [*always, *more]) for name, more in settings.items()}


def test_variants(step: Variants, context: Context) -> dict[str, Any]:
    """Test each in the twin, one to a worker, and each with shells, if asked for."""
    campaigns = variants_of(step)
    for campaign in campaigns.values():
        prepare(resolve(campaign), context.progress)  # tables are built once, before the workers start
    make = partial(claims_in_twin, step.tests, step.replications, context.rhw, context.confidence)
    jobs = [campaign.model_dump_json() for campaign in campaigns.values()]
    claims = context.by_workers(jobs, make)
    rows = [{"variant": name, **row} for name, row in zip(campaigns, claims, strict=True)]
    for k, (row, campaign) in enumerate(zip(rows, variants_of(step, shells=True).values(), strict=False)):
        folder = context.folder / f"shells-{k}"
        done = run_campaign(campaign, folder, workers=context.workers, resume=True, progress=context.progress)
        found = figures_of_shells(done, context.rhw)
        row |= {"shells_rate": found["crash_rate"], "shells_tests": found["tests_for_rhw"]}
    write_table(context.folder / "variants.parquet", pa.Table.from_pylist(rows))
    gains = {row["variant"]: row["gain_claimed"] for row in rows}
    mean = mean_of((gain["value"] for gain in gains.values()), context.confidence)
    return {"variants": rows, "figures": {**gains, "mean": marked(mean, settled=all(row["settled"] for row in rows))}}


def claims_in_twin(n: int, replications: int, rhw: float, confidence: float, campaign_json: str) -> dict[str, Any]:
    """What NADE and SCV say of n tests each, in so many campaigns, and what these truly scatter by."""
    campaign = Campaign.model_validate_json(campaign_json)
    asked: tuple[EstimatorName, ...] = ("nade", "scv") if campaign.testing.method == "step_mixture" else ("nade",)
    source, whole, rows = twin_episodes(campaign, campaign.seed, asked), Claims(with_scv=False), []
    for start in range(0, n * replications, n):
        claims = Claims()
        for first in range(start, start + n, AT_ONCE):
            block = source(first, min(AT_ONCE, start + n - first))
            whole.add(block)
            claims.add(block)
        rows.append(claims.row(rhw, confidence))
    prepared_twin.cache_clear()  # or a worker would keep the tables of all variants
    row = whole.row(rhw, confidence)
    tests = {name: [each[f"{name}_tests"] or math.nan for each in rows] for name in ("nade", "scv")}
    rates = {name: [each[f"{name}_rate"]["value"] or 0.0 for each in rows] for name in ("nade", "scv")}
    return {
        **row,
        "scv_tests": mean_of(tests["scv"], confidence),
        "gain_claimed": marked(ratio_of_means(tests["nade"], tests["scv"], confidence), settled=row["settled"]),
        "gain_true": ratio_of_variances(rates["nade"], rates["scv"], confidence),
        "difference": max((each["difference"] for each in rows if each["difference"] is not None), default=None),
    }
