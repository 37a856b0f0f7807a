"""What pages tell of long runs: tables and lists from the results that are committed in ``docs/validation/``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
ROWS = list[tuple[str, ...]]
LEVELS = {
    "level_1": ("nde_1", "forced_1", "step_recursive_1", "episode_recursive_1"),
    "level_1e4": (
        *("nde_1e4", "forced_1e4", "step_recursive_1e4", "episode_recursive_1e4", "nade_1e4"),
        "nade_epsilon_0.9_1e4",
    ),
}
"""Long runs by lane-change level; the forced one of level 1 is the tests' reference."""
_ELSEWHERE = {"forced_1": FOLDER.parent / "tests" / "reference" / "default.json"}
LIMITS = {
    "cut_in_ignores_the_av": "BV does not look at the AV at all (share `ignore_share` of all lane changes)",
    "lead_at_most_1.5_s": "at most 1.5 s from the onset to the overlap",
    "ttc_at_onset_below_2_s": "time to collision at the onset below 2 s",
    "ttc_below_1.5_s": "time to collision at the overlap below 1.5 s",
    "gap_below_5_m": "gap R2 at the overlap below 5 m",
    "crash_within_1_s": "crash within one second of the overlap",
    "av_above_144_kmph": "AV faster than 144 km/h",
}
"""Figures of docs/limits.md, in words."""
ACTING = ("shells_acting", "shells_acting_room", "shells_acting_needed")
"""Replication experiments of vehicles that act before the cut-in."""
METHODS = {
    "twin_nde": "NDE, level 10,000",
    "twin_nade": "NADE, ε = 0.1",
    "twin_step_recursive": "step mixture, recursive",
    "twin_episode": "episode mixture, recursive",
    "twin_forced": "forced cut-ins",
    "shells_panel": "shells, stopped",
}
"""Experiments from which one vehicle (idm) is compared over methods."""
RELVAR_TO_TESTS = (1.6448536269514722 / 0.3) ** 2
"""Tests for RHW 0.3 at 90 %, per unit of relvar."""
GATES = {"gate": "paper's; a rate", "gate_beside": "paper's; `r157-cc`", "gate_2": "default; `r157-cc`"}
"""Replication experiments of decisions: their traffic, and what the limit is."""
FORMER = ", by the former rule"
CONFIDENCES = "campaign.stop.confidence", ("0.9", "0.95", "0.99")
VARIED: dict[str, tuple[str, tuple[str, ...]]] = {
    "shells_panel": CONFIDENCES,
    "shells_adversaries": CONFIDENCES,
    "shells_heaviest": ("campaign.stop.rhw", ("0.15", "0.05")),
    "lateral": ("campaign.environment.cut_in_lead_s", ("log-normal", "0.5", "1.0")),
    "shells_acting": ("", ("",)),
    "shells_pairs": ("", ("",)),
    "chains_shells": ("", ("",)),
}
"""Replication experiments of shells, repeated with other values of one key; the first is the file's own."""


def _result(name: str) -> dict[str, Any]:
    path = _ELSEWHERE.get(name, FOLDER / "validation" / f"{name}.json")
    return dict(json.loads(path.read_text(encoding="utf-8")))


def _table(head: tuple[str, ...], rows: ROWS) -> str:
    first, *others = ["| " + " | ".join(row) + " |" for row in (head, *rows)]
    return "\n".join([first, "|" + "---|" * len(head), *others]) + "\n"


def _command(name: str) -> str:
    return f"`python -m studies validate scenarios/validate/{name}.yaml --out DIR`"


def _two_digits(value: float) -> str:
    size = 10 ** max(math.floor(math.log10(value)) - 1, 0)
    return f"{round(value / size) * size:,}"


