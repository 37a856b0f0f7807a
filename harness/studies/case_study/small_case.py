"""Where the published method works: the 2022 conference version's smaller case, with its exact answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from harness.estimators.estimate import Estimate
from harness.estimators.nade import Nade
from harness.estimators.scv import Scv
from harness.studies.case_study.context import Context
from harness.studies.case_study.figures import exactly, figure, quantiles, tests_for, z_of
from harness.studies.case_study.small_world import Proposal, SmallWorld, small_world
from harness.studies.case_study.study_file import SmallCase
from harness.studies.case_study.tested import write_table


def answer_small_case(step: SmallCase, context: Context) -> dict[str, Any]:
    """Exact rate and variances, and what drawn tests claim, for every challenge and epsilon."""
    world = small_world(step.lane_change_level)
    settings = [(recursive, epsilon) for recursive in (False, True) for epsilon in step.epsilons]
    context.progress.stage("small case", len(settings))
    rows = []
    for place, (recursive, epsilon) in enumerate(settings):
        rows.append(_row(world, epsilon, step, context, place, recursive=recursive))
        context.progress.advance(1)
    write_table(context.folder / "settings.parquet", pa.Table.from_pylist(rows))
    published = rows[0]
    nde = tests_for(1.0 / world.crash_rate - 1.0, step.rhw, context.confidence)
    figures = {
        "crash_rate": exactly(world.crash_rate),
        "nde": exactly(nde),
        "nade": exactly(published["nade_exact"]),
        "nade_gain": exactly(nde / published["nade_exact"]),
        "scv_claimed": figure(published["scv_claimed"], *published["scv_claims"]),
        "fewest_claimed": _fewest(rows),
        "fewest_exact": exactly(min(row["nade_exact"] for row in rows)),
        "scv_gain_true": figure(published["gain_true"]),
    }
    return {
        "crash_rate": world.crash_rate,
        "rhw": step.rhw,
        "steps": len(world.levels),
        "settings": rows,
        "figures": figures,
    }


def _row(
    world: SmallWorld, epsilon: float, step: SmallCase, context: Context, place: int, *, recursive: bool
) -> dict[str, Any]:
    """One setting: its exact variance, what NADE and SCV claim of the same tests, and what repeating both shows."""
    proposals = world.proposals(epsilon, recursive=recursive)
    once = _both(world, proposals, step.tests, context, [2, place])
    many = [_both(world, proposals, step.tests_of_draw, context, [3, place, k]) for k in range(step.draws)]
    true = {name: _relative_square(world, [each[name] for each in many]) * step.tests_of_draw for name in once}
    tests = {
        "nade_exact": world.relvar(proposals),
        **{f"{name}_claimed": _claimed(found) for name, found in once.items()},
        **{f"{name}_repeated": relvar for name, relvar in true.items()},
    }
    nade, scv = once["nade"].crash_rate, once["scv"].crash_rate
    return {
        "challenge": "recursive" if recursive else "immediate",
        "epsilon": epsilon,
        "rate_over_truth": nade / world.crash_rate,
        "difference": abs(scv / nade - 1.0) if nade > 0.0 else None,
        **{key: None if x is None else tests_for(x, step.rhw, context.confidence) for key, x in tests.items()},
        "scv_claims": _range([_claimed(each["scv"]) for each in many], step.rhw, context.confidence),
        **{f"{name}_covers": _coverage(world, [each[name] for each in many]) for name in once},
        "gain_true": true["nade"] / true["scv"] if true["scv"] > 0.0 else None,
    }


def _both(
    world: SmallWorld, proposals: Sequence[Proposal], n: int, context: Context, seed: list[int]
) -> dict[str, Estimate]:
    """Both estimates of the same n tests."""
    block, found = world.draw(proposals, n, np.random.default_rng(seed)), {}
    for name, state in (("nade", Nade()), ("scv", Scv())):
        state.add(block)
        found[name] = state.result(context.confidence)
    return found


def _claimed(found: Estimate) -> float | None:
    """Relative variance per test that an estimate claims."""
    return found.n_episodes * (found.std_error / found.crash_rate) ** 2 if found.crash_rate > 0.0 else None


def _range(relvar: Sequence[float | None], rhw: float, confidence: float) -> list[float] | list[None]:
    """Tests that single campaigns claim, from and to."""
    known = [tests_for(each, rhw, confidence) for each in relvar if each is not None]
    return list(quantiles(np.array(known), confidence)) if known else [None, None]


def _fewest(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The setting in which SCV claims to need fewest tests."""
    known = [row for row in rows if row["scv_claimed"] is not None]
    least = min(known, key=lambda row: float(row["scv_claimed"]), default=None)
    return figure(None) if least is None else figure(least["scv_claimed"], *least["scv_claims"])


def _relative_square(world: SmallWorld, found: Sequence[Estimate]) -> float:
    """Mean square of the relative errors."""
    return float(np.mean([(each.crash_rate / world.crash_rate - 1.0) ** 2 for each in found]))


def _coverage(world: SmallWorld, found: Sequence[Estimate]) -> float:
    """Share of the normal intervals that hold the truth."""
    return float(np.mean([abs(x.crash_rate - world.crash_rate) <= z_of(x.confidence) * x.std_error for x in found]))
