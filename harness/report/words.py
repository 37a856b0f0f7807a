"""The answer at a glance, in words: rows of a run for terminal, page and JUnit, from the numbers of ``estimates.json``.

`harness.report.lines` lays them out for a terminal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AutomatedVehicle
from harness.estimators.answer import Elsewhere, Estimates
from harness.estimators.estimate import Estimate
from harness.estimators.severity import HARD_MPS, TOUCH_MPS
from harness.estimators.traffic import TrafficError, Uncertain
from harness.numbers import (
    MISSING,
    WIDEST_RHW,
    count,
    interval,
    leaves,
    number,
    plain,
    ratio,
    share,
    tenths,
    words,
)
from harness.report.notes import note_words
from harness.strata import ASSUMPTION_FREE, LIBRARY_STATEMENT

CUT_OFF_SHARE = 0.2
"""Weight, relative to the rate, from which tests that were cut off are warned of, if the interval leaves them out."""
ANY_SHARE = 0.95
"""Width of the interval of a share from which on it says nothing [assumed]."""
LEAST_REPLICATES = 100
"""With fewer, quantiles far out in the tails change with their number [assumed]."""
CLOSE = 0.1
"""Factors closer to 1 than so much on a logarithmic scale are told with three digits."""
_BRAKES_HARDEST = "brakes-8"
ENDED = {
    "rhw": "precision reached",
    "below_reference": "far enough below the competent driver",
    "accept": "decision reached",
    "episodes": "budget spent",
    "pool": "the pool has no further cut-in that would narrow it",
    "pool_error": "the pool’s own error is too wide",
}
"""Why a campaign ended (`harness.records.folder.StoppedBy`), in words."""


@dataclass(frozen=True)
class Row:
    """One line of the answer: what, how much, its interval, a remark; ``key`` tells the page which it is."""

    key: str
    what: str
    value: str
    interval: str = ""
    remark: str = ""

    @property
    def texts(self) -> tuple[str, ...]:
        """What is shown of it."""
        return self.what, self.value, self.interval, self.remark


@dataclass(frozen=True)
class ShortAnswer:
    """What is shown first of a run: vehicle and tests, rows, what changes their meaning, and how far they go.

    ``parameters`` are those of the vehicle that are not defaults, as pairs of a name and a value.
    """

    vehicle: str
    parameters: tuple[tuple[str, str], ...]
    tests: str
    rows: tuple[Row, ...]
    warnings: tuple[str, ...]
    scope: str


_ESTIMATES = TypeAdapter(Estimates)


def answer_of(campaign: Campaign, manifest: Mapping[str, Any], content: Mapping[str, Any]) -> ShortAnswer:
    """The answer of ``estimates.json``."""
    return short_answer(campaign, manifest, _ESTIMATES.validate_python(content))


def short_answer(campaign: Campaign, manifest: Mapping[str, Any], told: Estimates) -> ShortAnswer:
    """The answer by a campaign's own estimate, with what the ``manifest`` of the run says besides."""
    vehicle, parameters = vehicle_words(campaign.av)
    engine = "SUMO" if campaign.world.engine == "sumo" else "SUMO’s twin"
    return ShortAnswer(
        vehicle=vehicle,
        parameters=tuple(parameters),
        tests=f"{count(told.n_episodes)} tests in {engine}",
        rows=tuple(_with_traffic(list(_rows(campaign, manifest, told)), told.traffic)),
        warnings=(
            *_warnings(campaign, manifest, told),
            *_before_overlap(campaign, manifest, told.diagnostics),
            *_few_replicates(told.traffic),
        ),
        scope=_scope(campaign, manifest, told),
    )


def vehicle_words(av: AutomatedVehicle) -> tuple[str, list[tuple[str, str]]]:
    """Who drives the vehicle, and its parameters that are not defaults."""
    given = dict[str, Any]()
    for section, key in ((av.parameters, ""), (av.reaction, "reaction")):
        if isinstance(section, BaseModel):
            usual = type(section)().model_dump()
            changed = {name: value for name, value in section.model_dump().items() if value != usual[name]}
        else:
            changed = dict(section)
        given |= {key: changed} if key and changed else changed
    name = av.model or Path(av.controller or "").name
    if av.sumo is not None:
        given |= av.sumo
        name = f"SUMO’s {given.pop('carFollowModel', 'Krauss')}"
    elif av.traci is not None:
        name = f"TraCI client {Path(av.traci.command.split()[0]).name}"
    elif av.fmu is not None:
        given |= av.fmu.start_values
        name = Path(av.fmu.file).name
    return name, [(path, plain(value) if isinstance(value, float) else words(value)) for path, value in leaves(given)]


