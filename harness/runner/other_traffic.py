"""What a stored run says of other traffic, of traffic that was fitted, and of what is assumed about its own.

Traffic that was fitted names replicates: environments that other trajectories of the same kind would have given. Each
is answered by the same tests, from few paths that are the same in all of them (`harness.runner.stored_shells`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.arguments import checked
from harness.campaign.sections import Confidence
from harness.errors import CampaignError
from harness.estimators.answer import CARRIES, Elsewhere, estimate_blocks
from harness.estimators.estimate import finite_json
from harness.estimators.pairs import PairedShells, paired_estimate
from harness.estimators.traffic import ONE_LAW, Ends, TrafficError, Uncertain, Unseen, uncertain
from harness.families.protocol import Parameters
from harness.pool.moved import assumed
from harness.progress import Progress
from harness.records.reader import read_replicates
from harness.resolved import resolve
from harness.runner.stored import StoredEstimates
from harness.runner.stored_shells import ELSEWHERE, OPTION, Nearby, StoredShells, moved_to, require_shares
from harness.vocabulary import EstimatorName, FloatArray


@checked("harness.estimate_in_other_traffic")
def estimate_in_other_traffic(
    folder: str | Path,
    environment: str,
    *,
    confidence: Confidence | None = None,
    own: bool = False,
    progress: Progress | None = None,
) -> StoredEstimates:
    """Content of ``estimates.json`` as the stored tests of shells have it for another environment.

    Parameters
    ----------
    folder : str or Path
        Run folder.
    environment : str
        A shipped name or a file; where it names replicates, ``traffic`` is what they leave open (`TrafficError`).
    confidence : float, optional
        Level of the intervals, by default the campaign's.
    own : bool
        Whether it has to be the folder's own traffic.
    progress : Progress, optional
        Who is told how far it is.

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
    if there.parameters.replicates is not None and there.parameters.unseen:
        told.pop("assumed", None)  # replicates say it better
    elif not moved.is_same:
        told["assumed"] = assumed(there, tested.pool, tested.design, progress)
    asked: list[EstimatorName] | None = None if moved.is_same else ["shells"]
    blocks = map(moved.block, tested.blocks)
    content = estimate_blocks(blocks, there.campaign, told, estimators=asked, confidence=confidence)
    if not moved.is_same:
        drivers = tuple(each.name for each in tested.design.references)
        was, now = (Path(each).stem for each in (campaign.environment.parameters, environment))
        content |= finite_json({"elsewhere": Elsewhere(was, now, drivers, moved.reference_error())})
    told = content | finite_json({"traffic": traffic_error(moved, content, progress)})
    return StoredEstimates(told, Path(folder))


def traffic_error(moved: StoredShells, content: Mapping[str, Any], progress: Progress) -> TrafficError | None:
    """What the replicates of its traffic leave open of an answer; None where it has none.

    Raises `HarnessError`: their file is missing or wrong.
    """
    estimate = content["estimates"]["shells"]
    if (found := _replicated([moved], content["confidence"], progress)) is None:
        return None
    sampling, held = (estimate["ci_low"], estimate["ci_high"]), moved.holds
    if not estimate["n_crashes"] or not held:
        sampling = 0.0, estimate["upper_bound"]
    times, from_below = found.times(0), found.unseen is None and held
    rate = found.uncertain(estimate["crash_rate"], sampling, times, from_below=from_below, held=held)
    drivers, ratios = [each.name for each in moved.design.references], {}
    for each in estimate["details"]["references"]:
        moves = times / np.array([one.references[drivers.index(each["reference"])] for one in found.near[0]])
        ratios[each["reference"]] = found.uncertain(
            each["ratio"], _ends(each), moves, ONE_LAW, from_below=held, held=held
        )
    return found.error(rate, ratios)