def results_table(names: tuple[str, ...]) -> str:
    """Table of long runs; ratios, with their standard errors, are to the run of the episode mixture."""
    runs = {name: _result(name) for name in names}
    yardstick = next(found for name, found in runs.items() if "episode" in name)
    rows = ROWS()
    for name, found in runs.items():
        ratio = found["crash_rate"] / yardstick["crash_rate"]
        error = ratio * math.hypot(found["relative_error"], yardstick["relative_error"])
        shown = "1" if found is yardstick else f"{ratio:.3f} ± {error:.3f}"
        rows.append((name, f"{found['n_episodes']:,}", f"{found['crash_rate']:.4g}", shown, f"{found['relvar']:.3g}"))
    return _table(("run", "tests", "crash rate", "ratio", "relvar"), rows)


def limits_list() -> str:
    """What the crash rate of the default vehicle comes from, with its command."""
    found, told = _result("limits"), ""
    for name, words in LIMITS.items():
        share, error = found["of_the_rate"][name]
        told += f"- {words}: {f'{share:.1%}' if share < 0.999 else '> 99.9%'} ± {error:.1%}\n"
    fast, short = found["of_the_tests"]["av_above_144_kmph"], found["of_the_cut_ins"]["lead_at_most_1.5_s"]
    return told + (
        f"\nOf all cut-ins {short:.1%} take at most 1.5 s; in {fast:.1%} of the tests the AV is faster than 144 km/h. "
        f"Default vehicle, {found['crash_rate']:.3g} per test, {found['n_crashes']:,} sampled crashes. "
        f"`{found['command']}`, whose head shows the run\n"
    )


def validated_range(name: str) -> str:
    """What a replication experiment found without an assumption, over its vehicles."""
    of = [one for one in _result(name)["judgements"] if _is_headline(one)]

    def span(key: str, form: str) -> str:
        ends = (f"{end(one[key] for one in of):{form}}" for end in (min, max))
        return " to ".join(dict.fromkeys(ends))

    return (
        f"{len(of)} vehicles with true rates of {span('truth', '.3g')}: coverage {span('coverage', '.3f')}, bias "
        f"{span('bias', '+.1%')}, {span('tests_median', ',.0f')} tests (medians).\n"
    )


def validated_ranges() -> str:
    """The same of experiments whose vehicles act before the cut-in, a line for each."""
    return "".join(f"- `{name}`: {validated_range(name)}" for name in ACTING)


def decisions() -> str:
    """How often campaigns decided wrongly about limits at the rate itself, and in how many tests about others."""
    head = (
        *("experiment", "traffic; limit", "vehicles × campaigns", "accepted, rejected", "by the former rule"),
        *("tests: limit twice the rate", "half the rate"),
    )
    return f"{_table(head, [_decision_row(name, of) for name, of in GATES.items()])}\n{_command('EXPERIMENT')}\n"


def _decision_row(name: str, of: str) -> tuple[str, ...]:
    content = _result(name)
    budget = content["experiment"]["campaign"]["stop"]["episodes"]
    by_vehicle = _by_result(content["judgements"])

    def most(by: str = "") -> str:
        ways = (f"limit 1 x rate, {verdict} within {budget:,} tests{by}" for verdict in ("accepted", "rejected"))
        errors = (max(100.0 * (1.0 - each[way]["coverage"]) for each in by_vehicle.values()) for way in ways)
        return ", ".join(f"{error:.1f} %" for error in errors)

    def tests(way: str) -> str:
        found = {each: of[f"limit {way} within {budget:,} tests"] for each, of in by_vehicle.items()}
        medians = [one["tests_median"] for one in found.values() if one["reached"] > 0.5]
        return f"{min(medians):,.0f} to {max(medians):,.0f} ({found['idm']['tests_median']:,.0f})"

    campaigns = f"{len(by_vehicle)} × {content['judgements'][0]['replications']}"
    link = f"[`{name}`](validation/{name}.json)"
    return (link, of, campaigns, most(), most(FORMER), tests("2 x rate, rejected"), tests("0.5 x rate, accepted"))


