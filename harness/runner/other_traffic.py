"""A stored run's answer for other traffic, and how it depends on fitted and assumed numbers of traffic.

Traffic that was fitted names replicates: environments that other trajectories of the same kind would have given. Each
is answered by the same tests, from few paths that are the same in all of them (`harness.runner.stored_shells`).
"""

from __future__ import annotations

import math
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
from harness.estimators.traffic import (
    ONE_LAW,
    Bar,
    NotMoved,
    Sensitivity,
    TrafficError,
    Unseen,
    tests_of_sum,
    uncertain,
)
from harness.families import family_named
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

Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest value of numbers, by ``section.name``."""


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
    manifest: dict[str, Any] = {key: tested.manifest[key] for key in keys if key in tested.manifest}
    distance_m = there.family.mean_distance_m(there.environment)
    manifest |= {"campaign_hash": there.content_hash, "distance_per_test_m": distance_m, "tests_per_hour": None}
    if there.parameters.replicates is not None and there.parameters.unseen:
        manifest.pop("assumed", None)  # replicates say it better
    elif not moved.is_same:
        manifest["assumed"] = assumed(there, tested.pool, tested.design, progress)
    estimators: list[EstimatorName] | None = None if moved.is_same else ["shells"]
    blocks = map(moved.block, tested.blocks)
    content = estimate_blocks(blocks, there.campaign, manifest, estimators=estimators, confidence=confidence)
    if not moved.is_same:
        drivers = tuple(driver.name for driver in tested.design.references)
        was, now = (Path(name).stem for name in (campaign.environment.parameters, environment))
        content |= finite_json({"elsewhere": Elsewhere(was, now, drivers, moved.reference_error())})
    content |= finite_json({"traffic": traffic_error(moved, content, progress)})
    return StoredEstimates(content, Path(folder))


def traffic_error(moved: StoredShells, content: Mapping[str, Any], progress: Progress) -> TrafficError | None:
    """How far the replicates of the traffic spread the answers; None where it has none."""
    settings, parameters = moved.traffic.campaign.environment, moved.traffic.parameters
    if parameters.replicates is None:
        return None
    values = read_replicates(settings.parameters, parameters, moved.traffic.family.shipped)
    if (unseen := _unseen(moved, parameters, progress)) is not None:
        values = [parameters.kinds.as_if_unseen(row) for row in values]
    replicates = [nearby for nearby in moved.nearby(values, progress) if nearby is not None and not nearby.refused]
    if not replicates:
        expected = "replicates that these tests can answer"
        raise CampaignError(OPTION, f"{len(values)} replicates, of which none can be", expected, ELSEWHERE)
    n_refused = len(values) - len(replicates)
    factors = np.array([replicate.rate for replicate in replicates])
    off = np.array([replicate.off for replicate in replicates])
    confidence, estimate, holds = content["confidence"], content["estimates"]["shells"], moved.holds
    interval = estimate["ci_low"], estimate["ci_high"]
    if not estimate["n_crashes"] or not holds:
        interval = 0.0, estimate["upper_bound"]
    below = unseen is None and holds
    rate = uncertain(
        estimate["crash_rate"], interval, factors, off, n_refused, confidence, from_below=below, held=holds
    )
    drivers, ratios = [driver.name for driver in moved.design.references], {}
    for beside in estimate["details"]["references"]:
        driver = drivers.index(beside["reference"])
        of_ratio = factors / np.array([replicate.references[driver] for replicate in replicates])
        ends = beside["ratio_low"] or 0.0, math.inf if beside["ratio_high"] is None else beside["ratio_high"]
        ratios[beside["reference"]] = uncertain(
            beside["ratio"], ends, of_ratio, off + ONE_LAW, n_refused, confidence, from_below=holds, held=holds
        )
    name, mean_off = Path(settings.parameters).stem, float(np.mean(off))
    return TrafficError(name, confidence, len(values), n_refused, mean_off, rate, ratios, unseen)


def _unseen(moved: StoredShells, parameters: Parameters, progress: Progress) -> Unseen | None:
    """Steps in which no event was seen and that carry a notable part of the rate, which is linear in their shares."""
    if (kinds := parameters.kinds) is None:
        return None
    halved = kinds.without_half()
    nearby = moved.nearby(list(halved.values()), progress)
    carried = {step: 2.0 * (1.0 - half.rate) for step, half in zip(halved, nearby, strict=True) if half is not None}
    carried = {step: part for step, part in carried.items() if part > CARRIES}
    return Unseen(kinds.where(carried), min(sum(carried.values()), 1.0), tuple(carried)) if carried else None


# -- what the answer depends on: fitted numbers move by their standard errors or, where there are replicates, in blocks
# of numbers that were fitted together; assumed numbers over their stated range. Crash shares within shells stay as they
# were. Where a number changes what happens after an event, that may be wrong: the reference drivers show by how much --


@dataclass(frozen=True)
class Move:
    """The environments of a `Bar`: ``settings`` has the numbers that differ in each."""

    what: str
    known: Literal["fitted", "assumed"]
    values: tuple[float, float] | None
    settings: Sequence[Mapping[str, float]]


@checked("harness.sensitivity")
def sensitivity(
    folder: str | Path, *, ranges: Ranges | None = None, progress: Progress | None = None
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
    of_run = _of_sum if (folder / FAMILIES).is_file() else _of_one
    content = finite_json(of_run(folder, ranges or {}, progress))
    write_sealed(folder / SENSITIVITY, content)
    return content


def _of_one(folder: Path, ranges: Ranges, progress: Progress, *, per_event: bool = False) -> Sensitivity:
    """Bars of one run's numbers; ``per_event`` of rates per event, where events per hour do not move with them."""
    tested = StoredShells.of(folder, progress, _OPTION)
    require_shares(tested)
    settings, parameters = tested.here.campaign.environment, tested.here.parameters
    all_moves = list(moves(settings.parameters, parameters, tested.here.family.shipped, ranges))
    if not all_moves:
        found = f"{settings.parameters}, of which no number has a standard error (se) or a range"
        number = next(reversed(parameters.numbers()), "section__name").replace("__", ".")
        mend = f"State one, e.g. --range {number}=LOW:HIGH."
        raise CampaignError(_OPTION, found, "numbers that are said to be uncertain", mend)
    results = tested.nearby([numbers for move in all_moves for numbers in move.settings], progress)
    if per_event:
        results = (nearby and nearby.per_event() for nearby in results)
    bars = [bar_of(move, [next(results) for _ in move.settings]) for move in all_moves]
    driver = next((reference.name for reference in tested.design.references), "")
    bars += bar_of_readings(tested.design)
    bars.sort(key=lambda bar: -bar.span)
    return Sensitivity(tested.manifest["campaign_hash"], Path(settings.parameters).stem, driver, tuple(bars))


