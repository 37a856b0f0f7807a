"""The answer of several scenarios in words: crashes per hour, beside the competent driver, and each scenario's part."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sized
from pathlib import Path
from typing import Any

from harness.estimators.answer import AssumedOfRate
from harness.estimators.estimate import WIDE_RHW
from harness.families import family_named
from harness.families.words import EXCLUDED
from harness.numbers import count, interval, number, plain, ratio, share, tenths
from harness.report import words
from harness.report.rows import Row, decided, looking_words, ratio_texts
from harness.report.words import ShortAnswer


def called(family: str) -> str:
    """A scenario in words."""
    return family_named(family).words.called


def scenarios_words(families: Sized) -> str:
    """How many scenarios."""
    return f"{count(len(families))} scenario{'s' * (len(families) > 1)}"


def answer_of_sum(content: Mapping[str, Any], *, readings: bool = False) -> ShortAnswer:
    """The answer of ``families.json``; with ``readings`` also beside others of the regulation's driver."""
    verdict = [] if content["decision"] is None else [decided(content["decision"])]
    return ShortAnswer(
        vehicle=content["vehicle"],
        parameters=content["parameters"],
        tests=words.tests_words(content["n_episodes"], content["engine"], scenarios_words(content["families"])),
        rows=(*verdict, *_sum_rows(content, readings=readings)),
        warnings=tuple(sum_warnings(content)),
        scope=_scope(content),
    )


def hour_lines(content: Mapping[str, Any], report: Path | None = None, *, readings: bool = False) -> list[str]:
    """The answer for a terminal, at most ten lines of 100 columns; with ``readings`` two more."""
    answer, took_s = answer_of_sum(content, readings=readings), content["wall_time_s"]
    head = words.headed(answer, None if readings else took_s)  # of the run, not of an answer given anew
    parts = words.columns(
        [(row[1], row[2] + " of all" * (i == 0), *row[3:]) for i, row in enumerate(family_rows(content))]
    )
    under = words.wrapped([*(f"! {text}" for text in answer.warnings), exposures(content), answer.scope])
    ends = [] if report is None else [f"  report  {report}"]
    return [head, *words.columns([row.texts for row in answer.rows]), *parts, *under, *ends]


def _sum_rows(content: Mapping[str, Any], *, readings: bool) -> Iterator[Row]:
    """Crashes per hour, and beside the competent driver."""
    hour, seen, decision = content["per_hour"], content["n_crashes"] > 0, content["decision"]
    # Where few tests have rejected a limit upper ends say nothing.
    wide = hour["rhw"] is None or hour["rhw"] > WIDE_RHW
    from_below = wide and decision is not None and decision["verdict"] == "rejected"
    if from_below:
        yield Row("rate", "crashes so far", f"> {number(hour['ci_low'])} per hour", f"estimate {number(hour['rate'])}")
    elif seen:
        ends = between(hour["ci_low"], hour["ci_high"], hour["rate"])
        per_km = f"{number(content['per_1e6_km'])} per million km"
        yield Row("rate", "crashes", f"{number(hour['rate'])} per hour", ends, per_km)
    else:
        yield Row("rate", "crashes", f"< {number(hour['upper_bound'])} per hour", "no crash seen")
    yield beside_row("× competent driver", content["beside"], seen=seen, from_below=from_below)
    for each in content["readings"] if readings else ():
        yield beside_row(f"× {each['reference']}", each, seen=seen, from_below=from_below)


def beside_row(name: str, beside: Mapping[str, Any], *, seen: bool, from_below: bool = False) -> Row:
    """The rate beside a reading of that driver, where crashes were ``seen`` or none."""
    if beside["ratio"] is None:
        return Row("ratio", name, "no ratio", "", "such a driver never crashes here")
    found, ends = (beside if seen else {**beside, "ratio": 0.0}), beside["over_assumed"]
    over = "" if ends is None or ends[0] == ends[1] else f"{ratio(ends[0])} to {ratio(ends[1])} over assumed ranges"
    return Row("ratio", name, *ratio_texts(found, wide=from_below, from_below=from_below), over)


def family_rows(content: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """A row each: key, name, share of the rate, crashes per hour, ratio, how hard."""
    order = sorted(content["families"].items(), key=lambda item: -(item[1]["rate_per_hour"] or 0.0))
    for name, of in order:
        if of["n_crashes"]:
            part = "" if of["share"] is None else share(of["share"])
            rate = f"{number(of['rate_per_hour'])}  {between(of['ci_low'], of['ci_high'], of['rate_per_hour'])}"
            beside = "–" if of["ratio"] is None else f"× {ratio(of['ratio'])}"
        else:
            part, rate, beside = "0 %", f"< {number(of['upper_bound'])}", "–"
        impact = of.get("median_impact_mps")
        hard = "no crash seen" if impact is None else f"median impact {tenths(impact)} m/s"
        yield name, called(name), part, rate, beside, hard


def sum_warnings(content: Mapping[str, Any]) -> Iterator[str]:
    """What changes the meaning of the rows, a line each, by scenario."""
    for name, of in content["families"].items():
        told = list(words.warnings_of(name, {**of, "rate": of["rate_per_hour"]}, " per hour"))
        if (left := of.get("assumed")) and (found := AssumedOfRate(**left)).no_lower_limit:
            most = found.most * (of["ci_high"] if of["n_crashes"] else of["upper_bound"])
            told.append(f"{words.unseen_words(found.where)}, here {number(most)} per hour")
        yield from (f"{called(name)}: {text}" for text in told)


def exposures(content: Mapping[str, Any]) -> str:
    """What is counted, what assumed: events per hour."""
    told: dict[str, list[str]] = {}
    for name, of in content["families"].items():
        found = of["exposure"]
        given = found["low"] == found["high"] and found["source"] != "assumed"
        kind = "counted" if found["counted"] else "given" if given else "assumed"
        told.setdefault(kind, []).append(f"{called(name)} {plain(float(format(found['per_hour'], '.2g')))}")
        if EXCLUDED in found["source"]:
            told[kind][-1] += f" ({EXCLUDED})"
        if (left := of.get("assumed")) and (others := looking_words(moved := AssumedOfRate(**left))):
            told[kind][-1] += f" (crashes × {number(moved.most, 2)} if {others})"
    return "events per hour of driving, " + "; ".join(f"{kind}: {', '.join(each)}" for kind, each in told.items())


def between(low: float, high: float | None, rate: float) -> str:
    """The interval of a rate; its ends apart where they are far apart, "no limit" where it is open."""
    if high is None:
        return f"≥ {number(low)}"
    return interval(low, high, beside=rate) if low > 0.0 and high < 100.0 * low else f"{number(low)} to {number(high)}"


def _scope(content: Mapping[str, Any]) -> str:
    """How far the interval goes, and why the tests ended."""
    ended, target = words.ended_words(content["stopped_by"], content["decision"]), content["asked_rhw"]
    if content["stopped_by"] not in ("rhw", "accept", "below_reference") and target is not None:
        rhw = content["per_hour"]["rhw"]
        ended += f"{'' if rhw is None else f', at ± {share(rhw)}'} (asked: ± {share(target)})"
    if content["stopped_by"] == "episodes" and (target is not None or content["decision"] is not None):
        ended += words.GO_ON
    counted = ", that of the sum also of counted events," if content["counts_in_interval"] else ""
    return words.scope_words(content["confidence"], ended, counted)
