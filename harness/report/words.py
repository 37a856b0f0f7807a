"""The answer at a glance, in words, from the numbers of ``estimates.json``: for terminal, page and JUnit.

Here are its vehicle, warnings and scope, and its layout for a terminal; its rows are in `harness.report.rows`.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AutomatedVehicle
from harness.estimators.answer import STORED_ESTIMATES, Elsewhere, Estimates, before_event
from harness.estimators.limits import clopper_pearson
from harness.estimators.severity import TOUCH_MPS
from harness.families import family_named
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
    tests,
    two_digits_up,
    words,
)
from harness.report.acted import acted_words
from harness.report.notes import note_words
from harness.report.rows import Row, end, held_back, ratio_warning, rows_of, too_few, with_traffic
from harness.sampling.paths import n_left_out
from harness.strata import ASSUMPTION_FREE
from harness.vehicles.kinematics import STEP_S

EARLY = "n_crashes_before_event"
CUT_OFF_SHARE = 0.2
"""Weight, relative to the rate, from which tests that were cut off are warned of, if the interval leaves them out."""
ENDED = {
    "rhw": "precise enough",
    "below_reference": "clearly below the competent driver",
    "accept": "verdict reached",
    "episodes": "budget of tests (stop.episodes) used up",
    "pool": "the pool has no further event that would narrow it",
    "pool_error": "the pool’s own error is too wide",
    "sum": "with the sum of all scenarios",
}
"""Why a campaign ended (`harness.vocabulary.StoppedBy`), in words."""


def ended_words(stopped_by: str | None, decision: Mapping[str, Any] | None) -> str:
    """Why the tests ended."""
    held = stopped_by == "accept" and decision is not None and held_back(decision)
    return "rate below the limit" if held else ENDED.get(stopped_by or "", "interrupted")


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


def short_answer(campaign: Campaign, manifest: Mapping[str, Any], estimates: Estimates) -> ShortAnswer:
    """The answer of a run's estimates, with what its ``manifest`` says besides."""
    vehicle, parameters = vehicle_words(campaign.av, manifest.get("tried_script"))
    return ShortAnswer(
        vehicle=vehicle,
        parameters=tuple(parameters),
        tests=tests_words(estimates.n_episodes, campaign.world.engine, family_named(campaign.scenario).words.called),
        rows=tuple(with_traffic(list(rows_of(campaign, manifest, estimates)), estimates.traffic)),
        warnings=tuple(_warnings(campaign, manifest, estimates)),
        scope=_scope(campaign, manifest, estimates),
    )


def tests_words(n: int, engine: str, scenario: str) -> str:
    """How many tests, and of what."""
    return f"{tests(n)} in {'SUMO' if engine == 'sumo' else 'SUMO’s twin'}, {scenario}"


def vehicle_words(av: AutomatedVehicle, script: Mapping[str, float] | None = None) -> tuple[str, list[tuple[str, str]]]:
    """Who drives the vehicle, and its parameters that are not defaults; ``script`` as in the manifest."""
    chosen = dict[str, Any]()
    for section, key in ((av.parameters, ""), (av.reaction, "reaction")):
        if isinstance(section, BaseModel):
            usual = type(section)().model_dump()
            changed = {name: value for name, value in section.model_dump().items() if value != usual[name]}
        else:
            changed = dict(section)
        chosen |= {key: changed} if key and changed else changed
    name = av.model or Path(av.controller or av.source).name
    if av.sumo is not None:
        chosen |= av.sumo
        name = f"SUMO’s {chosen.pop('carFollowModel', 'Krauss')}"
    elif script:  # SUMO would know its vehicle's type, of which the script may set other numbers
        accel, decel = plain(script["accel_mps2"]), plain(script["decel_mps2"])
        chosen["type"] = f"accel {accel}, decel {decel}, minGap 0"
        chosen |= {} if script["step_s"] == STEP_S else {"step": f"{plain(script['step_s'])} s"}
    elif av.traci is not None:
        name = f"TraCI client {Path(av.traci.command.split()[0]).name}"
    elif av.fmu is not None:
        chosen |= av.fmu.start_values
        name = Path(av.fmu.file).name
    return name, [(path, plain(value) if isinstance(value, float) else words(value)) for path, value in leaves(chosen)]