def _of_sum(folder: Path, ranges: Ranges, progress: Progress) -> Sensitivity:
    """Bars of the scenarios' exposures and, scaled by shares of the sum, of their numbers where these can be moved."""
    stored, bars, not_moved = read_families(folder), list[Bar](), list[NotMoved]()
    if not stored["n_crashes"]:  # the sum's upper limit is no sum of the scenarios' limits: none has a share of it
        mend = f"Ask {folder / next(iter(stored['families']))}, say, or harness estimate with --exposure."
        raise CampaignError(_OPTION, "tests of which none crashed", "crashes, whose rate moves", mend)
    own_ranges: dict[str, Ranges] = {}
    for name in stored["families"]:
        campaign = read_campaign(folder / name, read_manifest(folder / name), check_files=True)
        numbers = {key.replace("__", ".") for key in resolve(campaign).parameters.numbers()}
        own_ranges[name] = {number: ends for number, ends in ranges.items() if number in numbers}
    if unknown := sorted(set(ranges).difference(*own_ranges.values())):
        mend = f"Ask {folder / next(iter(own_ranges))} alone, say: its table names its numbers."
        raise CampaignError("--range", unknown[0], "a number of one of these scenarios", mend)
    reference_per_hour = stored["beside"]["rate_per_hour"] or math.nan
    for name, part in stored["families"].items():
        shares = part["share"] or 0.0, part["reference_rate_per_hour"] / reference_per_hour
        exposure = part["exposure"]
        ends = float(f"{exposure['low']:.4g}"), float(f"{exposure['high']:.4g}")
        if ends[0] < ends[1]:
            low, high = (end / exposure["per_hour"] for end in ends)
            known: Literal["counted", "assumed"] = "counted" if exposure["counted"] else "assumed"
            bars.append(_part(Bar(f"exposure {name}", known, ends, (low, high), (1.0, 1.0), (0.0, 0.0)), *shares))
        if not part["n_crashes"]:
            not_moved.append(NotMoved(name, 0.0))
        progress.remark = f" ({name.replace('_', ' ')})"
        try:
            # Of a count of all events in an hour, also of those out of scope, the traffic says how many are in scope.
            per_event = name in stored["exposure"] or not family_named(name).follows
            own = _of_one(folder / name, own_ranges[name], progress, per_event=per_event)
        except CampaignError as refused:
            not_moved.append(NotMoved(name, shares[0], str(refused.found), str(refused.expected)))
            if (stated := part.get("assumed")) and stated["highest"]:  # the run has told by how much at most
                what = f"{name} drivers who do not look, up to {100.0 * stated['highest']:g} %"
                not_told = (math.nan, math.nan)
                bars.append(_part(Bar(what, "assumed", None, tuple(stated["times"]), not_told, not_told), *shares))
        else:
            for bar in own.bars:
                what = bar.what if bar.what.startswith(f"{name}.") else f"{name} {bar.what}"
                bars.append(_part(replace(bar, what=what), *shares))
    progress.remark = ""
    bars.sort(key=lambda bar: -bar.span)
    driver = stored["beside"]["reference"]
    return Sensitivity(tests_of_sum(stored), "crashes per hour", driver, tuple(bars), tuple(not_moved))


