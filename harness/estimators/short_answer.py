"""The answer at a glance: some nine lines for a terminal, and the same rows for the first screen of the page."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AutomatedVehicle
from harness.estimators.estimate import Estimate
from harness.estimators.severity import HARD_MPS, TOUCH_MPS, Severity
from harness.numbers import (
    WIDEST_RHW,
    count,
    duration,
    interval,
    leaves,
    number,
    plain,
    ratio,
    share,
    tenths,
    two_digits_up,
    words,
)
from harness.strata import ASSUMPTION_FREE, LIBRARY_STATEMENT, Assumed

WIDTH, LINES, LABEL = 100, 9, 26
MOST_WARNINGS = 3
CUT_OFF_SHARE = 0.2
"""Weight, relative to the rate, from which tests that were cut off are warned of, if the interval leaves them out."""
ANY_SHARE = 0.95
"""Width of the interval of a share from which on it says nothing [assumed]."""
CARRIES = 0.05
"""Share of a rate from which on there is an upper limit alone, where nothing was seen of it [assumed]."""
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


def short_answer(
    campaign: Campaign,
    best: Estimate,
    severity: Severity | None,
    manifest: Mapping[str, Any],
    distance_km: float | None,
    counts: Mapping[str, int],
) -> ShortAnswer:
    """The answer by a campaign's own estimate ``best``; ``distance_km`` is the mean of a test, if it is known.

    ``counts`` says in how many tests the vehicle did something before BV was on its lane, or asked for it in vain.
    """
    vehicle, parameters = vehicle_words(campaign.av)
    engine = "SUMO" if campaign.world.engine == "sumo" else "SUMO’s twin"
    return ShortAnswer(
        vehicle=vehicle,
        parameters=tuple(parameters),
        tests=f"{count(best.n_episodes)} tests in {engine}",
        rows=tuple(_rows(campaign, best, severity, manifest, distance_km)),
        warnings=(*_warnings(campaign, best, severity, manifest), *_before_overlap(campaign, manifest, counts)),
        scope=_scope(campaign, best, manifest.get("stopped_by"), manifest.get("remedy")),
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


def _rows(
    campaign: Campaign,
    best: Estimate,
    severity: Severity | None,
    manifest: Mapping[str, Any],
    distance_km: float | None,
) -> Iterator[Row]:
    if (decision := manifest.get("decision")) is not None:
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
    unseen = no_lower_limit(best, manifest)
    if unseen is not None:
        less, ends = "< ", f"{number(best.crash_rate)} as fitted" if best.n_crashes else ends
        shown = unseen[1] * (best.ci_high if best.n_crashes else best.upper_bound)
    per_km = "" if not distance_km else f"{less}{number(shown * 1e6 / distance_km)} per million km"
    remark = per_km if unseen is None else f"none seen at {unseen[0]}"
    so_far = " so far" if best.untested and best.n_crashes else ""
    rows = [Row("rate", f"{counted}{so_far}", f"{less}{number(shown)} per test", ends, remark)]
    beside = [each for each in best.details.get("references", ()) if each["crash_rate"] > 0.0][:1]
    acts = campaign.av.acts_before_cut_in
    rows += [_beside(each, acts=acts, wide=wide, from_below=from_below) for each in beside]
    # Where little else is known of the rate than a limit, what is known comes first: the ratio.
    yield from reversed(rows) if unseen or (wide and beside and beside[0]["ratio_high"] < 1.0) else rows
    if not beside and campaign.has_baseline_runs and "shells" in best.details and not best.cautions:
        yield Row("ratio", "× competent driver", "no ratio", "", "such drivers never crash here")
    highest = assumed_of(manifest).highest
    if highest is not None and (moved := assumed_times(best, manifest)) is not None:
        high = moved[1] * (best.ci_high if best.n_crashes else best.upper_bound)
        ends = "" if from_below else f"up to {number(high)}"
        remark = f"if {share(highest)} do not look"
        yield Row("assumed", "traffic", f"at most × {number(moved[1], 2)} (assumed)", ends, remark)
    if campaign.has_baseline_runs and best.n_crashes:
        yield from _whence(campaign, best, manifest.get("expected"))
    if severity is not None:
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


def assumed_of(manifest: Mapping[str, Any]) -> Assumed:
    """What the manifest says to be assumed."""
    return Assumed(**manifest.get("assumed") or {})


def assumed_times(best: Estimate, manifest: Mapping[str, Any]) -> tuple[float, float] | None:
    """By what the rate moves over what the manifest says to be ``assumed``; None where it does not.

    Without a crash it is the upper limit that moves, which lies in one stratum.
    """
    times = assumed_of(manifest).times
    if times is None or not (shells := best.details.get("shells")):
        return None
    p, n, share = np.array([(each["p"], max(each["n_episodes"], 1), each["crash_share"]) for each in shells]).T
    of_strata = [p, *(p * np.array(each) for each in times)]
    rates = [float(each @ share) if best.n_crashes else float(np.max(each / n)) for each in of_strata]
    return rates[1] / rates[0], rates[2] / rates[0]


def no_lower_limit(best: Estimate, manifest: Mapping[str, Any]) -> tuple[str, float] | None:
    """Where none of the lane changes was seen that a rate comes from, and by what that may raise it; None elsewhere."""
    where = assumed_of(manifest).where
    if not where or (times := assumed_times(best, manifest)) is None or times[1] - times[0] < CARRIES:
        return None
    return where, times[1]


def unseen_words(where: str) -> str:
    """The same where it is not known by what the rate may rise."""
    return f"no lane change was seen at {where} in the data of this traffic: rates have only an upper limit"


def _whence(campaign: Campaign, best: Estimate, expected: Mapping[str, int] | None) -> Iterator[Row]:
    """Which of baseline runs and tests makes the interval as wide as it is, and how many of both may do."""
    whole, runs = best.rhw, best.details.get("rhw_from_pool", math.inf)
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
    low, high = found["ratio_low"], found["ratio_high"]
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


def _warnings(
    campaign: Campaign, best: Estimate, severity: Severity | None, manifest: Mapping[str, Any]
) -> Iterator[str]:
    """What changes the meaning of the rows, a line each."""
    yield from best.cautions
    repeated = manifest.get("repeated") or {}
    if n := len(repeated.get("differing", ())):
        yield f"NOT REPRODUCIBLE: {count(n)} of {count(repeated['n_episodes'])} tests that ran twice came out otherwise"
    if n := best.details["n_failed"]:
        had = number(best.details["crash_rate_if_failed_had_crashed"])
        yield f"{count(n)} of {count(best.n_episodes)} tests FAILED; had they all crashed, the rate would be {had}"
    if severity is not None and severity.share_below_1_mps > 0.5:
        yield f"{share(severity.share_below_1_mps)} of this rate are touches below {plain(TOUCH_MPS)} m/s"
    given = assumed_of(manifest)
    if given.where and given.times is None:
        yield unseen_words(given.where)
    decision = manifest.get("decision")
    if decision is not None and not decision.get("driver") and (unseen := no_lower_limit(best, manifest)):
        yield f"no lane change was seen at {unseen[0]}: a limit on the rate rests on that; ask --accept r157-cc"
    worst = best.crash_rate + (0.0 if severity is None else severity.cut_off)
    if worst > max((1.0 + CUT_OFF_SHARE) * best.crash_rate, best.ci_high):
        yield f"time was up while it closed in: had all these tests crashed, {number(worst)} per test"
    if (level := campaign.environment.lane_change_level) != 1.0:
        yield f"lane-change level {plain(level)}: never compare with rates of other levels"


def _before_overlap(campaign: Campaign, manifest: Mapping[str, Any], counts: Mapping[str, int]) -> Iterator[str]:
    """What the vehicle did while BV came over, a line each."""
    if not manifest.get("cut_ins_take_time") or campaign.av.acts_before_cut_in:
        return
    if campaign.av.source in ("sumo", "traci"):
        yield "SUMO switches lanes in one step: this vehicle cannot see BV come over, as other drivers do"
    elif counts.get("n_cut_ins") and not counts.get("n_took_over_early"):
        yield "it did nothing until BV was on its lane, though it can see it come over some 2 s before: bv_lateral_m"
    if n := counts.get("n_asked_to_speed_up"):
        yield f"in {count(n)} tests it asked to speed up before BV was on its lane, and was held (av.takes_over)"


def _scope(campaign: Campaign, best: Estimate, stopped_by: str | None, remedy: str | None) -> str:
    ended, target = ENDED.get(stopped_by or "", "interrupted"), campaign.stop.rhw
    if campaign.accept is None and target is not None and stopped_by not in ("rhw", "below_reference", "accept"):
        within = campaign.testing.shells.statement != ASSUMPTION_FREE and best.details.get("within")
        asked = within["rhw"] if within else best.precision
        reached = f" ± {share(asked)}" if asked <= WIDEST_RHW else f" at over ± {share(WIDEST_RHW)}"
        if not best.n_crashes or best.cautions:
            reached = ", precision not known" if best.n_crashes else ", no crash seen"
        ended += f"{reached}, asked: ± {share(target)}"
        ended += f"; {remedy}" if remedy else ""
    elif stopped_by == "episodes" and campaign.accept is None:
        ended = "all tests done"
    return f"sampling error in this simulated traffic only ({share(best.confidence)}); ended by: {ended}"


def lines(answer: Mapping[str, Any], took_s: float | None, report: Path | None = None) -> list[str]:
    """An answer (``answer`` in ``estimates.json``) for a terminal: at most `LINES` lines.

    Those of more than `WIDTH` columns go on below. Where there is much to warn of the last rows give way: all of it is
    on the page.
    """
    warnings = [f"! {text}" for text in answer["warnings"]]
    if len(warnings) > MOST_WARNINGS:
        warnings[MOST_WARNINGS - 1 :] = [f"! {count(len(warnings) - MOST_WARNINGS + 1)} more warnings: see the report"]
    ends = [answer["scope"], *([] if report is None else [f"report  {report}"])]
    rows = answer["rows"][: LINES - 1 - len(warnings) - len(ends)]
    parameters = ", ".join(f"{name} {value}" for name, value in answer["parameters"])
    head = [answer["vehicle"], answer["tests"], *([] if took_s is None else [duration(took_s)])]
    if parameters:
        room = WIDTH - len(" · ".join(head)) - 3
        head[0] += f" ({textwrap.shorten(parameters, max(room, 8), placeholder=' …')})"
    table = _columns([(row["what"], row["value"], row["interval"], row["remark"]) for row in rows])
    return [" · ".join(head), *table, *_wrapped([*warnings, ends[0]]), *(f"  {line}" for line in ends[1:])]


def _columns(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Rows of equally many texts, each column as wide as its widest; a row too long for that is pushed together."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        *others, last = (text.ljust(width) for text, width in zip(row, widths, strict=True))
        left, remark = "  ".join(["", *others]).rstrip(), last.rstrip()
        line = "  ".join(["", *others, remark]).rstrip()
        if len(line) > WIDTH:
            line = f"{left}  {remark:>{max(WIDTH - 2 - len(left), 0)}}"
        yield from [line] if len(line) <= WIDTH else _wrapped(["  ".join(filter(None, row))])


def _wrapped(texts: Iterable[str]) -> Iterator[str]:
    """Lines of at most `WIDTH` columns, which begin after two spaces and go on after four."""
    fill = textwrap.TextWrapper(WIDTH, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False)
    for text in texts:
        whole = text.replace(" %", "\u00a0%").replace("± ", "±\u00a0")  # a number and its sign stay together
        yield from (line.replace("\u00a0", " ") for line in fill.wrap(whole))


def deciding_words(content: Mapping[str, Any], s_per_pair: float | None = None) -> str | None:
    """What would decide a comparison (``compare.json``) that was left open, and its cost; None of a decided one."""
    if content["decision"]["verdict"] != "open":
        return None
    if (needed := content["to_decide"]) is None:
        return "no number of pairs is known that would decide: as far as was seen, they are too much alike"
    where, done = (" and a new --out", 0) if needed["new_folder"] else ("", content["n_pairs"])
    n = two_digits_up(needed["pairs"] - done)
    cost = "" if s_per_pair is None else f", {duration(n * s_per_pair)}"
    return f"to decide, give the same command with {needed['options']}{where}: some {count(n)} more pairs{cost}"


def pair_asked(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """What lies between A and B under the statement that the comparison (``compare.json``) was asked for."""
    given = content.get("asked") == LIBRARY_STATEMENT and not content["conditional"].get("refuted")
    asked: Mapping[str, Any] = content["conditional"] if given else content
    return asked


def pair_lines(
    content: Mapping[str, Any], counts_above_mps: float, report: Path, s_per_pair: float | None = None
) -> list[str]:
    """A comparison (``compare.json``) for a terminal, as short as `lines`; ``s_per_pair`` is what a pair takes."""
    asked = pair_asked(content)
    rows = []
    for name in "AB":
        of, label = content[name.lower()], content["campaigns"][name.lower()]["label"]
        rate, ends = number(of["crash_rate"]), interval(of["ci_low"], of["ci_high"])
        if not of["n_crashes"]:
            rate, ends = f"< {number(of['upper_bound'])}", "no crash seen"
        label = label if len(label) <= LABEL else f"{label[: LABEL - 2]} …"
        rows.append((f"{name} {label}", rate, ends, f"{count(of['n_crashes'])} crashes"))
    if asked["ratio"] is not None:
        most = "no limit" if asked["ratio_high"] is None else ratio(asked["ratio_high"])
        rows.append(("A / B", ratio(asked["ratio"]), f"{ratio(asked['ratio_low'])} to {most}", ""))
    alone = f"A alone {count(asked['n_only_a'])}, B alone {count(asked['n_only_b'])}"
    rows.append(("A − B", number(asked["difference"]), interval(asked["ci_low"], asked["ci_high"]), alone))
    remarks = [f"! {text}" for text in content["warnings"]]
    if asked is not content:
        given = f"A / B and A − B are given that both crash only where {asked['boundary']} of the library does"
        remarks.insert(0, given)
    ended = ENDED.get(content.get("ended", ""), "interrupted")
    scope = f"sampling error in this simulated traffic only ({share(content['confidence'])}); ended by: {ended}"
    counted = f" above {plain(counts_above_mps)} m/s" if counts_above_mps else ""
    pairs = f"{count(content['n_pairs'])} pairs of tests"
    head = f"{content['decision']['words']} · {pairs} · crashes{counted} per test"
    last = [*filter(None, [deciding_words(content, s_per_pair)]), scope]
    return [head, *_columns(rows), *_wrapped([*remarks[: 3 - len(last)], *last]), f"  report  {report}"]