def _rows(campaign: Campaign, manifest: Mapping[str, Any], told: Estimates) -> Iterator[Row]:
    best, decision, assumed, distance_km = told.best, told.decision, told.assumed, told.distance_per_test_km
    if decision is not None:
        yield _decided(decision)
    from_mps = campaign.crash.counts_above_mps
    counted = f"crash rate > {plain(from_mps)} m/s" if from_mps else "crash rate"
    wide, less = best.is_wide, ""
    from_below = wide and (best.is_open_above or (decision is not None and decision["verdict"] == "rejected"))
    shown, ends = best.crash_rate, interval(best.ci_low, best.ci_high)
    if from_below:  # the other end says nothing
        less, shown, ends = "> ", best.ci_low, f"{number(best.crash_rate)} seen"
    elif not best.n_crashes or wide:
        less, shown = "< ", best.ci_high if best.n_crashes else best.upper_bound
        ends = f"{number(best.crash_rate)} seen" if best.n_crashes else "no crash seen"
    unseen = assumed if assumed is not None and assumed.no_lower_limit else None
    if unseen is not None:
        less, ends = "< ", f"{number(best.crash_rate)} as fitted" if best.n_crashes else ends
        shown = unseen.most * (best.ci_high if best.n_crashes else best.upper_bound)
    per_km = "" if not distance_km else f"{less}{number(shown * 1e6 / distance_km)} per million km"
    remark = per_km if unseen is None else f"none seen at {unseen.where}"
    so_far = " so far" if best.untested and best.n_crashes else ""
    rows = [Row("rate", f"{counted}{so_far}", f"{less}{number(shown)} per test", ends, remark)]
    beside = [each for each in best.details.get("references", ()) if each["crash_rate"] > 0.0][:1]
    acts = campaign.av.acts_before_event
    rows += [_beside(each, acts=acts, wide=wide, from_below=from_below) for each in beside]
    # Where little else is known of the rate than a limit, what is known comes first: the ratio.
    yield from reversed(rows) if unseen or (wide and beside and _end(beside[0]["ratio_high"]) < 1.0) else rows
    if not beside and campaign.has_baseline_runs and "shells" in best.details and not best.cautions:
        yield Row("ratio", "× competent driver", "no ratio", "", "such drivers never crash here")
    if assumed is not None and assumed.highest is not None and assumed.times is not None:
        high = assumed.most * (best.ci_high if best.n_crashes else best.upper_bound)
        ends = "" if from_below else f"up to {number(high)}"
        value = f"at most × {number(assumed.most, 2)} (assumed)"
        yield Row("assumed", "traffic", value, ends, f"if {share(assumed.highest)} do not look")
    if campaign.has_baseline_runs and best.n_crashes:
        yield from _whence(campaign, best, manifest.get("expected"))
    if (severity := told.severity) is not None:
        above = _share_within(severity.share_above_5_mps, severity.limits_above_5_mps, f" > {plain(HARD_MPS)} m/s")
        below = _share_within(severity.share_below_1_mps, severity.limits_below_1_mps, f" < {plain(TOUCH_MPS)} m/s")
        value = f"median {tenths(severity.median_mps)} m/s"
        what = f"impact{so_far}"
        yield Row("impact", what, value, above, below)
        # What a driver who brakes less hard does not avoid another one may.
        if (of := severity.unavoidable) is not None and of.driver == _BRAKES_HARDEST:
            ends, why = f"{share(of.share_low, least=0.001)} to {share(of.share_high)}", "not even 8 m/s² avoids it"
            yield Row("unavoidable", f"unavoidable{so_far}", f"{share(of.share)} of the rate", ends, why)
    if "within" in best.details and campaign.testing.shells.statement != ASSUMPTION_FREE:
        yield within(best.details["within"])