def beside_table(name: str) -> str:
    """Each vehicle beside the reference driver: what a run says, when it is decided, how often both hold; command."""
    content = _result(name)
    driver, soon = content["experiment"]["beside"], content["experiment"]["budgets"][0]
    head = ("vehicle", f"times `{driver}`", "a run says (medians)", "tests", "decided after", f"within {soon:,}")
    rows, least = ROWS(), {"rate": 1.0, "ratio": 1.0, "decision": 1.0}
    for vehicle, of in _by_result(content["judgements"]).items():
        ratio, (early, late) = of[f"ratio to {driver}"], (of[key] for key in of if key.startswith("limit "))
        truth, low, high = (f"{ratio[key]:.2g}" for key in ("truth", "low_median", "high_median"))
        says = f"{low} to {high}" if float(low) else f"below {high}"
        after = f"{late['tests_median']:,.0f} tests" if late["reached"] > 0.5 else "–"
        rows.append((vehicle, truth, says, f"{ratio['tests_median']:,.0f}", after, f"{early['reached']:.0%}"))
        found = zip(least, (of["shells"], ratio, late), strict=True)
        least |= {key: min(least[key], one["coverage"]) for key, one in found}
    return (
        f"{_table(head, rows)}\n"
        f"Coverage is at least {least['rate']:.3f} of the rate, {least['ratio']:.3f} of the ratio; at most "
        f"{1.0 - least['decision']:.1%} of decisions are wrong. {_command(name)} "
        f"([{name}.json](validation/{name}.json)).\n"
    )


def _by_result(judgements: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for one in judgements:
        found.setdefault(one["subject"], {})[one["result"]] = one
    return found


def coverage_table() -> str:
    """Lowest coverage over the vehicles that meet the assumption, by experiment, its variants, and kind of result."""
    kinds = ("assumption-free", "given a statement", "ratio to a reference", "preventable")
    rows = ROWS()
    for name, (key, values) in VARIED.items():
        found: dict[str, list[str]] = {kind: [] for kind in kinds}
        for file in (name, *(f"{name}-{value}" for value in values[1:])):
            judged = [one for one in _result(file)["judgements"] if _is_judged(one)]
            for kind, shown in found.items():
                lowest = min((one["coverage"] for one in judged if _kind(one) == kind), default=None)
                shown.append("–" if lowest is None else f"{lowest:.3f}")
        variants = f", {key.rpartition('.')[2]} {', '.join(values)}" if key else ""
        rows.append((f"`{name}`{variants}", *(", ".join(shown) for shown in found.values())))
    return _table(("experiment", *kinds), rows)


def _kind(one: dict[str, Any]) -> str:
    if not _is_rate(one):
        return "ratio to a reference" if one["result"].startswith("ratio to ") else "preventable"
    return "assumption-free" if _is_headline(one) else "given a statement"


def _is_headline(one: dict[str, Any]) -> bool:
    """Whether a result is the rate or difference itself, without an assumption."""
    return one["result"] in {"shells", "difference", "nade"}


def _is_rate(one: dict[str, Any]) -> bool:
    return not one["result"].startswith(("ratio to ", "preventable by "))


def _is_judged(one: dict[str, Any]) -> bool:
    """Whether it is an interval, and the vehicle keeps to what that assumes; ratios and shares assume nothing."""
    return "upper bound" not in one["result"] and (not _is_rate(one) or one["p_value_holm"] is not None)


def methods_table() -> str:
    """Table of methods on the default vehicle, all by replication."""
    head = ("method", "estimator", "bias", "coverage", "tests for RHW 0.3", "as claimed")
    rows = [
        (words, *_method_cells(one))
        for name, words in METHODS.items()
        for one in _result(name)["judgements"]
        if one["subject"] == "idm" and _is_rate(one) and "shells, " not in one["result"]
    ]
    return _table(head, rows) + f"\nExperiments: {', '.join(f'`{name}`' for name in METHODS)}\n"


def _method_cells(one: dict[str, Any]) -> tuple[str, ...]:
    tests, needed = one["tests_median"], one["tests_for_wanted_rhw"]
    claimed = one["claimed_relvar"] * tests * RELVAR_TO_TESTS
    return (
        f"`{one['result']}`",
        f"{one['bias']:+.1%} ± {one['bias_std_error']:.1%}",
        f"{one['coverage']:.3f}",
        f"{tests:,.0f} (median)" if needed is None else _two_digits(needed),
        "–" if needed is None or claimed <= 0.0 else _two_digits(claimed),
    )
