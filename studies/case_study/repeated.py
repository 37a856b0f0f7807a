"""Campaigns repeated, of one vehicle or in several forms: what they claim, beside what they truly scatter by."""

from __future__ import annotations

import math
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import ttest_1samp

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.estimators.doubly_robust import DoublyRobust
from harness.estimators.scv import Scv
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import EstimatorName, FloatArray
from studies.case_study import figures
from studies.case_study.counted import Claims, KnownMeans
from studies.case_study.figures import figure, marked, range_of
from studies.case_study.study import Context, Variants
from studies.case_study.tested import AT_ONCE, IN_THE_TWIN
from studies.replication.weighted import prepared_twin, twin_episodes
from studies.rnot import Procedure, Tests, over_shuffles


def variants_of(step: Variants) -> dict[str, Campaign]:
    """The campaign in each of its forms, in the twin, by name."""
    file, always = step.campaign, [*step.set, *IN_THE_TWIN]
    settings = {**step.settings, **{f"ε = {each:g}": [f"testing.epsilon={each}"] for each in step.epsilons}}
    for chosen in product(*(options.items() for options in step.each_of)) if step.each_of else ():
        settings[", ".join(name for name, _ in chosen)] = [value for _, values in chosen for value in values]
    vehicles = {name: load_campaign(file, always, av=name) for name in step.avs}
    return vehicles | {name: load_campaign(file, [*always, *more]) for name, more in settings.items()}


SHOWN = ("true", "rnot", "gain_true", "scv_claimed")
"""Figures of each variant beside its claimed gain."""


def test_variants(step: Variants, context: Context) -> dict[str, Any]:
    """Test each in the twin, one to a worker."""
    campaigns = variants_of(step)
    for campaign in campaigns.values():
        prepare(resolve(campaign), context.progress)  # tables are built once, before the workers start
    reference = None if step.reference is None else context.made[step.reference].result["figures"]["crash_rate"]
    make = partial(claims_in_twin, step, context.rhw, context.confidence, reference and reference["value"])
    jobs = [campaign.model_dump_json() for campaign in campaigns.values()]
    claims = context.by_workers(jobs, make)
    rows = [{"variant": name, **row} for name, row in zip(campaigns, claims, strict=True)]
    answers = {row["variant"]: row["gain_claimed"] for row in rows}
    mean = figures.mean_of((gain["value"] for gain in answers.values()), context.confidence)
    answers |= {f"{key}, {row['variant']}": row[key] for row in rows for key in SHOWN}
    answers["mean"] = marked(mean, settled=all(row["settled"] for row in rows))
    answers["minimum_at"] = _minimum_at({name: answers[name] for name in step.avs})
    if step.means:
        answers["gain_known"] = range_of(
            sorted((row["gain_known"] for row in rows), key=lambda each: -(each["value"] or 0.0))
        )
    if step.reference:
        best = min(rows, key=lambda row: float(row["rnot"]["value"] or math.inf))
        answers["most_frequent_steps"] = range_of(
            [figures.exactly(row["most_frequent_steps"]) for row in (best, *rows)]
        )
        answers["rnot_range"] = range_of([row["rnot"] for row in (best, *rows)])
    return {"variants": rows, "figures": answers}


