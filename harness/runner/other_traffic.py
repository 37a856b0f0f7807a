"""What a stored run says of other traffic, of traffic that was fitted, and of what is assumed about its own.

Traffic that was fitted names replicates: environments that other trajectories of the same kind would have given. Each
is answered by the same tests, from few paths that are the same in all of them (`harness.runner.stored_shells`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.special import gammainc, gammaincinv

from harness.arguments import Confidence, checked
from harness.campaign.files import shipped_or_own
from harness.errors import CampaignError, RunFolderError
from harness.estimators.answer import estimate_blocks
from harness.estimators.estimate import finite_json
from harness.estimators.pairs import PairedShells, paired_estimate
from harness.estimators.short_answer import CARRIES
from harness.estimators.traffic import ONE_LAW, TrafficError, Unseen, is_open, rows, too_few, uncertain
from harness.families.cut_in.loading import load_parameters
from harness.families.cut_in.parameters import (
    OF_REPLICATES,
    SHIPPED_FOLDER,
    SMALLEST_SHARE,
    AcceptanceSteps,
    EnvironmentParameters,
    content_hash,
)
from harness.numbers import number, share
from harness.pool.cut_ins import Pool
from harness.pool.moved import FewPaths
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.records.folder import read_table
from harness.resolved import Resolved, resolve
from harness.runner.stored_shells import (
    ELSEWHERE,
    OPTION,
    Moved,
    Nearby,
    StoredShells,
    environment_with,
    moved_to,
    nearby,
    ratio_of,
    require_shares,
)
from harness.strata import ShellDesign
from harness.vocabulary import EstimatorName, FloatArray

NOT_LOOKING = "cut_in__ignore_share"
_STEP = "acceptance_steps__share__"
ONE_SIDED = 0.95
"""Quantile of a step's share that no replicate has drawn."""


