"""What a stored run says of other traffic, of traffic that was fitted, and how it depends on what is known of its own.

Traffic that was fitted names replicates: environments that other trajectories of the same kind would have given. Each
is answered by the same tests, from few paths that are the same in all of them (`harness.runner.stored_shells`).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.arguments import checked
from harness.campaign.sections import Confidence
from harness.errors import CampaignError
from harness.estimators.answer import CARRIES, Elsewhere, estimate_blocks
from harness.estimators.estimate import finite_json
from harness.estimators.traffic import ONE_LAW, Bar, Sensitivity, TrafficError, Unseen, tests_of_sum, uncertain
from harness.families.protocol import Parameters
from harness.pool.moved import assumed
from harness.progress import Progress
from harness.records.folder import SENSITIVITY, read_manifest, require_place, write_sealed
from harness.records.reader import read_campaign, read_replicates
from harness.resolved import resolve
from harness.runner.stored import StoredEstimates, read_families
from harness.runner.stored_shells import ELSEWHERE, OPTION, Nearby, StoredShells, moved_to, require_shares
from harness.strata import ShellDesign
from harness.vocabulary import FAMILIES, EstimatorName

N_REPLICATES = 50
CONFIDENCE, QUANTILE = 0.9, 1.645
_OPTION = "harness sensitivity"


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
    """What the replicates of its traffic leave open of an answer; None where it has none."""
    settings, parameters = moved.traffic.campaign.environment, moved.traffic.parameters
    if parameters.replicates is None:
        return None
    values = read_replicates(settings.parameters, parameters, moved.traffic.family.shipped)
    if (unseen := _unseen(moved, parameters, progress)) is not None:
        values = [parameters.kinds.as_if_unseen(row) for row in values]
    near = [each for each in moved.nearby(values, progress) if each is not None and not each.refused]
    if not near:
        expected = "replicates that these tests can answer"
        raise CampaignError(OPTION, f"{len(values)} replicates, of which none can be", expected, ELSEWHERE)
    times, off = np.array([each.rate for each in near]), np.array([each.off for each in near])
    n_refused, confidence, held = len(values) - len(near), content["confidence"], moved.holds

    estimate, below = content["estimates"]["shells"], unseen is None and held
    sampling = estimate["ci_low"], estimate["ci_high"]
    if not estimate["n_crashes"] or not held:
        sampling = 0.0, estimate["upper_bound"]
    rate = uncertain(estimate["crash_rate"], sampling, times, off, n_refused, confidence, from_below=below, held=held)
    drivers, ratios = [each.name for each in moved.design.references], {}
    for each in estimate["details"]["references"]:
        moves = times / np.array([one.references[drivers.index(each["reference"])] for one in near])
        ends = each["ratio_low"] or 0.0, math.inf if each["ratio_high"] is None else each["ratio_high"]
        ratios[each["reference"]] = uncertain(
            each["ratio"], ends, moves, off + ONE_LAW, n_refused, confidence, from_below=held, held=held
        )
    name, mean_off = Path(settings.parameters).stem, float(np.mean(off))
    return TrafficError(name, confidence, len(values), n_refused, mean_off, rate, ratios, unseen)


def _unseen(moved: StoredShells, parameters: Parameters, progress: Progress) -> Unseen | None:
    """Steps in which no event was seen that carry a notable part of the rate, which is linear in each one's share."""
    if (kinds := parameters.kinds) is None:
        return None
    halved = kinds.without_half()
    found = moved.nearby(list(halved.values()), progress)
    carried = {step: 2.0 * (1.0 - near.rate) for step, near in zip(halved, found, strict=True) if near is not None}
    carried = {step: part for step, part in carried.items() if part > CARRIES}
    return Unseen(kinds.where(carried), min(sum(carried.values()), 1.0), tuple(carried)) if carried else None


# -- what the answer depends on: fitted numbers move by their standard errors or, where there are replicates, in blocks,
# as those of a block were fitted together; assumed numbers over the range that is stated for them. Crash shares within
# shells stay as they were: of numbers that change what happens after an event they tell nothing but what the reference
# drivers show, by how much their rates, which are known there, would come out wrong --


@dataclass(frozen=True)
class Move:
    """Environments of a `Bar`, by the numbers that are other in each."""

    what: str
    known: Literal["fitted", "assumed"]
    values: tuple[float, float] | None
    settings: Sequence[Mapping[str, float]]