def unseen_words(where: str) -> str:
    """What a rate has only an upper limit for: no lane change was seen there."""
    return f"no lane change was seen at {where} in the data of this traffic: rates have only an upper limit"


def doubts_of(
    campaign: Campaign, manifest: Mapping[str, Any], estimates: Estimates, times: float = 1.0
) -> dict[str, Any]:
    """What may make the rate of a run doubtful, for `warnings_of`; rates are per test, multiplied by ``times``."""
    best, severity = estimates.best, estimates.severity
    references = [each["crash_rate"] for each in best.details.get("references", ()) if each["crash_rate"] > 0.0]
    return {
        "reference_rate": times * references[0] if references else None,
        EARLY: n_left_out(campaign, estimates.diagnostics.get(EARLY, 0)), "milder": estimates.milder,
        "if_failed_had_crashed": times * best.details["crash_rate_if_failed_had_crashed"],
        "cut_off": times * estimates.cut_off, "cut_off_test": estimates.cut_off_test,
        "cautions": best.cautions, "repeated": manifest.get("repeated"), "failure": manifest.get("failure"),
        "share_below_1_mps": None if severity is None else severity.share_below_1_mps,
        "missed": _missed(manifest, estimates, times),
        "assumed": estimates.assumed, "before_event": before_event(campaign, manifest, estimates.diagnostics),
    }  # fmt: skip


def _missed(manifest: Mapping[str, Any], estimates: Estimates, times: float) -> dict[str, Any] | None:
    """How often it may crash in a way so rare that no baseline run showed it; None without baseline runs."""
    baseline, shells = manifest.get("shadow_runs"), estimates.best.details.get("shells")
    if not baseline or not shells:
        return None
    share_unseen = float(clopper_pearson(0, baseline["n_runs"], 1.0 - estimates.confidence)[1])
    rate = times * share_unseen * math.fsum(shell["p"] for shell in shells)
    return {"n_runs": baseline["n_runs"], "drives": round(1.0 / share_unseen), "rate": rate}


def warnings_of(scenario: str, result: Mapping[str, Any], unit: str, but: str = "") -> Iterator[str]:
    """What changes the meaning of a rate, a line each; rates are in a ``unit``.

    ``result`` holds the rate, ``ci_high``, numbers of tests, and `doubts_of`; ``but`` is added to the line on tests cut
    off.
    """
    milder = result["milder"]
    if milder is not None and (n_bad := milder["n_crashes"] + milder["n_failed"]):
        events = family_named(scenario).words.events
        ends = " or FAIL" if milder["n_failed"] else ""
        rate = number(milder["per_hour"] * n_bad / milder["n_tests"], 2)
        yield (
            f"{count(n_bad)} of {count(milder['n_tests'])} MILDER {events} end in a crash{ends}, too: some {rate} an "
            "hour, which this rate leaves out (docs/families.md says how to count them)"
        )
    if n := result[EARLY]:
        yield (
            f"{tests(n)} crashed BEFORE the event, as it just followed: it does so in all driving, of "
            "which this rate counts only the seconds before events"
        )
    yield from map(note_words, result["cautions"])
    repeated = result["repeated"] or {}
    if n := len(repeated.get("differing", ())):
        again = count(repeated["n_episodes"])
        yield f"NOT REPRODUCIBLE: {count(n)} of {again} tests run twice differed: see `harness av-check --tests 400`"
    if (missed := result.get("missed")) and missed["rate"] > result["ci_high"]:
        n = two_digits_up(missed["n_runs"] * missed["rate"] / result["ci_high"])
        n_runs, drives = count(missed["n_runs"]), missed["drives"]
        unseen = f"crashes there, up to {number(missed['rate'])}{unit}, are in no limit (pool.shadow_paths={n})"
        yield f"{n_runs} baseline runs may miss what it does in 1 of {drives} drives: {unseen}"
    if n := result["n_failed"]:
        n_tests, rate = count(result["n_episodes"]), _supposed(result["if_failed_had_crashed"], unit, result)
        why = f"; most with: {result['failure']}" if result.get("failure") else ""
        failed = f"{count(n)} of {n_tests} tests FAILED"
        yield f"{failed}; had they all crashed, as upper limits assume, the rate would be {rate}{why}"
    if _cut_off_counts(result["rate"], result["cut_off"], result["ci_high"]):
        ended = f"tests, as test {result['cut_off_test']}, ended while the vehicle was still closing in"
        yield f"{ended}; had all crashed: {_supposed(result['rate'] + result['cut_off'], unit, result)}{but}"
    touches = result.get("share_below_1_mps")
    if touches is not None and touches > 0.5:
        left_out = f"crash.counts_above_mps={plain(TOUCH_MPS)} leaves them out"
        yield f"{share(touches)} of these crashes are touches below {plain(TOUCH_MPS)} m/s: {left_out}"
    yield from acted_words(scenario, result.get("before_event"))


