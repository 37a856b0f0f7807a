"""Where the published method works: the 2022 conference version's smaller case, with its exact answers."""

from __future__ import annotations

from functools import cache, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from studies.case_study.context import Context
from studies.case_study.control_variates import Claims
from studies.case_study.figures import exactly, figure, marked, mean_of, tests_for
from studies.case_study.small_world import SmallWorld, small_world
from studies.case_study.study_file import SmallCase
from studies.work import write_table

_world = cache(small_world)
TRUE_WITHIN = 2.0
"""Factor between NADE's claim and the exact number up to which claims of a setting count, as in the page's verdicts."""


class _Setting(NamedTuple):
    """Of the importance functions; ``place`` is among all, and seeds its tests."""

    place: int
    recursive: bool
    threshold: float
    epsilon: float


def answer_small_case(step: SmallCase, context: Context) -> dict[str, Any]:
    """Exact rate and variances, and what drawn tests claim, for every challenge, threshold and epsilon."""
    every = product((False, True), step.thresholds, step.epsilons)
    settings = [_Setting(place, *setting) for place, setting in enumerate(every)]
    make = partial(claims_of_setting, step, context.confidence)
    rows = [table.to_pylist()[0] for table in context.by_workers(settings, make)]
    write_table(context.folder / "settings.parquet", pa.Table.from_pylist(rows))
    rate, published = _world(step.lane_change_level).crash_rate, rows[0]
    nearest = {name: _nearest(name, wanted, rows) for name, wanted in step.reported.items()}
    return {
        "crash_rate": rate,
        "rhw": step.rhw,
        "steps": len(_world(step.lane_change_level).levels),
        "settings": rows,
        "nearest": nearest,
        "figures": {
            "nde": exactly(tests_for(1.0 / rate - 1.0, step.rhw, context.confidence)),
            "nade": exactly(published["nade_exact"]),
            "scv_claimed": published["scv_claimed"],
            **{f"nearest_{name}": row[name] for name, row in nearest.items()},
        },
    }


def claims_of_setting(step: SmallCase, confidence: float, setting: _Setting) -> pa.Table:
    """One setting: its exact variance, what NADE and SCV claim of the same tests, and what repeating both shows."""
    world, n = _world(step.lane_change_level), step.tests_of_draw
    proposals = world.proposals(setting.epsilon, recursive=setting.recursive, threshold=setting.threshold)

    def claims(tests: int, *seed: int) -> dict[str, Any]:
        found = Claims()
        found.add(world.draw(proposals, tests, np.random.default_rng(seed)))
        return found.row(step.rhw, confidence)

    once = claims(step.tests, 2, setting.place)
    many = [claims(n, 3, setting.place, k) for k in range(step.draws)]
    row: dict[str, Any] = {
        "challenge": "recursive" if setting.recursive else "immediate",
        "threshold": setting.threshold,
        "epsilon": setting.epsilon,
        "mean_weight": once["mean_weight"],
        "difference": once["difference"],
        "nade_exact": tests_for(world.relvar(proposals), step.rhw, confidence),
    }
    holds = _holds(mean_of((each["nade_tests"] for each in many), confidence)["value"], row["nade_exact"])
    for name in ("nade", "scv"):
        said = mean_of((each[f"{name}_tests"] for each in many), confidence)
        square = np.mean([((each[f"{name}_rate"]["value"] or 0.0) / world.crash_rate - 1.0) ** 2 for each in many])
        row |= {
            f"{name}_claimed_once": once[f"{name}_tests"],
            f"{name}_claimed": marked(said, settled=once["settled"] and holds),
            f"{name}_repeated": tests_for(n * float(square), step.rhw, confidence),
            f"{name}_covers": float(np.mean([_covers(each[f"{name}_rate"], world) for each in many])),
        }
    return pa.Table.from_pylist([row])


def _holds(claimed: float | None, exact: float) -> bool:
    """Whether NADE claims what is known to be true, about."""
    return claimed is not None and exact / TRUE_WITHIN <= claimed <= exact * TRUE_WITHIN


def _covers(rate: dict[str, Any], world: SmallWorld) -> bool:
    """Whether a normal interval holds the truth; that of no crash holds nothing."""
    return rate["value"] is not None and rate["low"] <= world.crash_rate <= rate["high"]


def _nearest(name: str, wanted: float, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The setting whose number is nearest to a reported one: NADE's exact one, or what SCV claims."""

    def found(row: dict[str, Any]) -> dict[str, Any]:
        claimed: dict[str, Any] = row["scv_claimed"]
        return exactly(row["nade_exact"]) if name == "nade" else claimed

    known = [row for row in rows if found(row)["value"] and found(row).get("settled", True) is not False]
    row = min(known, key=lambda each: abs(np.log(found(each)["value"] / wanted)), default=None)
    if row is None:
        return {name: figure(None)}
    return {name: found(row), **{key: row[key] for key in ("challenge", "threshold", "epsilon")}}