@checked("estimate_in_other_traffic")
def estimate_in_other_traffic(
    folder: str | Path,
    environment: str,
    *,
    confidence: Confidence | None = None,
    own: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Content of ``estimates.json`` as the stored tests have it for another environment: a shipped name or a file.

    Where it names replicates ``traffic`` is what they leave open (`TrafficError`). With ``own`` it has to be the
    folder's own traffic.

    Raises `HarnessError`: the folder is no run of shells, the environment is wrong, or the tests say nothing of it.
    """
    progress = progress or Progress()
    tested = StoredShells.of(folder, progress)
    campaign = tested.here.campaign
    there = resolve(campaign.replaced(("environment", "parameters"), environment))
    if own and there.family.digest(there.environment) != tested.pool.environment:
        expected = "the environment that the folder's tests were run in: estimates.json is of that"
        raise CampaignError(f"{OPTION} with --write", f"{environment}, with other numbers", expected, ELSEWHERE)
    moved = moved_to(tested, there, environment, progress)
    keys = tested.manifest if moved.is_same else ("repeated",)
    told: dict[str, Any] = {key: tested.manifest[key] for key in keys if key in tested.manifest}
    told |= {
        "campaign_hash": there.content_hash,
        "distance_per_test_m": there.family.mean_distance_m(there.environment),
    }
    blocks = map(moved.block, tested.blocks)
    parameters = load_parameters(there.campaign.environment)
    if parameters.replicates is not None and parameters.unseen:
        told.pop("assumed", None)  # replicates say it better
    elif not moved.is_same:
        told["assumed"] = assumed(there, tested.pool, tested.design, progress)
    asked: list[EstimatorName] | None = None if moved.is_same else ["shells"]
    content = estimate_blocks(blocks, there.campaign, told, estimators=asked, confidence=confidence)
    if not moved.is_same:
        drivers = " and ".join(each.name for each in tested.design.references)
        known = f" (off by {share(moved.reference_error(), least=0.001)} for {drivers})" if drivers else ""
        was, now = (Path(each).stem for each in (campaign.environment.parameters, environment))
        words = f"tests of {was}, answered for {now}: holds if as large a share of each shell crashes as there{known}"
        content["answer"] |= {"scope": words}
    if (found := traffic_error(tested, there, moved, content, progress)) is not None:
        content |= told_traffic(found, content)
    return content


def traffic_error(
    tested: StoredShells, there: Resolved, moved: Moved, content: Mapping[str, Any], progress: Progress
) -> TrafficError | None:
    """What the replicates of the traffic ``there`` leave open of an answer; None where it has none.

    Raises `HarnessError`: their file is missing or wrong.
    """
    unseen = _unseen(tested, there, moved, progress)
    if (found := _answered([tested], there, moved, progress, unseen)) is None:
        return None
    (near,), n = found
    estimate, confidence = content["estimates"]["shells"], content["confidence"]
    times, off, n_refused = np.array([each.rate for each in near]), _off(near), n - len(near)
    sampling = estimate["ci_low"], estimate["ci_high"]
    if not estimate["n_crashes"] or not tested.holds:
        sampling = 0.0, estimate["upper_bound"]
    about, held = (off, n_refused, confidence), tested.holds
    from_below = unseen is None and held
    of_rate = uncertain(estimate["crash_rate"], sampling, times, *about, from_below=from_below, held=held)
    ratios = {}
    for r, driver in enumerate(tested.design.references):
        for each in estimate["details"]["references"]:
            if each["reference"] == driver.name:
                ends, moves = _ends(each), times / np.array([one.references[r] for one in near])
                further = off + ONE_LAW, *about[1:]
                ratios[driver.name] = uncertain(each["ratio"], ends, moves, *further, from_below=held, held=held)
    return TrafficError(_name(there), confidence, n, n_refused, float(off.mean()), of_rate, ratios, unseen)


@checked("compare_in_other_traffic")
def compare_in_other_traffic(
    folder: str | Path, environment: str, *, confidence: Confidence | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """What the stored tests of a comparison say of both vehicles in other traffic, and its replicates of their ratio.

    Keys are ``traffic``, a `TrafficError` of A with its ratio to B unless B has not crashed, ``b``, the rate of B, and
    ``rows``, what a terminal shows of A. Raises `HarnessError` as `estimate_in_other_traffic` does, and where there
    are no replicates.
    """
    progress = progress or Progress()
    sides = [StoredShells.of(Path(folder) / side, progress) for side in ("a", "b")]
    for tested in sides:
        require_shares(tested)
    there = resolve(sides[0].here.campaign.replaced(("environment", "parameters"), environment))
    moved = [moved_to(side, there, environment, progress) for side in sides]
    pairs = PairedShells(moved[0].there)
    for side, tested in enumerate(sides):
        for block in tested.blocks:
            pairs.add(side, moved[side].block(block))
    confidence = confidence or there.campaign.stop.confidence
    told = paired_estimate(pairs.first(np.minimum(pairs.tests(0), pairs.tests(1))), confidence)
    unseen = _unseen(sides[0], there, moved[0], progress)
    if (found := _answered(sides, there, moved[0], progress, unseen)) is None:
        expected = "an environment that names replicates, as `harness fit` writes them"
        raise CampaignError(OPTION, f"{environment}, which names none", expected, "Compare in that environment.")
    near, n = found
    times, n_refused = [np.array([each.rate for each in of]) for of in near], n - len(near[0])
    off = _off(near[0])  # the strata of both are the same
    about = off, n_refused, confidence
    a, b = (
        uncertain(of["crash_rate"], (of["ci_low"], of["ci_high"]), factors, *about, from_below=unseen is None)
        for of, factors in zip((told["a"], told["b"]), times, strict=True)
    )
    ratios = {}
    if told["b"]["n_crashes"]:
        ratios["B"] = uncertain(told["ratio"], _ends(told), times[0] / times[1], off + ONE_LAW, *about[1:])
    error = TrafficError(_name(there), confidence, n, n_refused, float(off.mean()), a, ratios, unseen)
    return {"traffic": finite_json(error), "b": finite_json(b), "rows": [asdict(row) for row in rows(error)]}


def _unseen(tested: StoredShells, there: Resolved, moved: Moved, progress: Progress) -> Unseen | None:
    """Steps of acceptance in which no lane change was seen, of those that carry a notable part of the rate.

    What a step carries is what its share of the wishes moves: a rate is linear in it.
    """
    parameters = load_parameters(there.campaign.environment)
    steps = parameters.acceptance_steps
    if parameters.replicates is None or steps is None or steps.events is None or steps.exposure is None:
        return None
    empty = steps.without_events
    halves = [{f"{_STEP}{step}": 0.5 * steps.share[step].value} for step in empty]
    halved = [environment_with(there, parameters, each) for each in halves]
    found = nearby(tested, there, moved, [each for each in halved if each is not None], progress)
    known = [step for step, each in zip(empty, halved, strict=True) if each is not None]
    carried = {step: 2.0 * (1.0 - each.rate) for step, each in zip(known, found, strict=True)}
    carried = {step: part for step, part in carried.items() if part > CARRIES}
    return Unseen(steps.where(carried), min(sum(carried.values()), 1.0), tuple(carried)) if carried else None


def as_if_unseen(row: Mapping[str, float], steps: AcceptanceSteps) -> dict[str, float]:
    """A replicate with what zero events leave open upwards, in place of the draw that is right in the mean.

    In all steps without events, whichever carry a vehicle's rate: so what is found serves others, too. Draws are of
    (½)-gamma quantiles over the exposure; the same quantile of 1-gamma is what no event at all refuses.
    """
    moved = dict(row)
    for step in steps.without_events:
        name, exposure = f"{_STEP}{step}", (steps.exposure or ())[step]
        below = float(gammainc(0.5, row[name] * exposure)) if name in row else ONE_SIDED
        moved[name] = min(float(gammaincinv(1.0, below)) / exposure, 1.0) if exposure > 0.0 else 1.0
    return moved


def _answered(
    sides: Sequence[StoredShells], there: Resolved, moved: Moved, progress: Progress, unseen: Unseen | None
) -> tuple[list[list[Nearby]], int] | None:
    """What each run says of the replicates that all can answer, and how many there are; None without any."""
    settings = there.campaign.environment
    parameters = load_parameters(settings)
    if parameters.replicates is None:
        return None
    values = read_replicates(settings.parameters, parameters)
    if unseen is not None and parameters.acceptance_steps is not None:
        values = [as_if_unseen(row, parameters.acceptance_steps) for row in values]
    environments = [each for row in values if (each := environment_with(there, parameters, row)) is not None]
    progress.stage("replicates of the traffic", len(sides) * len(environments))
    found = [list(nearby(tested, there, moved, environments, progress)) for tested in sides]
    kept = [row for row in zip(*found, strict=True) if not any(each.refused for each in row)]
    if not kept:
        expected = "replicates that these tests can answer"
        raise CampaignError(OPTION, f"{len(values)} replicates, of which none can be", expected, ELSEWHERE)
    return [list(of) for of in zip(*kept, strict=True)], len(values)


def _off(near: Sequence[Nearby]) -> FloatArray:
    return np.array([each.off for each in near])


def _ends(of: Mapping[str, Any]) -> tuple[float, float]:
    return of["ratio_low"] or 0.0, math.inf if of["ratio_high"] is None else of["ratio_high"]


def _name(there: Resolved) -> str:
    return Path(there.campaign.environment.parameters).stem


def assumed(traffic: Resolved, pool: Pool, design: ShellDesign, progress: Progress) -> dict[str, Any] | None:
    """By what the strata's probabilities move over what data leave open of who cuts in closely; None without that.

    ``times`` are the factors at both ends, (2, S): of the ``range`` that is stated for who does not look, with its
    ``name``, ``value`` and ``ends``; or of shares of lane changes at the times to collision ``where`` none was seen,
    which are anything up to what that many vehicles without one refuse.
    """
    parameters = load_parameters(traffic.campaign.environment)
    number, steps = parameters.numbers().get(NOT_LOOKING), parameters.acceptance_steps
    if number is not None and number.range is not None:
        of: dict[str, Any] = {"name": NOT_LOOKING.replace("__", "."), "value": number.value, "ends": list(number.range)}
        settings = [{NOT_LOOKING: end} for end in number.range]
    elif steps is not None and parameters.unseen:
        of = {"where": parameters.unseen}
        settings = [{f"{_STEP}{step}": SMALLEST_SHARE for step in steps.without_events}, as_if_unseen({}, steps)]
    else:
        return None
    ends = [environment_with(traffic, parameters, each) for each in settings]
    if None in ends:
        return None
    paths = FewPaths(traffic, pool, design, acceleration_limit(traffic.campaign.av), progress)
    base, *moved = paths.of([traffic.environment, *filter(None, ends)])
    return {**of, "times": [ratio_of(each.p, base.p).tolist() for each in moved]}


def told_traffic(found: TrafficError, content: Mapping[str, Any]) -> dict[str, Any]:
    """What of ``estimates.json`` tells of it: ``traffic`` itself, lines of the answer below rate and ratio."""
    answer = content["answer"]
    old = _limited(answer["rows"], found)
    place = 1 + max((i for i, row in enumerate(old) if row["key"] in ("verdict", "rate", "ratio")), default=-1)
    new = [asdict(row) for row in rows(found)]
    warnings = [*answer["warnings"], *too_few(found.n_replicates, found.confidence)]
    return {
        "traffic": finite_json(found),
        "answer": {**answer, "rows": [*old[:place], *new, *old[place:]], "warnings": warnings},
    }


def _limited(told: Sequence[Mapping[str, Any]], found: TrafficError) -> list[Mapping[str, Any]]:
    """Rows of an answer, whose rate has but an upper limit where no lane change was seen: behind the ratio."""
    if found.unseen is None or is_open(found):
        return list(told)
    seen = {"interval": f"{number(found.rate.value)} as fitted"} if found.rate.value else {}
    limit = {"value": f"< {number(found.rate.both[1])} per test", "remark": f"none seen at {found.unseen.where}"}
    limited = [{**row, **limit, **seen} if row["key"] == "rate" else row for row in told]
    return sorted(limited, key=lambda row: {"verdict": 0, "ratio": 1}.get(row["key"], 2))


def read_replicates(name: str, parameters: EnvironmentParameters) -> list[dict[str, float]]:
    """Numbers that vary, of each replicate that an environment, a shipped name or a file, names.

    Raises `HarnessError`: the file is missing or damaged, or is not of these numbers.
    """
    file, tied = shipped_or_own(name, SHIPPED_FOLDER, "environment.parameters"), parameters.replicates
    if tied is None:
        return []
    path, again = file.parent / tied.file, "Write it anew with `harness fit`, or leave out the key replicates."
    table = read_table(path, mend=again)
    of, expected = (table.schema.metadata or {}).get(OF_REPLICATES), f"the replicates that {file.name} was written with"
    if content_hash(path.read_bytes()) != tied.sha256:
        raise RunFolderError(str(path), "replicates of another fit, or changed ones", expected, again)
    if of != parameters.content_hash().encode():
        raise RunFolderError(str(path), f"replicates of other numbers than those of {file.name}", expected, again)
    wrong = [] if table.num_rows else ["no rows"]
    for column, of in zip(table.column_names, table.columns, strict=True):
        if column not in parameters.numbers():
            wrong.append(f"column {column}")
        elif of.null_count or not (pa.types.is_floating(of.type) or pa.types.is_integer(of.type)):
            wrong.append(f"column {column} with something else than numbers")
    if wrong:
        raise RunFolderError(str(path), wrong[0], f"replicates of the numbers of {file.name}, by section__name", again)
    rows: list[dict[str, float]] = table.to_pylist()
    return rows
