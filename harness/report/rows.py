"""The rows of an answer, in words: rate, ratio, impact, and what else is known of a run, from ``estimates.json``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from harness.campaign.campaign import Campaign
from harness.estimators.answer import AssumedOfRate, Estimates, before_event, n_softened
from harness.estimators.estimate import Estimate
from harness.estimators.severity import HARD_MPS, TOUCH_MPS, Severity
from harness.estimators.traffic import NotMoved, TrafficError, Uncertain
from harness.families import family_named
from harness.numbers import MISSING, count, interval, number, plain, ratio, share, tenths
from harness.strata import ASSUMPTION_FREE, LIBRARY_STATEMENT

ANY_SHARE = 0.95
"""Width of the interval of a share from which on it says nothing [assumed]."""
LEAST_REPLICATES = 100
"""With fewer, quantiles far out in the tails change with their number [assumed]."""
CLOSE = 0.1
"""Factors closer to 1 than so much on a logarithmic scale are told with three digits."""


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


def end(value: float | None) -> float:
    """What JSON has as null, because it was infinite."""
    return math.inf if value is None else value


def rows_of(campaign: Campaign, manifest: Mapping[str, Any], estimates: Estimates) -> Iterator[Row]:
    """All but those of the traffic's replicates."""
    best, decision, assumed = estimates.best, estimates.decision, estimates.assumed
    if decision is not None:
        yield decided(decision)
    wide = best.is_wide
    from_below = wide and (best.is_open_above or (decision is not None and decision["verdict"] == "rejected"))
    unseen = assumed if assumed is not None and assumed.no_lower_limit else None
    so_far = " so far" if best.untested and best.n_crashes else ""
    above_mps = campaign.crash.counts_above_mps
    what = (f"crash rate > {plain(above_mps)} m/s" if above_mps else "crash rate") + so_far
    rates = manifest.get("tests_per_hour"), f" per million km{family_named(campaign.scenario).words.such}"
    rows = [_rate_row(what, rates, estimates, unseen, from_below=from_below)]
    references = [each for each in best.details.get("references", ()) if each["crash_rate"] > 0.0][:1]
    how = {"wide": wide, "from_below": from_below}
    how["softened"] = n_softened(before_event(campaign, manifest, estimates.diagnostics)) > 0
    rows += [_beside(reference, acts=campaign.av.acts_before_event, **how) for reference in references]
    # Where little else is known of the rate than a limit, the ratio, of which more is known, comes first.
    yield from reversed(rows) if unseen or (wide and references and end(references[0]["ratio_high"]) < 1.0) else rows
    if not references and campaign.has_baseline_runs and "shells" in best.details and not best.cautions:
        yield Row("ratio", "× competent driver", "no ratio", "", "that driver never crashes here")
    if assumed is not None and (others := looking_words(assumed)) and not from_below:
        most, highest = f"up to {number(assumed.most, 2)} times", f"up to {number(assumed.most * best.upper_limit)}"
        yield Row("assumed", "in other traffic", most, highest, f"if {others}")
    if campaign.has_baseline_runs and best.n_crashes:
        yield from width_row(campaign, best, manifest.get("expected"))
    if estimates.severity is not None:
        yield _severity(estimates.severity, so_far, above_mps)
    if "within" in best.details and campaign.testing.shells.statement != ASSUMPTION_FREE:
        yield within(best.details["within"])


