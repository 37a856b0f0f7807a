"""What is said of more than one run: of several scenarios, whose sum is crashes per hour, and of two vehicles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sized
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.estimators.answer import AssumedOfRate, n_softened
from harness.estimators.estimate import WIDE_RHW
from harness.families import family_named
from harness.families.words import EXCLUDED
from harness.numbers import count, duration, interval, number, plain, ratio, share, tenths, two_digits_up
from harness.report import words
from harness.report.notes import note_words
from harness.report.rows import Row, decided, end, looking_words, ratio_texts
from harness.report.words import ShortAnswer
from harness.strata import LIBRARY_STATEMENT

# -- of several scenarios, from ``families.json``: crashes per hour, beside the competent driver, and each one's part --


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
        [(row[1], row[2] + " of all" * (i == 0), *row[3:]) for i, row in enumerate(family_rows(content))]
    )
    under = words.wrapped([*(f"! {text}" for text in answer.warnings), exposures(content), answer.scope])
    ends = [] if report is None else [f"  report  {report}"]
    return [head, *words.columns([row.texts for row in answer.rows]), *parts, *under, *ends]


def _sum_rows(content: Mapping[str, Any], *, readings: bool) -> Iterator[Row]:
    """Crashes per hour, and beside the competent driver."""
    hour, seen, decision = content["per_hour"], content["n_crashes"] > 0, content["decision"]
    what = f"crashes > {plain(above)} m/s" if (above := content.get("counts_above_mps")) else "crashes"
    # Where few tests have rejected a limit upper ends say nothing.
    wide = hour["rhw"] is None or hour["rhw"] > WIDE_RHW
    from_below = wide and decision is not None and decision["verdict"] == "rejected"
    if from_below:
        yield Row("rate", f"{what} so far", f"> {number(hour['ci_low'])} per hour", f"estimate {number(hour['rate'])}")
    elif seen:
        ends = between(hour["ci_low"], hour["ci_high"], hour["rate"])
        per_km = f"{number(content['per_1e6_km'])} per million km"
        yield Row("rate", what, f"{number(hour['rate'])} per hour", ends, per_km)
    else:
        yield Row("rate", what, f"< {number(hour['upper_bound'])} per hour", "no crash seen")
    softened = any(n_softened(of["before_event"]) for of in content["families"].values())
    how = {"seen": seen, "from_below": from_below, "softened": softened}
    yield beside_row("× competent driver", content["beside"], **how)
    for each in content["readings"] if readings else ():
        yield beside_row(f"× {each['reference']}", each, **how)


def beside_row(
    name: str, beside: Mapping[str, Any], *, seen: bool, from_below: bool = False, softened: bool = False
) -> Row:
    """The rate beside a reading of that driver, where crashes were ``seen`` or none; see `ratio_texts`."""
    if beside["ratio"] is None:
        return Row("ratio", name, "no ratio", "", "such a driver never crashes here")
    found, ends = (beside if seen else {**beside, "ratio": 0.0}), beside["over_assumed"]
    over = "" if ends is None or ends[0] == ends[1] else f"{ratio(ends[0])} to {ratio(ends[1])} over assumed ranges"
    if (limits := beside.get("limits_over_assumed")) is not None:
        most = "no limit" if limits[1] is None else ratio(limits[1])
        over = f"limits {ratio(limits[0])} to {most} over exposures"
    return Row("ratio", name, *ratio_texts(found, wide=from_below, from_below=from_below, softened=softened), over)


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
    decision, ends = content.get("decision"), content["beside"]["over_assumed"]
    if decision and (verdict := decision["verdict"]) != "undecided":
        over = [each for each in (decision.get("over_assumed"), decision["driver"] and ends) if each]
        low, high = min((each[0] for each in over), default=math.inf), max((end(each[1]) for each in over), default=0.0)
        if over and (high >= decision["limit"] if verdict == "accepted" else low <= decision["limit"]):
            sign, as_text = ("× ", ratio) if decision["driver"] else ("", number)
            most = "no limit" if math.isinf(high) else as_text(high)
            yield f"assumed numbers may turn this verdict: {sign}{as_text(low)} to {most} over their ranges"
    yield from words.runs_warning(decision)
    for each in content["readings"]:
        if _side(each) != _side(content["beside"]):
            times, interval = ratio_words(each)
            times = f"{times} ({interval})" if each["ratio"] else interval.replace("0 to", "<") or times
            yield f"beside {each['reference']}, another reading of UN R157, it is × {times}"
    for name, of in content["families"].items():
        told = list(words.warnings_of(name, {**of, "rate": of["rate_per_hour"]}, " per hour"))
        if (left := of.get("assumed")) and (found := AssumedOfRate(**left)).no_lower_limit:
            most = found.most * (of["ci_high"] if of["n_crashes"] else of["upper_bound"])
            told.append(f"{words.unseen_words(found.where)}, here {number(most)} per hour")
        yield from (f"{called(name)}: {text}" for text in told)


def _side(of: Mapping[str, Any]) -> str:
    """On which side of a driver a vehicle is, if on one."""
    if of["ratio"] is None:
        return ""
    return "more" if of["ratio_low"] > 1.0 else "less" if (of["ratio_high"] or math.inf) < 1.0 else ""


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
        left = of["n_crashes"] and of.get("assumed")
        if left and (others := looking_words(moved := AssumedOfRate(**left))):
            told[kind][-1] += f" (crashes × {number(moved.most, 2)} if {others})"
    parts = [f"{kind}: {', '.join(each)}" for kind, each in told.items()]
    return "events per hour of driving, " + "; ".join([*parts, "other assumed numbers: harness sensitivity"])


def between(low: float, high: float | None, rate: float) -> str:
    """The interval of a rate; its ends apart where they are far apart, "no limit" where it is open."""
    if high is None:
        return f"≥ {number(low)}"
    return interval(low, high, beside=rate) if low > 0.0 and high < 100.0 * low else f"{number(low)} to {number(high)}"


def _scope(content: Mapping[str, Any]) -> str:
    """How far the interval goes, and why the tests ended."""
    ended, target = words.ended_words(content["stopped_by"], content["decision"]), content["asked_rhw"]
    if content["stopped_by"] == "rhw" and (rhw := content["per_hour"]["rhw"] or math.inf) > 1.005 * target:
        here = words.reached_words(rhw, share(rhw)).removeprefix(", at ")
        ended += f" as it was run; here {here}: to narrow it, run anew with these settings"
    if content["stopped_by"] == "accept" and content["decision"] is None:
        ended += f" ({content['ran']['decision']['verdict']}) at the exposures of the run"
    if content["stopped_by"] not in ("rhw", "accept", "below_reference") and target is not None:
        rhw = content["per_hour"]["rhw"]
        ended += f"{'' if rhw is None else words.reached_words(rhw, share(rhw))} (asked: ± {share(target)})"
    if content["stopped_by"] == "episodes" and (target is not None or content["decision"] is not None):
        ended += words.go_on(content["n_episodes"], content["n_crashes"], content["decision"])
    counted = ", that of the sum also of counted events," if content["counts_in_interval"] else ""
    return words.scope_words(content["confidence"], ended, counted)


# -- of two vehicles, from ``compare.json`` --


def pair_words(decision: Mapping[str, Any]) -> str:
    """What is known of who crashes less often (``decision`` in ``compare.json``)."""
    margin, verdict = decision["margin"], decision["verdict"]
    if not margin:
        told = {"proven": "B crashes less often than A", "refuted": "B crashes more often than A"}
        of_b, of_a = decision.get("n_milder"), decision.get("n_milder_a")
        held = margin is not None and (of_b or decision.get("n_differing"))
        of_safer = {"proven": of_b, "refuted": of_a, "open": held}[verdict]
        return told.get(verdict, "Not told apart") + ", see !" * bool(of_safer)
    most = share(margin)
    # Of B / A; told as all else, of A / B.
    high, low = ("" if not end else ratio(1.0 / end) for end in decision.get("ratio") or (None, None))
    if verdict == "proven":
        return f"B is at most {most} worse than A" + f" (A / B ≥ {low})" * bool(low)
    if verdict == "refuted":
        return f"B is more than {most} worse than A" + f" (A / B ≤ {high})" * bool(high)
    between = f"{low} to {high}" if low and high else f"≥ {low}" if low else f"≤ {high}"
    return f"Open whether B is more than {most} worse than A" + f" (A / B {between})" * bool(low or high)


def pair_warnings(content: Mapping[str, Any]) -> Iterator[str]:
    """What changes the meaning of a comparison (``compare.json``): what is so of both once, of A and B."""
    told: dict[str, list[str]] = {}
    for name in "AB":
        of = content[name.lower()]
        for text in sum_warnings(of) if "families" in content else _warnings_of_side(content, of):
            told.setdefault(text, []).append(name)
    yield from (f"{' and '.join(who)}{',' if 'families' in content else ':'} {text}" for text, who in told.items())
    if where := content.get("unseen"):
        yield words.unseen_words(where)


def _warnings_of_side(content: Mapping[str, Any], of: Mapping[str, Any]) -> Iterator[str]:
    elsewhere = ["failed"] if content["asked"] == LIBRARY_STATEMENT else ["failed", "refuted"]
    rates = {**of, "rate": of["crash_rate"], "n_failed": of["details"]["n_failed"]}
    yield from words.warnings_of(content["scenario"], rates, " per test")
    yield from (
        note_words(each) for each in of["warnings"] if each["key"] not in elsewhere and each not in of["cautions"]
    )


def deciding_words(content: Mapping[str, Any], s_per_pair: float | None = None) -> str | None:
    """What would decide a comparison (``compare.json``) that was left open, and its cost; None of a decided one."""
    decision = content["decision"]
    if decision["verdict"] != "open" or content.get("ended") == "sum":
        return None
    doubted = decision["n_milder"] or decision["n_differing"]
    if decision["margin"] is not None and doubted:  # which no more pairs would mend
        return None
    if not content["n_only_a"] + content["n_only_b"]:
        return "in no pair of tests did only one crash"
    if (needed := content["to_decide"]) is None:
        return "how many pairs would decide is not known: so far the two are too alike"
    where, pairs, done = (
        (" and a new --out", "pairs", 0) if needed["new_folder"] else ("", "more pairs", content["n_pairs"])
    )
    n = two_digits_up(needed["pairs"] - done)
    cost = "" if s_per_pair is None else f", {duration(n * s_per_pair)}"
    settings = "".join(f" --set {key}={value}" for key, value in needed["settings"].items())
    options = f"--margin {decision['margin'] or 0.0:g}{settings}"
    where += ", and without stop.rhw" * (content.get("ended") == "rhw")
    return f"to decide, repeat the command with {options}{where}: about {count(n)} {pairs}{cost}"


def pair_asked(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """What lies between A and B under the statement that the comparison (``compare.json``) was asked for."""
    given = content.get("asked") == LIBRARY_STATEMENT and not content["conditional"].get("refuted")  # of one scenario
    asked: Mapping[str, Any] = content["conditional"] if given else content
    return asked


def rates_of(side: Mapping[str, Any]) -> dict[str, Any]:
    """Rate with limits, and crashes, of A or B in ``compare.json``: per test, or per hour of several scenarios."""
    return {**side, **side.get("per_hour", {"rate": side.get("crash_rate")})}


def ratio_words(of: Mapping[str, Any]) -> tuple[str, str]:
    """A over B, and its interval."""
    most = "no limit" if of["ratio_high"] is None else ratio(of["ratio_high"])
    if of["ratio"] is None:  # the one below has not crashed
        return "–", f"≥ {ratio(of['ratio_low'])}" if of["ratio_low"] else ""
    return ratio(of["ratio"]), f"{ratio(of['ratio_low'])} to {most}"


def alone_words(of: Mapping[str, Any]) -> str:
    """Pairs of which one crashes and the other does not."""
    return f"crashes of A alone {count(of['n_only_a'])}, B {count(of['n_only_b'])}"


def pair_lines(
    content: Mapping[str, Any], campaign: Campaign, report: Path, s_per_pair: float | None = None
) -> list[str]:
    """A comparison (``compare.json``) for a terminal, as short as `lines`; ``s_per_pair`` is what a pair takes.

    Of the ``campaign`` it says which scenario was driven, and which crashes count.
    """
    asked, rows = pair_asked(content), []
    for name in "AB":
        of, label = rates_of(content[name.lower()]), content["campaigns"][name.lower()]["label"]
        label = label.removeprefix(f"{content['campaigns']['a']['label']}, ").replace("av.parameters.", "")
        rate, ends = number(of["rate"]), interval(of["ci_low"], of["ci_high"], beside=of["rate"])
        if not (n := of["n_crashes"]):
            rate, ends = f"< {number(of['upper_bound'])}", "no crash seen"
        label = label if len(label) <= words.LABEL else f"{label[: words.LABEL - 2]} …"
        rows.append((f"{name} {label}", rate, ends, f"{count(n)} crash{'es' * (n != 1)}"))
    decision = content["decision"]
    apart = not (asked["ratio_low"] or 0.0) < 1.0 < (asked["ratio_high"] or math.inf)
    one_look = "; interval: of one look" * (apart and decision["verdict"] == "open")
    looks = f"verdict: confidence {plain(decision['confidence'])} over all looks{one_look}"
    rows.append(("A / B", *ratio_words(asked), looks))
    ends = interval(asked["ci_low"], asked["ci_high"], beside=asked["difference"])
    rows.append(("A − B", number(asked["difference"]), ends, alone_words(asked)))
    families = content.get("families", {})
    ratios = {name: ratio_words(of) for name, of in families.items()}
    parts = words.columns(
        [(called(name), f"A / B {of}", ends, alone_words(families[name])) for name, (of, ends) in ratios.items()]
    )
    remarks = [f"! {text}" for text in pair_warnings(content)]
    if asked is not content:
        given = f"A / B and A − B assume that both crash only where {asked['boundary']} of the library does"
        remarks.insert(0, given)
    scope = words.scope_words(content["confidence"], words.ended_words(content.get("ended"), None))
    counted = f" above {plain(above)} m/s" if (above := campaign.crash.counts_above_mps) else ""
    scenarios, unit = (scenarios_words(families), "hour") if families else (called(campaign.scenario), "test")
    pairs = f"{count(content['n_pairs'])} pairs of tests, {scenarios}"
    head = f"{pair_words(decision)} · {pairs} · crashes{counted} per {unit}"
    last = [*filter(None, [deciding_words(content, s_per_pair)]), scope]
    under = words.wrapped([*(remarks if families else words.few(remarks, 4 - len(last))), *last])
    return [head, *words.columns(rows), *parts, *under, f"  report  {report}"]