def unseen_words(where: str) -> str:
    """The same where it is not known by what the rate may rise."""
    return f"no lane change was seen at {where} in the data of this traffic: rates have only an upper limit"


def _whence(campaign: Campaign, best: Estimate, expected: Mapping[str, int] | None) -> Iterator[Row]:
    """Which of baseline runs and tests makes the interval as wide as it is, and how many of both may do."""
    whole, runs = best.rhw, _end(best.details.get("rhw_from_pool"))
    if not (math.isfinite(whole) and math.isfinite(runs)):
        return
    which = "runs" if 2.0 * runs * runs > whole * whole else "tests"
    remark = "" if expected is None else f"try {count(expected['runs'])} runs, {count(expected['tests'])} tests"
    alone = f"{count(campaign.pool.shadow_paths)} baseline runs ± {share(runs)}"
    yield Row("width", "half-width", f"± {share(whole)}, most by {which}", alone, remark)


def _share_within(value: float, limits: tuple[float, float] | None, of: str) -> str:
    """A share with its interval in whole per cent, where there is one; nothing where that may be nearly any."""
    if limits is None:
        return share(value) + of
    low, high = limits
    return "" if high - low > ANY_SHARE else f"{share(value)} ({100.0 * low:.0f}–{100.0 * high:.0f} %){of}"


def _decided(decision: Mapping[str, Any]) -> Row:
    driver, verdict = decision.get("driver"), decision["verdict"]
    asked = plain(decision["limit" if "limit" in decision else "crash_rate_below"])
    limit, shown = (f"{asked} × {driver}", ratio) if driver else (f"{asked} per test", number)
    value = {"accepted": f"below {limit}", "rejected": f"above {limit}"}.get(verdict, f"limit {limit}")
    ends = {
        "accepted": f"upper limit {shown(decision['high'])}",
        "rejected": f"lower limit {shown(decision['low'])}",
    }.get(verdict, f"it may be {shown(decision['low'])} to {shown(decision['high'])}")
    given = "" if decision["statement"] == ASSUMPTION_FREE else f", given {decision['statement']}"
    return Row("verdict", verdict.upper(), value, f"confidence {plain(decision['confidence'])}{given}", ends)


def _beside(found: Mapping[str, Any], *, acts: bool, wide: bool, from_below: bool) -> Row:
    low, high = found["ratio_low"], _end(found["ratio_high"])
    who = {"r157-cc": "beside r157-cc of UN R157"}.get(found["reference"], f"beside {found['reference']}")
    if acts:  # it takes over from the vehicle's own motion: what making room saves is not in the ratio
        who = f"{found['reference']}, same approach"
    if not found["ratio"]:
        return Row("ratio", "× competent driver", f"< {ratio(high)}", "no crash seen", who)
    if wide and high < 1.0:
        seen = f"{ratio(found['ratio'])} seen, ≥ {ratio(low)}"
        return Row("ratio", "× competent driver", f"< {ratio(high)} (crashes less)", seen, who)
    if from_below and low > 1.0:
        return Row(
            "ratio", "× competent driver", f"> {ratio(low)} (crashes more)", f"{ratio(found['ratio'])} seen", who
        )
    apart = "not told apart" if low <= 1.0 <= high else "crashes more" if low > 1.0 else "crashes less"
    ends = f"≥ {ratio(low)}" if from_below else f"{ratio(low)} to {ratio(high)}"
    return Row("ratio", "× competent driver", f"{ratio(found['ratio'])} ({apart})", ends, who)


def within(found: Mapping[str, Any]) -> Row:
    """What holds if the vehicle crashes only within the library's boundary, and whether it does."""
    n, outside = found["n_crashes_outside"], count(found["n_episodes_outside"])
    what = f"keeping to {LIBRARY_STATEMENT}"
    if found["refuted"]:
        return Row("within", what, "does NOT keep to it", "", f"{count(n)} crashes in {outside} beyond it")
    beyond = f"no crash in {outside} beyond it" if found["n_episodes_outside"] else "nothing tested beyond it"
    if not found["n_crashes"]:
        return Row("within", what, f"< {number(found['ci_high'])}", "", beyond)
    return Row("within", what, number(found["crash_rate"]), interval(found["ci_low"], found["ci_high"]), beyond)