def _minimum_at(gains: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The number in the name of the variant with the smallest gain, and the range of those that may have it."""
    known = {name: gain for name, gain in gains.items() if gain["high"] is not None}
    if not known:
        return figure(None)
    lowest = min(known.values(), key=lambda gain: float(gain["value"]))
    at = {float(name.rpartition("-")[2]): gain for name, gain in known.items() if name.startswith("alpha-")}
    may = [number for number, gain in at.items() if gain["low"] <= lowest["high"]]
    value = next((number for number, gain in at.items() if gain is lowest), None)
    return marked(
        figure(value, min(may, default=None), max(may, default=None)), settled=figures.is_settled(*known.values())
    )


def claims_in_twin(
    step: Variants, rhw: float, confidence: float, reference: float | None, campaign_json: str
) -> dict[str, Any]:
    """What NADE and SCV say of a variant's tests in each of its campaigns, and what these truly scatter by."""
    campaign, n = Campaign.model_validate_json(campaign_json), step.tests
    asked: tuple[EstimatorName, ...] = ("nade", "scv") if campaign.testing.method == "step_mixture" else ("nade",)
    source, whole = twin_episodes(campaign, campaign.seed, asked), Claims(with_scv=False)
    rows, parts, steps = list[dict[str, Any]](), list[Tests](), np.zeros(0, np.int64)
    known, left = None, (list[float](), list[float]())
    if step.means:
        others, stop = Scv(), n * step.replications + step.means
        for first in range(n * step.replications, stop, AT_ONCE):
            others.add(source(first, min(AT_ONCE, stop - first)))
        known = KnownMeans(others)
    for start in range(0, n * step.replications, n):
        claims, dr = Claims(), DoublyRobust()
        for first in range(start, start + n, AT_ONCE):
            block = source(first, min(AT_ONCE, start + n - first))
            whole.add(block)
            claims.add(block)
            if known:
                known.add(block)
            if campaign.sampling.mixes:
                dr.add(block)
            parts.append(Tests.of_block(block))
            counts = np.bincount(block.n_control_steps, minlength=len(steps))
            steps = counts + np.pad(steps, (0, len(counts) - len(steps)))
        rows.append(claims.row(rhw, confidence))
        if details := dr.result(confidence).details if rows[-1]["nade_rhw"] and campaign.sampling.mixes else {}:
            left[0].append(details["plain_std_error"] ** 2)
            left[1].append(details["residual_std_error"] ** 2)
    prepared_twin.cache_clear()  # or a worker would keep the tables of all variants
    row = whole.row(rhw, confidence)
    tests = {name: [each[f"{name}_tests"] or math.nan for each in rows] for name in ("nade", "scv")}
    rates = {name: np.array([each[f"{name}_rate"]["value"] or 0.0 for each in rows]) for name in ("nade", "scv")}
    rnot = figure(None)
    if step.shuffles:
        procedure = Procedure(rhw, confidence, step.shuffles)
        rnot = over_shuffles(Tests.joined(parts), procedure, settled=row["settled"]).figure(confidence)
    return {
        **row,
        "claimed": marked(figures.mean_of(tests["nade"], confidence), settled=row["settled"]),
        "true": true_tests(rates["nade"], reference, figures.tests_for(n, rhw, confidence)),
        "rnot": rnot,
        "most_frequent_steps": int(np.argmax(steps[1:]) + 1) if len(steps) > 1 else 0,
        "covers": figures.covered([each["nade_rate"] for each in rows], reference),
        "scv_claimed": marked(figures.mean_of(tests["scv"], confidence), settled=row["settled"]),
        "gain_claimed": marked(figures.ratio_of_means(tests["nade"], tests["scv"], confidence), settled=row["settled"]),
        "gain_true": figures.ratio_of_variances(rates["nade"], rates["scv"], confidence),
        **(known.row(confidence) if known else {}),
        "gain_dr": marked(figures.ratio_of_means(*left, confidence), settled=row["settled"]),
        "difference": max((each["difference"] for each in rows if each["difference"] is not None), default=None),
    }


MISSED = 1e-3
"""p-value below which the mean of repeated campaigns counts as too small: large weights have not occurred."""


def true_tests(rates: FloatArray, reference: float | None, per_relvar: float) -> dict[str, Any]:
    """Tests by the spread of repeated estimates around a known rate, with two standard errors as if it were normal.

    Where the mean of the estimates is below that, what has not occurred in any campaign is missing from the spread,
    too: it is a lower limit.
    """
    if reference is None or len(rates) < 2:
        return figure(None)
    errors = rates / reference - 1.0
    tests = per_relvar * float(np.mean(errors**2))
    if ttest_1samp(errors, 0.0, alternative="less").pvalue < MISSED:
        return figure(None, tests)
    error = 2.0 * tests * math.sqrt(2.0 / len(errors))
    return figure(tests, max(tests - error, 0.0), tests + error)