def _rate_row(
    what: str, per: tuple[float | None, str], estimates: Estimates, unseen: AssumedOfRate | None, *, from_below: bool
) -> Row:
    """The rate with its interval, or with one limit alone where the other end says nothing; also ``per`` hour or km."""
    best, distance_km, (tests_per_hour, of_km) = estimates.best, estimates.distance_per_test_km, per
    sign, shown, ends = "", best.crash_rate, interval(best.ci_low, best.ci_high, beside=best.crash_rate)
    sampled = f"estimate {number(best.crash_rate)}" if best.n_crashes else "no crash seen"
    if unseen is not None:
        sign, shown = "< ", unseen.most * best.upper_limit
        ends = f"{number(best.crash_rate)} as fitted" if best.n_crashes else sampled
    elif from_below:
        sign, shown, ends = "> ", best.ci_low, sampled
    elif not best.n_crashes or best.is_wide:
        sign, shown, ends = "< ", best.upper_limit, sampled
    remark = f"{sign}{number(shown * 1e6 / distance_km)}{of_km}" if distance_km else ""
    if tests_per_hour is not None:
        remark = f"{sign}{number(shown * tests_per_hour)} per hour"
    if unseen is not None:
        remark = f"none seen at {unseen.where}"
    return Row("rate", what, f"{sign}{number(shown)} per test", ends, remark)


def looking_words(assumed: AssumedOfRate) -> str:
    """In which other traffic a rate moves most; empty where no range is stated of its drivers."""
    if assumed.highest is None or assumed.times is None:
        return ""
    here = "" if assumed.share is None else f", not {plain(100.0 * assumed.share)} %,"
    return f"{plain(100.0 * assumed.highest)} %{here} do not look behind"


def width_row(campaign: Campaign, best: Estimate, expected: Mapping[str, int] | None) -> Iterator[Row]:
    """Which of baseline runs and tests makes the interval as wide as it is, and how many of both may do."""
    rhw, rhw_of_runs = best.rhw, end(best.details.get("rhw_from_pool"))
    if not (math.isfinite(rhw) and math.isfinite(rhw_of_runs)):
        return
    which = "runs" if 2.0 * rhw_of_runs * rhw_of_runs > rhw * rhw else "tests"
    remark = "" if expected is None else f"try stop.episodes={expected['tests']}"
    if expected is not None and expected["runs"] != campaign.pool.shadow_paths:
        remark = f"try pool.shadow_paths={expected['runs']}, {count(expected['tests'])} tests"
    alone = f"{count(campaign.pool.shadow_paths)} baseline runs ± {share(rhw_of_runs)}"
    yield Row("width", "precision", f"± {share(rhw)}, mostly by {which}", alone, remark)


def _severity(severity: Severity, so_far: str, counts_above_mps: float) -> Row:
    above = _share_within(severity.share_above_5_mps, severity.limits_above_5_mps, f" above {plain(HARD_MPS)} m/s")
    below = _share_within(severity.share_below_1_mps, severity.limits_below_1_mps, f" below {plain(TOUCH_MPS)} m/s")
    below = below if counts_above_mps < TOUCH_MPS else ""  # such are no crashes then
    return Row("impact", f"impact speed{so_far}", f"median {tenths(severity.median_mps)} m/s", above, below)


def _share_within(value: float, limits: tuple[float, float] | None, suffix: str) -> str:
    """A share with its interval in whole per cent, where there is one; nothing where that may be nearly any."""
    if limits is None:
        return share(value) + suffix
    low, high = limits
    return "" if high - low > ANY_SHARE else f"{share(value)} ({100.0 * low:.0f}–{100.0 * high:.0f} %){suffix}"


def limit_words(decision: Mapping[str, Any], per: str) -> str:
    """What a verdict is about: a rate ``per`` test or hour, or that of a driver."""
    driver = decision.get("driver")
    return f"{plain(decision['limit'])} × {driver}" if driver else f"{plain(decision['limit'])} per {per}"


def held_back(decision: Mapping[str, Any]) -> bool:
    """Whether only what a warning tells of keeps a vehicle from being accepted."""
    return bool(decision["verdict"] == "undecided" and end(decision["high"]) < decision["limit"])


def decided(decision: Mapping[str, Any], per: str = "test") -> Row:
    """The verdict on a limit, of one scenario or, ``per`` hour, of several."""
    limit, verdict = limit_words(decision, per), decision["verdict"]
    low, high = number(decision["low"]), number(end(decision["high"]))
    open_above = f"at least {low}" if decision["low"] else "nothing is known yet"
    value, ends = {
        "accepted": (f"rate below {limit}", f"at most {high}"),
        "rejected": (f"rate above {limit}", f"at least {low}"),
    }.get(verdict, (f"limit {limit}", open_above if decision["high"] is None else f"it may be {low} to {high}"))
    if held_back(decision):
        value, ends = f"rate below {limit}", "yet not accepted, see !"
    condition = "" if decision["statement"] == ASSUMPTION_FREE else f", given {decision['statement']}"
    return Row(
        "verdict", verdict.upper(), value, f"confidence {plain(decision['confidence'])} over all looks{condition}", ends
    )