def _warnings(campaign: Campaign, manifest: Mapping[str, Any], told: Estimates) -> Iterator[str]:
    """What changes the meaning of the rows, a line each."""
    best, severity, assumed = told.best, told.severity, told.assumed
    yield from map(note_words, best.cautions)
    repeated = manifest.get("repeated") or {}
    if n := len(repeated.get("differing", ())):
        yield f"NOT REPRODUCIBLE: {count(n)} of {count(repeated['n_episodes'])} tests that ran twice came out otherwise"
    if n_failed := best.details["n_failed"]:
        had = number(best.details["crash_rate_if_failed_had_crashed"])
        of = count(best.n_episodes)
        yield f"{count(n_failed)} of {of} tests FAILED; had they all crashed, the rate would be {had}"
    if severity is not None and severity.share_below_1_mps > 0.5:
        yield f"{share(severity.share_below_1_mps)} of this rate are touches below {plain(TOUCH_MPS)} m/s"
    if assumed is not None and assumed.where and assumed.times is None:
        yield unseen_words(assumed.where)
    on_rate = told.decision is not None and not told.decision.get("driver")
    if on_rate and assumed is not None and assumed.no_lower_limit:
        yield f"no lane change was seen at {assumed.where}: a limit on the rate rests on that; ask --accept r157-cc"
    worst = best.crash_rate + (0.0 if severity is None else severity.cut_off)
    if worst > max((1.0 + CUT_OFF_SHARE) * best.crash_rate, best.ci_high):
        yield f"time was up while it closed in: had all these tests crashed, {number(worst)} per test"
    if (level := campaign.environment.lane_change_level) != 1.0:
        yield f"lane-change level {plain(level)}: never compare with rates of other levels"


def _before_overlap(campaign: Campaign, manifest: Mapping[str, Any], counts: Mapping[str, int]) -> Iterator[str]:
    """What the vehicle did while BV came over, a line each."""
    if not manifest.get("events_take_time") or campaign.av.acts_before_event:
        return
    if campaign.av.source in ("sumo", "traci"):
        yield "SUMO switches lanes in one step: this vehicle cannot see BV come over, as other drivers do"
    elif counts.get("n_events") and not counts.get("n_took_over_early"):
        yield "it did nothing until BV was on its lane, though it can see it come over some 2 s before: bv_lateral_m"
    if (n := counts.get("n_asked_to_speed_up")) and campaign.av.model is None:  # of our own it is known
        yield f"in {count(n)} tests it asked to speed up before BV was on its lane, and was held (av.takes_over)"


def _scope(campaign: Campaign, manifest: Mapping[str, Any], told: Estimates) -> str:
    if told.elsewhere is not None:
        return elsewhere_words(told.elsewhere)
    best, stopped_by = told.best, told.stopped_by
    ended, target = ENDED.get(stopped_by or "", "interrupted"), campaign.stop.rhw
    if campaign.accept is None and target is not None and stopped_by not in ("rhw", "below_reference", "accept"):
        within = campaign.testing.shells.statement != ASSUMPTION_FREE and best.details.get("within")
        asked = _end(within["rhw"]) if within else best.precision
        reached = f" ± {share(asked)}" if asked <= WIDEST_RHW else f" at over ± {share(WIDEST_RHW)}"
        if not best.n_crashes or best.cautions:
            reached = ", precision not known" if best.n_crashes else ", no crash seen"
        ended += f"{reached}, asked: ± {share(target)}{remedy_words(manifest.get('remedy'))}"
    elif stopped_by == "episodes" and campaign.accept is None:
        ended = "all tests done"
    return f"sampling error in this simulated traffic only ({share(best.confidence)}); ended by: {ended}"


def remedy_words(changes: Mapping[str, float | None] | None) -> str:
    """What would have led further, by settings of the pool; one without a number is to be tried."""
    if changes is None:
        return ""
    if not changes:
        return "; no pool gives as much: ask for a wider stop.rhw"
    told = []
    for key, value in changes.items():
        way = "lower" if key == "pool.relative_error" else "raise"
        told.append(f"{way} {key}" + ("" if value is None else f" to {value:,.10g}"))
    return f"; {' and '.join(told)}"


