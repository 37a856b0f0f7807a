"""What is said of more than one run: of several scenarios, whose sum is crashes per hour, and of two vehicles."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sized
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.estimators.answer import AssumedOfRate, n_softened
from harness.estimators.estimate import WIDE_RHW
from harness.families import family_named
from harness.families.words import ELSEWHERE, EXCLUDED
from harness.numbers import MISSING, count, duration, interval, number, plain, ratio, share, tenths, two_digits_up
from harness.report import words
from harness.report.notes import note_words
from harness.report.rows import Row, decided, end, looking_words, ratio_texts
from harness.report.words import ShortAnswer
from harness.strata import LIBRARY_STATEMENT

FAR_APART = 100.0
"""Times a lower limit from which an upper one is too far to be told with it."""

# -- of several scenarios, from ``families.json``: crashes per hour, beside the competent driver, and each one's part --


def called(family: str) -> str:
    """A scenario in words."""
    return family_named(family).words.called


def scenarios_words(families: Sized) -> str:
    """How many scenarios."""
    return f"{count(len(families))} scenario{'s' * (len(families) > 1)}"


def answer_of_sum(content: Mapping[str, Any], *, readings: bool = False) -> ShortAnswer:
    """The answer of ``families.json``; with ``readings`` also beside others of the regulation's driver."""
    verdict = [] if content["decision"] is None else [decided(content["decision"], "hour")]
    return ShortAnswer(
        vehicle=content["vehicle"],
        parameters=content.get("parameters", ()),
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
        [
            (row[1], row[2] + " of all" * (i == 0 and row[2] != MISSING), *row[3:])
            for i, row in enumerate(family_rows(content))
        ]
    )
    under = words.wrapped([*(f"! {text}" for text in answer.warnings), exposures(content), answer.scope])
    ends = [] if report is None else [f"  report  {report}"]
    return [head, *words.columns([row.texts for row in answer.rows]), *parts, *under, *ends]


def _sum_rows(content: Mapping[str, Any], *, readings: bool) -> Iterator[Row]:
    hour, seen, decision = content["per_hour"], content["n_crashes"] > 0, content["decision"]
    what = f"crashes > {plain(above)} m/s" if (above := content.get("counts_above_mps")) else "crashes"
    # Where a limit was rejected after few tests the upper end says nothing.
    wide = hour["rhw"] is None or hour["rhw"] > WIDE_RHW
    from_below = wide and decision is not None and decision["verdict"] == "rejected"
    far = seen and hour["ci_high"] is not None and hour["ci_high"] >= FAR_APART * hour["ci_low"]
    if from_below:
        yield Row("rate", f"{what} so far", f"> {number(hour['ci_low'])} per hour", f"estimate {number(hour['rate'])}")
    elif far:
        yield Row("rate", what, f"< {number(hour['ci_high'])} per hour", f"estimate {number(hour['rate'])}")
    elif seen:
        ends = between(hour["ci_low"], hour["ci_high"], hour["rate"])
        per_km = f"{number(content['per_1e6_km'])} per million km"
        yield Row("rate", what, f"{number(hour['rate'])} per hour", ends, per_km)
    else:
        yield Row("rate", what, f"< {number(hour['upper_bound'])} per hour", "no crash seen")
    softened = any(n_softened(family["before_event"]) for family in content["families"].values())
    how = {"wide": from_below or far, "from_below": from_below, "softened": softened}
    yield beside_row("× competent driver", content, content["beside"], **how)
    for reading in content["readings"] if readings else ():
        yield beside_row(f"× {reading['reference']}", content, reading, **how)


def beside_row(name: str, content: Mapping[str, Any], beside: Mapping[str, Any], **how: bool) -> Row:
    """The rate of a sum ``beside`` a reading of that driver, where crashes were seen or none; see `ratio_texts`."""
    if beside["ratio"] is None:
        return Row("ratio", name, "no ratio", "", "such a driver never crashes here")
    reading, ends = (beside if content["n_crashes"] else {**beside, "ratio": 0.0}), beside["over_assumed"]
    # How a vehicle that acts before the event moves with who does not look is not known.
    assumed = [AssumedOfRate(**each) for family in content["families"].values() if (each := family.get("assumed"))]
    moved = "assumed ranges" if any(map(looking_words, assumed)) else "exposures"
    low, high = ("", "") if ends is None else map(ratio, ends)
    over = "" if low == high else f"{low} to {high} over {moved}"
    if (limits := beside.get("limits_over_assumed")) is not None:
        most = "no limit" if limits[1] is None else ratio(limits[1])
        over = f"limits {ratio(limits[0])} to {most} over exposures"
    return Row("ratio", name, *ratio_texts(reading, **how), over)