def _beside(reference: Mapping[str, Any], *, acts: bool, **how: bool) -> Row:
    driver = {"r157-cc": "r157-cc, UN R157’s driver"}.get(reference["reference"], reference["reference"])
    if acts:  # it takes over from the vehicle's own motion: what making room saves is not in the ratio
        driver = f"{reference['reference']}, from the same state"
    return Row("ratio", "× competent driver", *ratio_texts(reference, **how), driver)


def ratio_texts(
    reference: Mapping[str, Any], *, wide: bool = False, from_below: bool = False, softened: bool = False
) -> tuple[str, str]:
    """A ratio to a reference, and its interval, of which a ``wide`` one says what it says with one end alone.

    That a vehicle crashes less is said with a reserve where it has ``softened`` the events (`n_softened`).
    """
    less = "crashes less, see !" if softened else "crashes less"
    low, high, value = reference["ratio_low"], end(reference["ratio_high"]), reference["ratio"]
    most = "no limit" if math.isinf(high) else ratio(high)
    if not value:
        return f"< {most}", "no crash seen"
    if wide and (high < 1.0 or (low <= 1.0 and not from_below and high < math.inf)):  # as the row of the rate
        side = less if high < 1.0 else "not told apart"
        return f"< {most} ({side})", f"estimate {ratio(value)}, {ratio(low)} to {most}"
    if from_below and low > 1.0:
        return f"> {ratio(low)} (crashes more)", f"estimate {ratio(value)}"
    side = "not told apart" if low <= 1.0 <= high else "crashes more" if low > 1.0 else less
    return f"{ratio(value)} ({side})", f"≥ {ratio(low)}" if from_below else f"{ratio(low)} to {most}"


def ratio_warning(estimates: Estimates) -> Iterator[str]:
    """That the ratio to the reference driver, too, moves with how many drivers do not look behind."""
    assumed, decision = estimates.assumed, estimates.decision
    references = [each for each in estimates.best.details.get("references", ()) if each["crash_rate"] > 0.0][:1]
    if assumed is None or not assumed.moves_ratio or not references:
        return
    low, high = sorted(references[0]["ratio"] * times for times in assumed.ratio_times or ())
    turns = ""
    if decision is not None and decision.get("driver") and decision["verdict"] != "undecided":
        accepted, limit = decision["verdict"] == "accepted", decision["limit"]
        turns = ", which may turn the verdict" * (high >= limit if accepted else low <= limit)
    here = "" if assumed.share is None else f", at {plain(100.0 * assumed.share)} %"
    ends = " to ".join(map(ratio, (low, high)))
    yield f"the ratio rests on who does not look behind{here}; over the assumed range it is {ends}{turns}"


def within(estimate: Mapping[str, Any]) -> Row:
    """What holds if the vehicle crashes only within the library's boundary, and whether it does."""
    n, outside = estimate["n_crashes_outside"], count(estimate["n_episodes_outside"])
    what = f"given the {LIBRARY_STATEMENT}"
    if estimate["refuted"]:
        return Row("within", what, "REFUTED", "", f"{count(n)} crashes in {outside} tests outside it")
    beyond = f"no crash in {outside} tests outside it" if estimate["n_episodes_outside"] else "no tests outside it"
    if not estimate["n_crashes"]:
        return Row("within", what, f"< {number(estimate['ci_high'])}", "", beyond)
    rate = estimate["crash_rate"]
    return Row("within", what, number(rate), interval(estimate["ci_low"], estimate["ci_high"], beside=rate), beyond)


# -- what replicates of the traffic leave open --


