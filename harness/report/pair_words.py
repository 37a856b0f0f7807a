"""What a comparison says, in words, from the numbers of ``compare.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.numbers import count, duration, interval, number, plain, ratio, share, two_digits_up
from harness.report.hour_words import called, scenarios_words, sum_warnings
from harness.report.notes import note_words
from harness.report.words import ENDED, LABEL, columns, scope_words, unseen_words, warnings_of, wrapped
from harness.strata import LIBRARY_STATEMENT


def pair_words(decision: Mapping[str, Any]) -> str:
    """What is known of who crashes less often (``decision`` in ``compare.json``)."""
    margin, verdict = decision["margin"], decision["verdict"]
    if not margin:
        told = {"proven": "B crashes less often than A", "refuted": "B crashes more often than A"}
        return told.get(verdict, "Not told apart")
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
    """What changes the meaning of a comparison (``compare.json``)."""
    sides = {name: content[name.lower()] for name in "AB"}
    if "families" in content:
        for name, of in sides.items():
            yield from (f"{name}, {text}" for text in sum_warnings(of))
        return
    elsewhere = ["failed"] if content["asked"] == LIBRARY_STATEMENT else ["failed", "refuted"]
    for name, of in sides.items():
        rates = {**of, "rate": of["crash_rate"], "n_failed": of["details"]["n_failed"]}
        told = warnings_of(content["scenario"], rates, " per test")
        more = [each for each in of["warnings"] if each["key"] not in elsewhere and each not in of["cautions"]]
        yield from (f"{name}: {text}" for text in (*told, *map(note_words, more)))
    if where := content.get("unseen"):
        yield unseen_words(where)


def deciding_words(content: Mapping[str, Any], s_per_pair: float | None = None) -> str | None:
    """What would decide a comparison (``compare.json``) that was left open, and its cost; None of a decided one."""
    decision = content["decision"]
    if decision["verdict"] != "open" or content.get("ended") == "sum":
        return None
    if decision["margin"] and (decision["n_milder"] or decision["n_differing"]):  # which no more pairs would mend
        return None
    if (needed := content["to_decide"]) is None:
        return "how many pairs would decide is not known: so far the two are too alike"
    where, done = (" and a new --out", 0) if needed["new_folder"] else ("", content["n_pairs"])
    n = two_digits_up(needed["pairs"] - done)
    cost = "" if s_per_pair is None else f", {duration(n * s_per_pair)}"
    settings = "".join(f" --set {key}={value}" for key, value in needed["settings"].items())
    options = f"--margin {decision['margin']:g}{settings}"
    return f"to decide, repeat the command with {options}{where}: some {count(n)} more pairs{cost}"


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
    return ("–", "") if of["ratio"] is None else (ratio(of["ratio"]), f"{ratio(of['ratio_low'])} to {most}")


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
        if not of["n_crashes"]:
            rate, ends = f"< {number(of['upper_bound'])}", "no crash seen"
        label = label if len(label) <= LABEL else f"{label[: LABEL - 2]} …"
        rows.append((f"{name} {label}", rate, ends, f"{count(of['n_crashes'])} crashes"))
    looks = f"verdict: confidence {plain(content['decision']['confidence'])} over all looks"
    rows.append(("A / B", *ratio_words(asked), looks * (content["decision"]["verdict"] != "open")))
    ends = interval(asked["ci_low"], asked["ci_high"], beside=asked["difference"])
    rows.append(("A − B", number(asked["difference"]), ends, alone_words(asked)))
    families = content.get("families", {})
    parts = columns(
        [(called(name), f"A / B {' '.join(ratio_words(of))}", alone_words(of)) for name, of in families.items()]
    )
    remarks = [f"! {text}" for text in pair_warnings(content)]
    if asked is not content:
        given = f"A / B and A − B assume that both crash only where {asked['boundary']} of the library does"
        remarks.insert(0, given)
    scope = scope_words(content["confidence"], ENDED.get(content.get("ended", ""), "interrupted"))
    counted = f" above {plain(above)} m/s" if (above := campaign.crash.counts_above_mps) else ""
    scenarios, unit = (scenarios_words(families), "hour") if families else (called(campaign.scenario), "test")
    pairs = f"{count(content['n_pairs'])} pairs of tests, {scenarios}"
    head = f"{pair_words(content['decision'])} · {pairs} · crashes{counted} per {unit}"
    last = [*filter(None, [deciding_words(content, s_per_pair)]), scope]
    under = wrapped([*(remarks if families else remarks[: 3 - len(last)]), *last])
    return [head, *columns(rows), *parts, *under, f"  report  {report}"]
