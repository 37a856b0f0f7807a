"""One campaign in several forms: Table I's vehicles, or other settings of the method, and what each claims."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from typing import Any

import pyarrow as pa

from harness.campaign.loading import load_campaign
from harness.campaign.models import Campaign
from harness.estimators import accumulator
from harness.methods import EstimatorName
from harness.records.folder import write_json
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import exactly, figure, tests_for, z_of
from harness.studies.case_study.study_file import Variants
from harness.studies.case_study.tested import AT_ONCE, write_table
from harness.studies.run import worker_processes
from harness.studies.weighted_campaign import TwinEpisodes


def variants_of(step: Variants) -> dict[str, Campaign]:
    """The campaign in each of its forms, in the twin, by name."""
    always = [*step.set, "world.engine=twin", "records.traces=none", "records.trace_share=0.0"]
    vehicles = {name: load_campaign(step.campaign, always, av=name) for name in step.avs}
    return vehicles | {name: load_campaign(step.campaign, [*always, *more]) for name, more in step.settings.items()}


def test_variants(step: Variants, context: Context) -> dict[str, Any]:
    """Test each in the twin, one to a worker; rows on disk are taken as they are."""
    campaigns = variants_of(step)
    places = {name: context.folder / f"variant-{k}.json" for k, name in enumerate(campaigns)}
    missing = [name for name, place in places.items() if not place.is_file()]
    for name in missing:
        prepare(resolve(campaigns[name]), context.progress)  # tables are built once, before the workers start
    context.progress.stage(context.name, len(campaigns), done=len(campaigns) - len(missing))
    with worker_processes(context.workers) as executor:
        work = partial(claims_in_twin, step.tests, context.confidence)
        jobs = [campaigns[name].model_dump_json() for name in missing]
        for name, row in zip(missing, executor.map(work, jobs), strict=True):
            write_json(places[name], _in_tests({"variant": name, **row}, context))
            context.progress.advance(1)
    rows = [json.loads(place.read_text(encoding="utf-8")) for place in places.values()]
    write_table(context.folder / "variants.parquet", pa.Table.from_pylist(rows))
    gains = {row["variant"]: row["gain_claimed"] for row in rows}
    known = [gain for gain in gains.values() if gain is not None]
    figures = {name: figure(None) if gain is None else exactly(gain) for name, gain in gains.items()}
    return {
        "variants": rows,
        "figures": {**figures, "mean": exactly(sum(known) / len(known)) if known else figure(None)},
    }


def claims_in_twin(n: int, confidence: float, campaign_json: str) -> dict[str, Any]:
    """What NADE, and SCV where it is defined, say of the same n tests."""
    campaign = Campaign.model_validate_json(campaign_json)
    names: tuple[EstimatorName, ...] = ("nade", "scv") if campaign.testing.method == "step_mixture" else ("nade",)
    source, states = TwinEpisodes(campaign, campaign.seed, names), {name: accumulator(name) for name in names}
    for first in range(0, n, AT_ONCE):
        block = source.block(first, min(AT_ONCE, n - first))
        for state in states.values():
            state.add(block)
    found = {name: state.result(confidence) for name, state in states.items()}
    nade, scv = found["nade"], found.get("scv")
    rate, half = nade.crash_rate, z_of(confidence) * nade.std_error
    weighed = scv is not None and rate > 0.0 and scv.std_error > 0.0
    return {
        "n_crashes": nade.n_crashes,
        "crash_rate": {"value": rate, "low": max(rate - half, 0.0), "high": rate + half},
        "relvar_nade": _relvar(n, rate, nade.std_error),
        "relvar_scv": None if scv is None else _relvar(n, rate, scv.std_error),
        "gain_claimed": (nade.std_error / scv.std_error) ** 2 if scv is not None and weighed else None,
        "difference": abs(scv.crash_rate / rate - 1.0) if scv is not None and weighed else None,
        "largest_weight_share": nade.largest_weight_share,
    }


def _relvar(n: int, rate: float, std_error: float) -> float | None:
    return n * (std_error / rate) ** 2 if rate > 0.0 else None


def _in_tests(row: Mapping[str, Any], context: Context) -> dict[str, Any]:
    """A row with numbers of tests in the place of relative variances."""
    relvar = {name: row[f"relvar_{name}"] for name in ("nade", "scv")}
    tests = {
        f"tests_{name}": None if x is None else tests_for(x, context.rhw, context.confidence)
        for name, x in relvar.items()
    }
    return {key: value for key, value in row.items() if not key.startswith("relvar_")} | tests