def family_rows(content: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """A row each: key, name, share of the rate, crashes per hour and ratio with their intervals, how hard."""
    for name, family in sorted(content["families"].items(), key=lambda item: -(item[1]["rate_per_hour"] or 0.0)):
        per_hour, part, beside = family["rate_per_hour"], MISSING, MISSING
        rate = f"< {number(family['upper_bound'])}"
        if family["n_crashes"]:
            low, high = family["ci_low"], family["ci_high"]
            far = high is not None and high >= FAR_APART * low
            rate = f"{number(per_hour)} (≥ {number(low)})" if high is None else interval(low, high, per_hour)
            part = share(family["share"])
            if far:  # what is known is a limit
                rate = f"< {number(high)} (est. {number(per_hour)})"
            if (times := family["ratio"]) is not None:
                least, most = number(family["ratio_low"], 2), number(family["ratio_high"], 2)
                ends = f"≥ {least}" if family["ratio_high"] is None else f"{least}–{most}"
                beside = f"× < {most}" if far and not _side(family) else f"× {ratio(times)} ({ends})"
            if (unseen := _unseen(family)) is not None:
                rate = f"< {number(unseen[1])} ({number(per_hour)} as fitted)"
        impact = family.get("median_impact_mps")
        hard = "no crash seen" if impact is None else f"impact {tenths(impact)} m/s"
        yield name, called(name), part, rate, beside, hard


def sum_warnings(content: Mapping[str, Any]) -> Iterator[str]:
    """What changes the meaning of the rows, a line each, by scenario."""
    decision = content.get("decision")
    if decision and (verdict := decision["verdict"]) != "undecided":
        beside = content["beside" if decision["driver"] else "per_hour"]["over_assumed"]
        ranges = [each for each in (decision.get("over_assumed"), beside) if each]
        low = min((each[0] for each in ranges), default=math.inf)
        high = max((end(each[1]) for each in ranges), default=0.0)
        if ranges and (high >= decision["limit"] if verdict == "accepted" else low <= decision["limit"]):
            sign, as_text = ("× ", ratio) if decision["driver"] else ("", number)
            most = "no limit" if math.isinf(high) else as_text(high)
            sampled = " with sampling error" * bool(decision.get("over_assumed"))
            yield f"assumed numbers may turn this verdict: {sign}{as_text(low)} to {most} over their ranges{sampled}"
    yield from words.runs_warning(decision)
    for reading in content["readings"]:
        if _side(reading) != _side(content["beside"]):
            times, interval = ratio_words(reading)
            times = f"{times} ({interval})" if reading["ratio"] else interval.replace("0 to", "<") or times
            yield f"beside {reading['reference']}, another reading of UN R157, it is × {times}"
    said = defaultdict[str, list[str]](list)  # what holds of several is said once
    for name, family in content["families"].items():
        texts = list(words.warnings_of(name, {**family, "rate": family["rate_per_hour"]}, " per hour"))
        if (unseen := _unseen(family)) is not None:
            texts.append(f"{words.unseen_words(unseen[0])}, here {number(unseen[1])} per hour")
        for text in texts:
            said[text].append(called(name))
    yield from (f"{', '.join(names)}: {text}" for text, names in said.items())


def _unseen(family: Mapping[str, Any]) -> tuple[str, float] | None:
    """Where no lane change was seen, if that leaves a scenario's rate without a lower limit, and its upper one."""
    if not (stored := family.get("assumed")) or not (assumed := AssumedOfRate(**stored)).no_lower_limit:
        return None
    return assumed.where, assumed.most * (family["ci_high"] if family["n_crashes"] else family["upper_bound"])


def _side(beside: Mapping[str, Any]) -> str:
    """On which side of a driver a vehicle is, if on one."""
    if beside["ratio"] is None:
        return ""
    return "more" if beside["ratio_low"] > 1.0 else "less" if (beside["ratio_high"] or math.inf) < 1.0 else ""


def exposures(content: Mapping[str, Any]) -> str:
    """What is counted, what assumed: events per hour."""
    phrases: dict[str, list[str]] = {}
    for name, family in content["families"].items():
        exposure = family["exposure"]
        is_given = exposure["low"] == exposure["high"] and exposure["source"] != "assumed"
        kind = "counted" if exposure["counted"] else "given" if is_given else "assumed"
        per_hour, low, high = (plain(float(format(exposure[key], ".2g"))) for key in ("per_hour", "low", "high"))
        notes = [f"{low}–{high}"] if exposure["counted"] else []
        notes += [mark for mark in (EXCLUDED, ELSEWHERE) if mark in exposure["source"]]
        assumed = family["n_crashes"] and family.get("assumed")
        if assumed and (others := looking_words(moved := AssumedOfRate(**assumed))):
            notes.append(f"crashes × {number(moved.most, 2)} if {others}")
        phrases.setdefault(kind, []).append(f"{called(name)} {per_hour}" + (f" ({'; '.join(notes)})" if notes else ""))
    parts = [f"{kind}: {', '.join(scenarios)}" for kind, scenarios in phrases.items()]
    more = "other numbers: harness sensitivity"
    least, most = content["per_hour"].get("over_assumed") or (0.0, 0.0)  # older runs have none
    if number(least) != number(most):
        more = f"rate over their ranges {interval(least, most)}"
    return f"events per hour, {'; '.join([*parts, more])}"


def between(low: float, high: float | None, rate: float) -> str:
    """The interval of a rate; its ends apart where they are far apart, "no limit" where it is open."""
    if high is None:
        return f"≥ {number(low)}"
    return interval(low, high, beside=rate) if high < FAR_APART * low else f"{number(low)} to {number(high)}"


def _scope(content: Mapping[str, Any]) -> str:
    """How far the interval goes, and why the tests ended."""
    stopped, target = content["stopped_by"], content["asked_rhw"]
    ended = words.ended_words(stopped, content.get("ran", content)["decision"])
    if stopped == "rhw" and (rhw := content["per_hour"]["rhw"] or math.inf) > 1.005 * target:
        here = words.reached_words(rhw, share(rhw)).removeprefix(", at ")
        narrower = "" if content["counts_in_interval"] else ": to narrow it, run anew with these settings"
        ended += f" as it was run; here {here}{narrower}"
    if stopped == "accept" and content["decision"] is None:
        ended += f" ({content['ran']['decision']['verdict']}) at the exposures of the run"
    if target is not None and content["decision"] is None and stopped not in ("rhw", "accept", "below_reference"):
        rhw = content["per_hour"]["rhw"]
        ended += f"{'' if rhw is None else words.reached_words(rhw, share(rhw))} (asked: ± {share(target)})"
    if stopped == "episodes" and (target is not None or content["decision"] is not None):
        further = (rhw / target) ** 2 if target and (rhw := content["per_hour"]["rhw"]) else math.inf
        ended += words.go_on(content["n_episodes"], content["n_crashes"], content["decision"], further)
    counted = ", that of the sum also of counted events," if content["counts_in_interval"] else ""
    return words.scope_words(content["confidence"], ended, counted)


# -- of two vehicles, from ``compare.json`` --


def pair_words(decision: Mapping[str, Any], beside: Mapping[str, Any] | None = None) -> str:
    """What is known of who crashes less often (``decision`` in ``compare.json``), by all looks, and else by one.

    ``beside`` is the ratio A / B with its limits, of one look.
    """
    margin, verdict = decision["margin"], decision["verdict"]
    if not margin:
        verdicts = {"proven": "B crashes less often than A", "refuted": "B crashes more often than A"}
        of_b, of_a = decision.get("n_milder"), decision.get("n_milder_a")
        held = margin is not None and (of_b or decision.get("n_differing"))
        of_safer = {"proven": of_b, "refuted": of_a, "open": held}[verdict]
        least, most = (beside and beside[end] for end in ("ratio_low", "ratio_high"))
        seems = "less" if (least or 0.0) > 1.0 else "more" if (most or math.inf) < 1.0 else ""
        open_words = f"Not proven: B seems to crash {seems} often" if seems else "Not told apart"
        return verdicts.get(verdict, open_words) + ", see !" * bool(of_safer)
    most, limit = share(margin), ratio(1.0 / (1.0 + margin))
    ends = decision.get("ratio") or (None, None)  # of B / A; told as all else, of A / B
    high, low = ("" if not end else ratio(1.0 / end) for end in ends)
    if verdict == "proven":
        safer = "B crashes less often than A, so it is" if (ends[1] or 1.0) < 1.0 else "B is"
        return f"{safer} at most {most} worse than A" + f" (A / B ≥ {low}, limit {limit})" * bool(low)
    if verdict == "refuted":
        return f"B is more than {most} worse than A" + f" (A / B ≤ {high}, limit {limit})" * bool(high)
    between = f"{low} to {high}" if low and high else f"≥ {low}" if low else f"≤ {high}"
    return f"Open whether B is more than {most} worse than A" + f" (A / B {between}, limit {limit})" * bool(low or high)


def pair_warnings(content: Mapping[str, Any]) -> Iterator[str]:
    """What changes the meaning of a comparison (``compare.json``), by side; what holds of both sides is said once."""
    sides: dict[str, list[str]] = {}
    for name in "AB":
        side = content[name.lower()]
        of_sum = "families" in content
        for text in sum_warnings({**side, "readings": ()}) if of_sum else _warnings_of_side(content, side):
            sides.setdefault(text, []).append(name)
    yield from (f"{' and '.join(names)}{',' if 'families' in content else ':'} {text}" for text, names in sides.items())
    if where := content.get("unseen"):
        yield words.unseen_words(where)


def _warnings_of_side(content: Mapping[str, Any], side: Mapping[str, Any]) -> Iterator[str]:
    told_elsewhere = ["failed"] if content["asked"] == LIBRARY_STATEMENT else ["failed", "refuted"]
    rates = {**side, "rate": side["crash_rate"], "n_failed": side["details"]["n_failed"]}
    yield from words.warnings_of(content["scenario"], rates, " per test")
    notes = (each for each in side["warnings"] if each["key"] not in told_elsewhere and each not in side["cautions"])
    yield from map(note_words, notes)


def deciding_words(content: Mapping[str, Any], s_per_pair: float | None = None) -> str | None:
    """What would decide an open comparison (``compare.json``), and at which cost; None where it is decided."""
    decision = content["decision"]
    if decision["verdict"] != "open" or content.get("ended") == "sum":
        return None
    if decision["n_milder"] or decision["n_differing"]:  # no pairs mend that
        if decision["margin"] is not None:
            return None
        if content["difference"] > 0.0:
            return "first mend what ! says: until then no number of pairs proves that B is the safer one"
    if not content["n_only_a"] + content["n_only_b"]:
        return "in no pair of tests did only one crash"
    if (needed := content["to_decide"]) is None:
        return "how many pairs would decide is not known: so far the two are too alike"
    where, pairs, done = "", "more pairs", content["n_pairs"]
    if needed["new_folder"]:
        where, pairs, done = " and a new --out", "pairs", 0
    n = two_digits_up(needed["pairs"] - done)
    cost = "" if s_per_pair is None else f", {duration(n * s_per_pair)}"
    settings = "".join(f" --set {key}={value}" for key, value in needed["settings"].items())
    options = f"--margin {decision['margin'] or 0.0:g}{settings}"
    where += ", and without --set stop.rhw, if you gave it" * (content.get("ended") == "rhw")
    return f"{_left_open(content)}to decide, repeat the command with {options}{where}: about {count(n)} {pairs}{cost}"


def _left_open(content: Mapping[str, Any]) -> str:
    """That pairs of tests differ, but less than crashes where nobody looked may weigh, if that is so."""
    within = [content[side].get("details", {}).get("within") or {} for side in "ab"]
    most = max(of.get("upper_bound_outside") or 0.0 for of in within)
    if most <= abs(content["difference"]) or any(of.get("n_crashes_outside") for of in within):
        return ""
    n = count(content["conditional"]["n_pairs_outside"])
    return f"outside of the library's shells {n} pairs had no crash, which leaves up to {number(most)} open; "


def pair_asked(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """What lies between A and B under the statement that the comparison (``compare.json``) was asked for."""
    given_library = content.get("asked") == LIBRARY_STATEMENT  # of one scenario
    return content["conditional"] if given_library and not content["conditional"].get("refuted") else content


def rates_of(side: Mapping[str, Any]) -> dict[str, Any]:
    """Rate with limits, and crashes, of A or B in ``compare.json``: per test, or per hour of several scenarios."""
    return {**side, **side.get("per_hour", {"rate": side.get("crash_rate")})}


def ratio_words(pair: Mapping[str, Any]) -> tuple[str, str]:
    """A over B, and its interval."""
    most = "no limit" if pair["ratio_high"] is None else ratio(pair["ratio_high"])
    if pair["ratio"] is None:  # the one below has not crashed
        return "–", f"≥ {ratio(pair['ratio_low'])}" if pair["ratio_low"] else ""
    return ratio(pair["ratio"]), f"{ratio(pair['ratio_low'])} to {most}"


def alone_words(pair: Mapping[str, Any]) -> str:
    """Pairs of which one crashes and the other does not."""
    return f"crashes of A alone {count(pair['n_only_a'])}, B {count(pair['n_only_b'])}"


def pair_lines(
    content: Mapping[str, Any], campaign: Campaign, report: Path, s_per_pair: float | None = None
) -> list[str]:
    """A comparison (``compare.json``) for a terminal, as short as `lines`; ``s_per_pair`` is the time of a pair (s)."""
    asked, rows = pair_asked(content), []
    for name in "AB":
        rates = rates_of(content[name.lower()])
        label = content["campaigns"][name.lower()]["label"]
        label = label.removeprefix(f"{content['campaigns']['a']['label']}, ").replace("av.parameters.", "")
        rate, ends = number(rates["rate"]), interval(rates["ci_low"], rates["ci_high"], beside=rates["rate"])
        if not (n := rates["n_crashes"]):
            rate, ends = f"< {number(rates['upper_bound'])}", "no crash seen"
        label = label if len(label) <= words.LABEL else f"{label[: words.LABEL - 2]} …"
        rows.append((f"{name} {label}", rate, ends, f"{count(n)} crash{'es' * (n != 1)}"))
    decision = content["decision"]
    apart = not (asked["ratio_low"] or 0.0) < 1.0 < (asked["ratio_high"] or math.inf)
    may_differ = decision["margin"] is not None or (apart and decision["verdict"] == "open")
    one_look = "; interval: of one look" * may_differ
    looks = f"verdict: confidence {plain(decision['confidence'])} over all looks{one_look}"
    rows.append(("A / B", *ratio_words(asked), looks))
    ends = interval(asked["ci_low"], asked["ci_high"], beside=asked["difference"])
    rows.append(("A − B", number(asked["difference"]), ends, alone_words(asked)))
    families = content.get("families", {})
    ratios = ((name, pair, *ratio_words(pair)) for name, pair in families.items())
    parts = words.columns(
        [(called(name), f"A / B {value}", ends, alone_words(pair)) for name, pair, value, ends in ratios]
    )
    remarks = [f"! {text}" for text in pair_warnings(content)]
    if asked is not content:
        remarks.insert(0, f"A / B and A − B assume that both crash only where {asked['boundary']} of the library does")
    scope = words.scope_words(content["confidence"], words.ended_words(content.get("ended"), None))
    counted = f" above {plain(above)} m/s" if (above := campaign.crash.counts_above_mps) else ""
    scenarios, unit = (scenarios_words(families), "hour") if families else (called(campaign.scenario), "test")
    pairs = f"{count(content['n_pairs'])} pairs of tests, {scenarios}"
    head = f"{pair_words(decision, asked)} · {pairs} · crashes{counted} per {unit}"
    last = [*filter(None, [deciding_words(content, s_per_pair)]), scope]
    under = words.wrapped([*(remarks if families else words.few(remarks, 4 - len(last))), *last])
    return [head, *words.columns(rows), *parts, *under, f"  report  {report}"]