@checked("harness.sensitivity")
def sensitivity(
    folder: str | Path, *, ranges: Mapping[str, tuple[float, float]] | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Write ``sensitivity.json`` into the folder of a run of shells, and return its content (`Sensitivity`).

    Parameters
    ----------
    folder : str or Path
        Run folder, or the folder of several scenarios: each is asked, and by its share the sum.
    ranges : mapping, optional
        Lowest and highest value of numbers, by ``section.name``, besides those that the environment states.
    progress : Progress, optional
        Who is told how far it is.

    Raises `HarnessError`: the folder is no run of shells, a number is not there, or nothing is said to be uncertain.
    """
    folder, progress = Path(folder), progress or Progress()
    require_place(folder)
    found = (_of_sum if (folder / FAMILIES).is_file() else _of_one)(folder, ranges or {}, progress)
    content = finite_json(found)
    write_sealed(folder / SENSITIVITY, content)
    return content


def _of_one(
    folder: Path, ranges: Mapping[str, tuple[float, float]], progress: Progress, *, per_event: bool = False
) -> Sensitivity:
    tested = StoredShells.of(folder, progress, _OPTION)
    require_shares(tested)
    settings, parameters = tested.here.campaign.environment, tested.here.parameters
    asked = list(moves(settings.parameters, parameters, tested.here.family.shipped, ranges))
    if not asked:
        found = f"{settings.parameters}, of which no number has a standard error (se) or a range"
        number = next(reversed(parameters.numbers()), "section__name").replace("__", ".")
        mend = f"State one, e.g. --range {number}=LOW:HIGH."
        raise CampaignError(_OPTION, found, "numbers that are said to be uncertain", mend)
    results = tested.nearby([each for move in asked for each in move.settings], progress)
    if per_event:
        results = (of and of.per_event() for of in results)
    bars = [bar_of(move, [next(results) for _ in move.settings]) for move in asked]
    driver = next((each.name for each in tested.design.references), "")
    bars += bar_of_readings(tested.design)
    return Sensitivity(tested.manifest["campaign_hash"], Path(settings.parameters).stem, driver, _longest_first(bars))


def _of_sum(folder: Path, ranges: Mapping[str, tuple[float, float]], progress: Progress) -> Sensitivity:
    """Bars of each scenario, by its share of the sum's rates, and of the exposures; one that refuses is left out."""
    stored, bars, of_numbers = read_families(folder), list[Bar](), dict[str, Mapping[str, tuple[float, float]]]()
    if not stored["n_crashes"]:  # a limit of several scenarios is no sum of their own, of which each has a share
        mend = f"Ask {folder / next(iter(stored['families']))}, say, or harness estimate with --exposure."
        raise CampaignError(_OPTION, "tests of which none crashed", "crashes, whose rate moves", mend)
    for name in stored["families"]:
        campaign = read_campaign(folder / name, read_manifest(folder / name), check_files=True)
        of_file = {each.replace("__", ".") for each in resolve(campaign).parameters.numbers()}
        of_numbers[name] = {key: ends for key, ends in ranges.items() if key in of_file}
    if unknown := sorted(set(ranges).difference(*of_numbers.values())):
        mend = f"Ask {folder / next(iter(of_numbers))} alone, say: its table names its numbers."
        raise CampaignError("--range", unknown[0], "a number of one of these scenarios", mend)
    hour = stored["beside"]["rate_per_hour"] or math.nan
    for name, of in stored["families"].items():
        shares, exposure = (of["share"] or 0.0, of["reference_rate_per_hour"] / hour), of["exposure"]
        ends = float(f"{exposure['low']:.4g}"), float(f"{exposure['high']:.4g}")
        if ends[0] < ends[1]:
            low, high = (end / exposure["per_hour"] for end in ends)
            known: Literal["counted", "assumed"] = "counted" if exposure["counted"] else "assumed"
            bars.append(_part(Bar(f"exposure {name}", known, ends, (low, high), (1.0, 1.0), (0.0, 0.0)), *shares))
        if not of["n_crashes"]:
            why = "its bars move the competent driver alone, and what it adds to the upper limit stands in none"
            sys.stderr.write(f"note: of {name} no test crashed: {why}\n")
        progress.remark = f" ({name.replace('_', ' ')})"
        try:
            found = _of_one(folder / name, of_numbers[name], progress, per_event=True)
        except CampaignError as refused:
            why = f"found: {refused.found}; needed: {refused.expected}"
            sys.stderr.write(f"note: of the numbers of {name} only the exposure was moved ({why})\n")
        else:
            told = [bar.what if bar.what.startswith(f"{name}.") else f"{name} {bar.what}" for bar in found.bars]
            bars += [_part(replace(bar, what=what), *shares) for bar, what in zip(found.bars, told, strict=True)]
    progress.remark = ""
    return Sensitivity(tests_of_sum(stored), "crashes per hour", stored["beside"]["reference"], _longest_first(bars))


def _part(bar: Bar, share: float, of_driver: float) -> Bar:
    """What a scenario's bar is of the sum, of whose rate the scenario has a ``share``, and of the driver's another."""
    rate, ratio = np.array(bar.rate), np.array(bar.ratio)
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = 1.0 + share * (rate - 1.0)
        beside = moved / (1.0 + of_driver * (rate / ratio - 1.0))
    (low, high), (lower, upper) = moved.tolist(), beside.tolist()
    return replace(bar, rate=(low, high), ratio=(lower, upper), off=(share * bar.off[0], share * bar.off[1]))


def _longest_first(bars: Sequence[Bar]) -> tuple[Bar, ...]:
    return tuple(sorted(bars, key=lambda bar: -bar.span))


def moves(
    name: str, parameters: Parameters, shipped: Path, ranges: Mapping[str, tuple[float, float]]
) -> Iterator[Move]:
    """What is said to be uncertain of an environment, a shipped name or a file, and numbers with stated ``ranges``."""
    known = parameters.numbers()
    stated = {key.replace(".", "__"): ends for key, ends in ranges.items()}
    if unknown := sorted(set(stated) - set(known)):
        mend = f"Its numbers are named section.name, such as {next(reversed(known)).replace('__', '.')}."
        raise CampaignError("--range", unknown[0].replace("__", "."), f"a number of {name}", mend)
    for key, (low, high) in ranges.items():
        if not -math.inf < low < high < math.inf:
            expected = "two finite numbers, the lower first"
            raise CampaignError(f"--range {key}", f"{low:g}:{high:g}", expected, "Correct them, or change places.")
    blocks = {section: block for block, sections in parameters.blocks.items() for section in sections}
    if parameters.replicates is not None:
        rows = read_replicates(name, parameters, shipped)[:N_REPLICATES]
        rows = rows if parameters.kinds is None else [parameters.kinds.as_if_unseen(row) for row in rows]
        for block in parameters.blocks:
            columns = [key for key in rows[0] if blocks.get(key.split("__")[0]) == block]
            if columns:
                yield Move(block, "fitted", None, [{key: row[key] for key in columns} for row in rows])
    for key, number in known.items():
        if key.startswith("exposure__"):  # moves no rate per test
            continue
        what, value, se, ends = key.replace("__", "."), number.value, number.se, stated.get(key, number.range)
        if ends is not None:
            yield Move(what, "assumed", (ends[0], ends[1]), [{key: end} for end in ends])
        elif se is not None and parameters.replicates is None:
            ends = value - QUANTILE * se, value + QUANTILE * se
            yield Move(what, "fitted", ends, [{key: end} for end in ends])


def bar_of_readings(design: ShellDesign) -> list[Bar]:
    """By how much the ratio moves where the regulation's driver is read otherwise; none where only one reading is."""
    rates = dict(zip((each.name for each in design.references), design.reference_rate.tolist(), strict=True))
    first, *others = [rates[name] for name in design.readings] or [0.0]
    ends = [first / rate for rate in others if min(first, rate) > 0.0]
    known: Literal["assumed"] = "assumed"
    whole = (1.0, 1.0), (min([*ends, 1.0]), max([*ends, 1.0])), (0.0, 0.0)
    return [Bar(f"readings of {next(iter(rates))}", known, None, *whole, n=len(ends))] if ends else []


def bar_of(move: Move, results: Sequence[Nearby | None]) -> Bar:
    """What traffic moved to some ``results`` says; a block's ends are those of what can be answered, half at least."""
    nowhere = np.full((2, 2), np.nan)
    ends = np.array([nowhere[0] if each is None or each.refused else (each.rate, each.ratio) for each in results])
    off = np.array([np.nan if each is None else each.off for each in results])
    no_laws, unlike = results.count(None), sum(each is not None and each.refused for each in results)
    if move.values is None:
        tail, told = (1.0 - CONFIDENCE) / 2.0, ~np.isnan(ends[:, 0])
        known, enough = ends[told], 2 * np.count_nonzero(told) >= len(results)
        ends = np.quantile(known, [tail, 1.0 - tail], axis=0) if enough else nowhere
        nearest = [int(np.argmin(np.abs(known[:, 0] - end))) for end in ends[:, 0]] if enough else []
        off = off[told][nearest] if enough else nowhere[0]
    rate, ratio, most_off = ((float(low), float(high)) for low, high in (*ends.T, off))
    return Bar(move.what, move.known, move.values, rate, ratio, most_off, len(results), no_laws, unlike)