def _supposed(rate: float, unit: str, result: Mapping[str, Any]) -> str:
    """A rate had more tests crashed, and how many times that of the competent driver it would be."""
    reference = result.get("reference_rate")
    return f"{number(rate)}{unit}" + (f", × {ratio(rate / reference)} (competent driver)" if reference else "")


def _cut_off_counts(rate: float, cut_off: float, high: float) -> bool:
    """Whether tests that were cut off, with a rate of their own, matter beside those that crashed."""
    return rate + cut_off > max((1.0 + CUT_OFF_SHARE) * rate, high)


def _warnings(campaign: Campaign, manifest: Mapping[str, Any], estimates: Estimates) -> Iterator[str]:
    best, assumed, traffic = estimates.best, estimates.assumed, estimates.traffic
    rates = {"rate": best.crash_rate, "ci_high": best.ci_high}
    result = {**rates, "n_episodes": best.n_episodes, "n_failed": best.details["n_failed"]}
    but = "" if estimates.decision is None else "; ACCEPTED counts them as crashes"
    yield from warnings_of(campaign.scenario, result | doubts_of(campaign, manifest, estimates), " per test", but)
    if assumed is not None and assumed.where and assumed.times is None:
        yield unseen_words(assumed.where)
    yield from (note_words(each) for each in best.warnings if each.key == "one_more_moves")
    yield from runs_warning(estimates.decision)
    yield from ratio_warning(estimates)
    on_rate = estimates.decision is not None and not estimates.decision.get("driver")
    if on_rate and assumed is not None and assumed.no_lower_limit:
        yield f"no lane change was seen at {assumed.where}: a limit on the rate rests on that; use --accept r157-cc"
    if (level := campaign.environment.lane_change_level) != 1.0:
        yield f"lane_change_level is {plain(level)}: compare only with rates at the same level"
    if traffic is not None:
        yield from too_few(traffic.n_replicates, traffic.confidence)


def runs_warning(decision: Mapping[str, Any] | None) -> Iterator[str]:
    """That baseline runs are too few for a verdict."""
    if decision is not None and (n := decision.get("n_runs")):
        more = f"raise pool.shadow_paths to {count(n)}, with a new --out"
        yield f"its baseline runs may miss what it does in one of many drives, which may be above the limit: {more}"