def elsewhere_words(found: Elsewhere) -> str:
    """On what an answer for other traffic rests."""
    drivers = " and ".join(found.drivers)
    known = f" (off by {share(found.off, least=0.001)} for {drivers})" if drivers else ""
    rests = f"holds if as large a share of each shell crashes as there{known}"
    return f"tests of {found.tested_in}, answered for {found.answered_for}: {rests}"


def _end(value: float | None) -> float:
    """What JSON has as null, because it was infinite."""
    return math.inf if value is None else value


# -- what replicates of the traffic say --


def _with_traffic(rows: list[Row], found: TrafficError | None) -> list[Row]:
    """Rows of an answer with those of its traffic below rate and ratio.

    Where no lane change was seen the rate has but an upper limit, and stands behind the ratio.
    """
    if found is None:
        return rows
    if found.unseen is not None and not found.is_open:
        limit, why = f"< {number(found.rate.both[1])} per test", f"none seen at {found.unseen.where}"
        for i, row in enumerate(rows):
            if row.key == "rate":
                seen = f"{number(found.rate.value)} as fitted" if found.rate.value else row.interval
                rows[i] = replace(row, value=limit, interval=seen, remark=why)
        rows = sorted(rows, key=lambda row: {"verdict": 0, "ratio": 1}.get(row.key, 2))
    place = 1 + max((i for i, row in enumerate(rows) if row.key in ("verdict", "rate", "ratio")), default=-1)
    return [*rows[:place], *traffic_rows(found), *rows[place:]]


def told_of_traffic(content: Mapping[str, Any]) -> list[Row]:
    """Rows of a `TrafficError` from JSON."""
    return list(traffic_rows(TypeAdapter(TrafficError).validate_python(content)))


def _few_replicates(found: TrafficError | None) -> tuple[str, ...]:
    return () if found is None else too_few(found.n_replicates, found.confidence)


def bar_note(bar: Mapping[str, Any]) -> str:
    """Why the tests do not answer some of the environments of a `Bar`."""
    why = {"laws that give no probabilities": bar["no_laws"], "unlike what was tested": bar["unlike"]}
    note = " and ".join(reason for reason, n in why.items() if n)
    return f"{sum(why.values())} of {bar['n']}: {note}" if note and bar["values"] is None else note


def too_few(n_replicates: int, confidence: float) -> tuple[str, ...]:
    """A warning of limits from few replicates; nothing where there are enough."""
    if n_replicates >= LEAST_REPLICATES:
        return ()
    least = math.ceil(2.0 / (1.0 - confidence) - 1e-9)
    none = f" (a {share(confidence)} interval needs {least} at least)" if n_replicates < least else ""
    limits = f"limits of what is not known of the traffic change with their number below {LEAST_REPLICATES}"
    return (f"{n_replicates} replicates{none}: {limits}",)


def traffic_rows(found: TrafficError) -> Iterator[Row]:
    """Lines of the short answer: of the rate, and of its ratio to the first of the others."""
    why = "with sampling error" if found.unseen is None else f"none seen at {found.unseen.where}"
    if found.is_open:
        why = f"{found.n_refused} of {found.n_replicates} replicates unlike what was tested"
    yield Row("traffic", "traffic", f"{times(found.rate)} (fitted)", _ends(found), why)
    for name, each in list(found.ratios.items())[: 0 if found.is_open else 1]:
        yield Row(
            "traffic_ratio", "traffic, × driver", f"{times(each)} (fitted)", _of_ratio(each), f"the ratio to {name}"
        )


def _ends(found: TrafficError) -> str:
    if found.is_open:
        return MISSING
    return interval(*found.rate.both) if found.rate.times[0] > 0.0 else f"< {number(found.rate.both[1])}"


def _of_ratio(of: Uncertain) -> str:
    low, high = of.both
    if math.isfinite(high):
        return f"{ratio(low)} to {ratio(high)}" if low > 0.0 else f"< {ratio(high)}"
    return f"at least {ratio(low)}" if low > 0.0 else "no limit"


def times(of: Uncertain) -> str:
    """``× 0.6 … × 2.1``, or ``at most × 27``."""
    low, high = (number(end, 2 if end > 0.0 and abs(math.log(end)) > CLOSE else 3) for end in of.times)
    if of.times[0] > 0.0:
        return f"× {low} … × {high}"
    return f"at most × {high}" if math.isfinite(of.times[1]) else "no limit"