def with_traffic(rows: list[Row], traffic: TrafficError | None) -> list[Row]:
    """Rows of an answer with those of its traffic below rate and ratio.

    Where no lane change was seen the rate has but an upper limit, and stands behind the ratio.
    """
    if traffic is None:
        return rows
    if traffic.unseen is not None and not traffic.is_open:
        limit, why = f"< {number(traffic.rate.both[1])} per test", f"none seen at {traffic.unseen.where}"
        for i, row in enumerate(rows):
            if row.key == "rate":
                fitted = f"as fitted {number(traffic.rate.value)}" if traffic.rate.value else row.interval
                rows[i] = replace(row, value=limit, interval=fitted, remark=why)
        rows = sorted(rows, key=lambda row: {"verdict": 0, "ratio": 1}.get(row.key, 2))
    place = 1 + max((i for i, row in enumerate(rows) if row.key in ("verdict", "rate", "ratio")), default=-1)
    return [*rows[:place], *traffic_rows(traffic), *rows[place:]]


def traffic_rows(traffic: TrafficError) -> Iterator[Row]:
    """Lines of the short answer: of the rate, and of its ratio to the first of the others."""
    why = "with sampling error" if traffic.unseen is None else f"none seen at {traffic.unseen.where}"
    both, ends = traffic.rate.both, MISSING
    if traffic.is_open:
        why = f"{traffic.n_refused} of {traffic.n_replicates} replicates unlike what was tested"
    else:
        ends = interval(*both) if traffic.rate.times[0] > 0.0 else f"< {number(both[1])}"
    yield Row("traffic", "error of the fit", _times(traffic.rate), ends, why)
    for name, uncertain in list(traffic.ratios.items())[: 0 if traffic.is_open else 1]:
        yield Row("traffic_ratio", "the same, ratio", _times(uncertain), _of_ratio(uncertain), f"the ratio to {name}")


def _of_ratio(uncertain: Uncertain) -> str:
    low, high = uncertain.both
    if math.isfinite(high):
        return f"{ratio(low)} to {ratio(high)}" if low > 0.0 else f"< {ratio(high)}"
    return f"at least {ratio(low)}" if low > 0.0 else "no limit"


def _times(uncertain: Uncertain) -> str:
    """``0.6 to 2.1 times``, or ``up to 27 times``."""
    low, high = (number(end, 2 if end > 0.0 and abs(math.log(end)) > CLOSE else 3) for end in uncertain.times)
    if uncertain.times[0] > 0.0:
        return f"{low} to {high} times"
    return f"up to {high} times" if math.isfinite(uncertain.times[1]) else "no limit"


def bar_note(bar: Mapping[str, Any]) -> str:
    """Why the tests do not answer some of the environments of a `Bar`; of an end unlike them, a dash says so."""
    why = {"laws that give no probabilities": bar["no_laws"], "unlike what was tested": bar["unlike"]}
    if bar["values"] is not None:
        return "laws that give no probabilities" * bool(bar["no_laws"])
    note = " and ".join(reason for reason, n in why.items() if n)
    return f"{sum(why.values())} of {bar['n']}: {note}" if note else ""


def not_moved_words(of: NotMoved) -> str:
    """Which numbers of a scenario of several stand in no bar, and why."""
    called = family_named(of.scenario).words.called
    if not of.found:
        return f"Of {called} no test crashed: its bars move the competent driver alone, and no bar the upper limit."
    return (
        f"Not moved: the numbers of {called} ({share(of.share)} of the rate). Found: {of.found}; needed: {of.needed}."
    )


def too_few(n_replicates: int, confidence: float) -> tuple[str, ...]:
    """A warning of limits from few replicates; nothing where there are enough."""
    if n_replicates >= LEAST_REPLICATES:
        return ()
    least = math.ceil(2.0 / (1.0 - confidence) - 1e-9)
    none = f" (a {share(confidence)} interval needs at least {least})" if n_replicates < least else ""
    return (f"only {n_replicates} replicates{none}: the error of the fit is rough below {LEAST_REPLICATES}",)