def _scope(campaign: Campaign, manifest: Mapping[str, Any], estimates: Estimates) -> str:
    if estimates.elsewhere is not None:
        return elsewhere_words(estimates.elsewhere)
    best, stopped_by = estimates.best, estimates.stopped_by
    ended, target = ended_words(stopped_by, estimates.decision), campaign.stop.rhw
    if campaign.accept is None and target is not None and stopped_by not in ("rhw", "below_reference", "accept", "sum"):
        within = campaign.testing.shells.statement != ASSUMPTION_FREE and best.details.get("within")
        rhw = end(within["rhw"]) if within else best.precision
        width = share(rhw) if share(rhw) != share(target) else f"{number(100.0 * rhw)} %"  # where they differ
        reached, asked = reached_words(rhw, width), f"± {share(target)}"
        few = next((each.numbers["least"] for each in estimates.unmet if each.key == "min_crashes"), 0)
        asked += f" of {few} crashes" * (rhw <= target and few > 0)
        if not best.n_crashes or best.cautions:
            reached = ", precision not known" if best.n_crashes else ", no crash seen"
        further = go_on(best.n_episodes, further=(rhw / target) ** 2 if best.n_crashes else math.inf)
        more = further if stopped_by == "episodes" else remedy_words(manifest.get("remedy"))
        more = "" if manifest.get("expected") and best.n_crashes else more  # `width_row` has it
        ended += f"{reached} (asked: {asked}){more}"
    elif stopped_by == "episodes":
        decision = estimates.decision
        ended = "all tests done" if decision is None else ended + go_on(best.n_episodes, best.n_crashes, decision)
    elif stopped_by == "pool" and campaign.accept is not None:
        if _cut_off_counts(best.crash_rate, estimates.cut_off, best.ci_high):
            ended += "; tests cut off count as crashes, see !"
        else:
            ended += remedy_words(manifest.get("remedy") or {"pool.events_per_shell": None})
    elif stopped_by in ("rhw", "below_reference") and campaign.testing.shells.statement != ASSUMPTION_FREE:
        ended += f", given the {campaign.testing.shells.statement}"
    test = family_named(campaign.scenario).words.test
    if (known := manifest.get("exposure")) is not None:
        test += f"; per hour by {known} {family_named(campaign.scenario).words.events}"
    return f"per test is per {test}; {scope_words(best.confidence, ended)}"


def go_on(n: int, n_crashes: int = 0, decision: Mapping[str, Any] | None = None, further: float = 2.0) -> str:
    """How to go on after a budget of ``n`` tests is used up, and how many would decide if none of them crashes.

    ``further`` is how many times as many may do, infinite where that is not known.
    """
    if decision is None:
        enough = two_digits_up(n * min(max(further, 2.0), MOST_FURTHER))
        return f"; the same command with --resume --set stop.episodes={enough} goes on"
    times = end(decision["high"]) / decision["limit"]  # without a crash an upper limit falls with 1/n, or faster
    decidable = not n_crashes and 1.0 < times < math.inf
    more, how = (times, "decides, if none of them crashes") if decidable else (2.0, "goes on")
    return f"; the same command with --resume --set stop.episodes={two_digits_up(n * more)} {how}"


def reached_words(rhw: float, width: str) -> str:
    """The relative half-width that was reached, or that it is too wide to say anything."""
    return f", at ± {width}" if rhw <= WIDEST_RHW else f", at over ± {share(WIDEST_RHW)}"


def scope_words(confidence: float, ended: str, counted: str = "") -> str:
    """What intervals cover, and why a run ended."""
    covered = f"sampling error{counted} in this simulated traffic only"
    return f"{share(confidence)} intervals cover {covered}; stopped: {ended}"


def remedy_words(changes: Mapping[str, float | None] | None) -> str:
    """Which settings of the pool would have narrowed the interval, to which value; None where that is to be tried."""
    if changes is None:
        return ""
    if not changes:
        return "; no pool is large enough for that: raise stop.rhw"
    if None in changes.values():
        phrases = [f"{'lower' if key == 'pool.relative_error' else 'raise'} {key}" for key in changes]
        return f"; {' and '.join(phrases)}, with a new --out"
    settings = " ".join(f"--set {key}={value:.10g}" for key, value in changes.items())
    return f"; to narrow it: {settings} and a new --out"


def elsewhere_words(elsewhere: Elsewhere) -> str:
    """What an answer for other traffic rests on."""
    drivers = " and ".join(elsewhere.drivers)
    error = f" (off by {share(elsewhere.off, least=0.001)} for {drivers})" if drivers else ""
    rests = f"assumes that the same share of each shell crashes in both{error}"
    return f"tested in {elsewhere.tested_in}, answered for {elsewhere.answered_for}: {rests}"