@checked("compare_in_other_traffic")
def compare_in_other_traffic(
    folder: str | Path, environment: str, *, confidence: Confidence | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """What the stored tests of a comparison say of both vehicles in other traffic, and its replicates of their ratio.

    Keys are ``traffic``, a `TrafficError` of A with its ratio to B unless B has not crashed, and ``b``, the rate of B.
    Raises `HarnessError` as `estimate_in_other_traffic` does, and where there are no replicates.
    """
    progress = progress or Progress()
    sides = [StoredShells.of(Path(folder) / side, progress) for side in ("a", "b")]
    for tested in sides:
        require_shares(tested)
    there = resolve(sides[0].here.campaign.replaced(("environment", "parameters"), environment))
    moved = [moved_to(side, there, environment, progress) for side in sides]
    pairs = PairedShells(moved[0].design)
    for side, of in enumerate(moved):
        for block in of.blocks:
            pairs.add(side, of.block(block))
    confidence = confidence or there.campaign.stop.confidence
    told = paired_estimate(pairs.first(np.minimum(pairs.tests(0), pairs.tests(1))), confidence)
    if (found := _replicated(moved, confidence, progress)) is None:
        expected = "an environment that names replicates, as `harness fit` writes them"
        raise CampaignError(OPTION, f"{environment}, which names none", expected, "Compare in that environment.")
    below = found.unseen is None
    a, b = (
        found.uncertain(of["crash_rate"], (of["ci_low"], of["ci_high"]), found.times(side), from_below=below)
        for side, of in enumerate((told["a"], told["b"]))
    )
    moves, ratios = found.times(0) / found.times(1), {}
    if told["b"]["n_crashes"]:
        ratios["B"] = found.uncertain(told["ratio"], _ends(told), moves, ONE_LAW)
    error = found.error(a, ratios)
    return {"traffic": finite_json(error), "b": finite_json(b)}


@dataclass(frozen=True)
class Replicated:
    """What each run says of those replicates that all can answer, ``near``; the strata of all are the same."""

    environment: str
    confidence: float
    near: Sequence[Sequence[Nearby]]
    n_refused: int
    unseen: Unseen | None

    def times(self, side: int) -> FloatArray:
        """By what the rate of a run moves, (B,)."""
        return np.array([each.rate for each in self.near[side]])

    def uncertain(
        self, value: float, sampling: Ends, factors: FloatArray, further: float = 0.0, **how: bool
    ) -> Uncertain:
        """Something that moves by ``factors`` (B,), which may be off by so much, and ``further``; see `uncertain`."""
        off = np.array([each.off for each in self.near[0]]) + further
        return uncertain(value, sampling, factors, off, self.n_refused, self.confidence, **how)

    def error(self, rate: Uncertain, ratios: Mapping[str, Uncertain]) -> TrafficError:
        """All of it."""
        n, off = len(self.near[0]) + self.n_refused, float(np.mean([each.off for each in self.near[0]]))
        return TrafficError(self.environment, self.confidence, n, self.n_refused, off, rate, ratios, self.unseen)


def _replicated(sides: Sequence[StoredShells], confidence: float, progress: Progress) -> Replicated | None:
    """Answers of stored runs in the replicates of one traffic; None without any."""
    settings = sides[0].traffic.campaign.environment
    parameters = sides[0].traffic.parameters
    if parameters.replicates is None:
        return None
    values = read_replicates(settings.parameters, parameters, sides[0].traffic.family.shipped)
    if (unseen := _unseen(sides[0], parameters, progress)) is not None:
        values = [parameters.as_if_unseen(row) for row in values]
    found = [[each for each in of.nearby(values, progress) if each is not None] for of in sides]
    kept = [row for row in zip(*found, strict=True) if not any(each.refused for each in row)]
    if not kept:
        expected = "replicates that these tests can answer"
        raise CampaignError(OPTION, f"{len(values)} replicates, of which none can be", expected, ELSEWHERE)
    name, near = Path(settings.parameters).stem, [list(of) for of in zip(*kept, strict=True)]
    return Replicated(name, confidence, near, len(values) - len(kept), unseen)


def _unseen(moved: StoredShells, parameters: Parameters, progress: Progress) -> Unseen | None:
    """Steps in which no event was seen, of those that carry a notable part of the rate.

    What a step carries is what its share of the events moves: a rate is linear in it.
    """
    halved = parameters.without_half()
    found = moved.nearby(list(halved.values()), progress)
    carried = {step: 2.0 * (1.0 - near.rate) for step, near in zip(halved, found, strict=True) if near is not None}
    carried = {step: part for step, part in carried.items() if part > CARRIES}
    where = parameters.unseen_in(carried)
    return Unseen(where, min(sum(carried.values()), 1.0), tuple(carried)) if carried else None


def _ends(of: Mapping[str, Any]) -> Ends:
    return of["ratio_low"] or 0.0, math.inf if of["ratio_high"] is None else of["ratio_high"]