def _part(bar: Bar, share: float, driver_share: float) -> Bar:
    """A scenario's bar as one of the sum, by the scenario's share of the sum's rate and of the driver's."""
    rate, ratio = np.array(bar.rate), np.array(bar.ratio)
    with np.errstate(invalid="ignore", divide="ignore"):
        rate_of_sum = 1.0 + share * (rate - 1.0)
        ratio_of_sum = rate_of_sum / (1.0 + driver_share * (rate / ratio - 1.0))
    (low, high), (lower, upper) = rate_of_sum.tolist(), ratio_of_sum.tolist()
    return replace(bar, rate=(low, high), ratio=(lower, upper), off=(share * bar.off[0], share * bar.off[1]))


def moves(name: str, parameters: Parameters, shipped: Path, ranges: Ranges) -> Iterator[Move]:
    """Moves of the uncertain numbers of the environment ``name``, and of those with given ``ranges``."""
    numbers = parameters.numbers()
    given = {name.replace(".", "__"): ends for name, ends in ranges.items()}
    if unknown := sorted(set(given) - set(numbers)):
        mend = f"Its numbers are named section.name, such as {next(reversed(numbers)).replace('__', '.')}."
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
    for key, number in numbers.items():
        if key.startswith("exposure__"):  # moves no rate per test
            continue
        what, ends = key.replace("__", "."), given.get(key, number.range)
        if ends is not None:
            yield Move(what, "assumed", (ends[0], ends[1]), [{key: end} for end in ends])
        elif number.se is not None and parameters.replicates is None:
            ends = number.value - QUANTILE * number.se, number.value + QUANTILE * number.se
            yield Move(what, "fitted", ends, [{key: end} for end in ends])


def bar_of_readings(design: ShellDesign) -> list[Bar]:
    """A bar of how the ratio moves with other readings of the regulation's driver; none where there is but one."""
    rates = dict(zip((driver.name for driver in design.references), design.reference_rate.tolist(), strict=True))
    first, *others = [rates[name] for name in design.readings] or [0.0]
    ratios = [first / rate for rate in others if min(first, rate) > 0.0]
    if not ratios:
        return []
    ratio = min([*ratios, 1.0]), max([*ratios, 1.0])
    what = f"readings of {next(iter(rates))}"
    return [Bar(what, "assumed", None, rate=(1.0, 1.0), ratio=ratio, off=(0.0, 0.0), n=len(ratios))]


def bar_of(move: Move, results: Sequence[Nearby | None]) -> Bar:
    """The bar of a move: of a block quantiles of the ``results`` that can be answered, NaN where less than half can."""
    nan = np.full((2, 2), np.nan)
    ends = np.array([nan[0] if each is None or each.refused else (each.rate, each.ratio) for each in results])
    off = np.array([np.nan if each is None else each.off for each in results])
    no_laws, unlike = results.count(None), sum(each is not None and each.refused for each in results)
    if move.values is None:
        answered = ~np.isnan(ends[:, 0])
        if 2 * np.count_nonzero(answered) >= len(results):
            factors, tail = ends[answered], (1.0 - CONFIDENCE) / 2.0
            ends = np.quantile(factors, [tail, 1.0 - tail], axis=0)
            off = off[answered][[int(np.argmin(np.abs(factors[:, 0] - end))) for end in ends[:, 0]]]
        else:
            ends, off = nan, nan[0]
    rate, ratio, most_off = ((float(low), float(high)) for low, high in (*ends.T, off))
    return Bar(move.what, move.known, move.values, rate, ratio, most_off, len(results), no_laws, unlike)