# -- for a terminal: some ten lines of 100 columns --

MOST_FURTHER = 10.0
"""Times the tests done that are told as those to go on with, at most [assumed]."""
WIDTH, LINES, LABEL = 100, 10, 26
MOST_WARNINGS = 3


def lines(answer: ShortAnswer, took_s: float | None = None, report: Path | None = None) -> list[str]:
    """An answer for a terminal: at most `LINES` lines; those of more than `WIDTH` columns go on below.

    Where there is much to warn of, the last rows give way: all of it is on the page.
    """
    warnings = few([f"! {text}" for text in answer.warnings], MOST_WARNINGS)
    ends = [answer.scope, *([] if report is None else [f"report  {report}"])]
    rows = answer.rows[: LINES - 1 - len(warnings) - len(ends)]
    table = columns([row.texts for row in rows])
    return [headed(answer, took_s), *table, *wrapped([*warnings, ends[0]]), *(f"  {line}" for line in ends[1:])]


def few(remarks: list[str], most: int) -> list[str]:
    """Remarks, of which the last says how many there are on the page where they are too many."""
    if len(remarks) <= most:
        return remarks
    return [*remarks[: most - 1], f"! {count(len(remarks) - most + 1)} more warnings: see the report"]


def headed(answer: ShortAnswer, took_s: float | None) -> str:
    """The first line: who was tested, with as many of its parameters as there is room for, and how often."""
    head = [answer.vehicle, answer.tests, *([] if took_s is None else [duration(took_s)])]
    if parameters := ", ".join(map(" ".join, answer.parameters)):
        room = WIDTH - len(" · ".join(head)) - 3
        head[0] += f" ({textwrap.shorten(parameters, max(room, 8), placeholder=' …')})"
    return " · ".join(head)


def run_lines(
    campaign: Campaign, manifest: Mapping[str, Any], content: Estimates | Mapping[str, Any], report: Path
) -> list[str]:
    """The answer of a run; the ``report`` is named if it is there, and of the same traffic."""
    estimates = STORED_ESTIMATES.validate_python(content)
    page = report if estimates.elsewhere is None and report.is_file() else None
    return lines(short_answer(campaign, manifest, estimates), manifest.get("wall_time_s"), page)


def estimate_lines(content: Mapping[str, Any]) -> list[str]:
    """The estimators of ``estimates.json``, a line each; those that its records do not allow are not named."""
    head = f"{content['campaign']}: {count(content['n_crashes'])} crashes in {count(content['n_episodes'])} tests"
    valid = [(name, each) for name, each in content["estimates"].items() if each["crash_rate"] is not None]
    rows = [(name, interval(each.get("ci_low"), each.get("ci_high"), each["crash_rate"])) for name, each in valid]
    return [f"{head}; crash rate per test ({share(content['confidence'])})", *columns(rows)]


def columns(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Rows of equally many texts, each column as wide as its widest; a row too long for that is narrower at its end."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        padded = [text.ljust(width) for text, width in zip(row, widths, strict=True)]
        begin, remark = "  ".join(["", *padded[:-1]]).rstrip(), row[-1]
        line = "  ".join(["", *padded]).rstrip()
        if len(line) > WIDTH:
            line = f"{begin}  {remark:>{max(WIDTH - 2 - len(begin), 0)}}"
        for n in reversed(range(len(row) - 1)):
            line = line if len(line) <= WIDTH else "  ".join(["", *padded[:n], *filter(None, row[n:])])
        yield from [line] if len(line) <= WIDTH else wrapped(["  ".join(filter(None, row))])


def wrapped(texts: Iterable[str]) -> Iterator[str]:
    """Lines of at most `WIDTH` columns, which begin after two spaces and go on after four."""
    fill = textwrap.TextWrapper(WIDTH, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False)
    for text in texts:
        joined = text.replace(" %", "\u00a0%").replace("± ", "±\u00a0")  # a number and its sign stay together
        yield from (line.replace("\u00a0", " ") for line in fill.wrap(joined))
