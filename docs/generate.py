"""Write the generated parts of the documentation: settings, columns, results of long runs.

    python docs/generate.py                                 rewrites them in place
    python docs/generate.py --check                         says which pages are out of date (exit code 1)
    python docs/generate.py --case-study runs/case_study    takes page and plots of a full `python -m studies case`

A generated part stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``. Its source is the code (models of the
campaign, Arrow schemas) or the committed results in ``docs/validation/``, so that it cannot drift from them.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_origin

import pyarrow as pa
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from harness.campaign.campaign import Campaign
from harness.families.cut_in.family import CUT_IN, STATE_FACTS
from harness.records.schemas import baseline_schema, episodes_schema, moments_schema, traces_schema

FOLDER = Path(__file__).parent
_PART = re.compile(r"(<!-- generated: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)

SCHEMAS = {
    "episodes": episodes_schema(CUT_IN.columns, 4, 3, 2, acts=True, shows=True),
    "moments": moments_schema(STATE_FACTS, 3),
    "traces": traces_schema(shows=True),
    "shadow": baseline_schema(CUT_IN.columns),
}
RESULTS = {
    "level_1": ("nde_1", "forced_1", "step_recursive_1", "episode_recursive_1"),
    "level_1e4": (
        "nde_1e4",
        "forced_1e4",
        "step_recursive_1e4",
        "episode_recursive_1e4",
        "nade_1e4",
        "nade_epsilon_0.9_1e4",
    ),
}
"""Results by lane-change level; the forced one of level 1 is the tests' reference."""
_ELSEWHERE = {"forced_1": FOLDER.parent / "tests" / "reference" / "default.json"}
RELVAR_TO_TESTS = (1.6448536269514722 / 0.3) ** 2
"""Tests for RHW 0.3 at 90 %, per unit of relvar."""


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    first, *others = ["| " + " | ".join(row) + " |" for row in (head, *rows)]
    return "\n".join([first, "|" + "---|" * len(head), *others]) + "\n"


def _listed(rows: list[tuple[str, ...]]) -> str:
    return "".join(f"- {name}: {text}\n" for name, text in rows)


def _choices(annotation: Any) -> str:
    """The values that a setting can have, where they can be listed."""
    if str(get_origin(annotation)) == "typing.Literal":
        return ", ".join(f"`{value}`" for value in get_args(annotation))
    return ", ".join(filter(None, map(_choices, get_args(annotation)))) if get_origin(annotation) is not dict else ""


def _setting(name: str, field: FieldInfo) -> tuple[str, ...]:
    """A key with its default, as both stand in a campaign file, and what it means."""
    value = None if field.is_required() else field.get_default(call_default_factory=True, validated_data={})
    plain = value in (None, "", {}) or isinstance(value, BaseModel | dict)
    key = f"`{name}`" if plain else f"`{name}: {value}`"
    choices, words = _choices(field.annotation), field.description or ""
    told = all(choice.strip("`") in words for choice in choices.split(", "))
    return key + (" (required)" if field.is_required() else ""), words if told or not choices else f"{words}: {choices}"


def _settings_rows(section: type[BaseModel], prefix: str = "") -> list[tuple[str, ...]]:
    """Rows of a section's keys, each before those of the section that it may be itself."""
    rows = []
    for name, field in section.model_fields.items():
        rows += [_setting(prefix + name, field)] if field.description else []
        below = _sections(field.annotation)
        rows += _settings_rows(below[0], f"{prefix}{name}.") if len(below) == 1 else []
    return rows


def _sections(annotation: Any) -> list[type[BaseModel]]:
    """The sections that a setting can be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [section for option in get_args(annotation) for section in _sections(option)]


def settings_reference() -> str:
    """All settings as a campaign file; those without a default, or in sections of sections, are comments there."""
    fields = Campaign.model_fields
    text = _commented([_setting(name, field) for name, field in fields.items() if not _sections(field.annotation)], "")
    for name, field in fields.items():
        if below := _sections(field.annotation):
            by_name = get_origin(field.annotation) is dict
            text += f"\n{'# ' * by_name}{name}{'.NAME' * by_name}:\n" + _commented(
                _settings_rows(below[0]), "  ", by_name
            )
    return text + "# "


def _commented(rows: list[tuple[str, ...]], indent: str, always: bool = False) -> str:
    lines = []
    for key, text in rows:
        name, _, value = key.replace("`", "").partition(": ")
        mark = "# " * (always or not value or "." in name)
        lines.append(f"{indent}{mark}{f'{name}: {value}' if value else name}  # {' '.join(text.split())}\n")
    return "".join(lines)


def columns_reference() -> str:
    """The columns of every table; those that episodes have as well are only named."""
    of_tests = {(key, text.removeprefix("initial ")) for key, text in _column_rows(SCHEMAS["episodes"])}
    text = ""
    for name, schema in SCHEMAS.items():
        rows = _column_rows(schema)
        known = [row for row in rows if name != "episodes" and (row[0], row[1].removeprefix("initial ")) in of_tests]
        shared = f"  # as in episodes: {', '.join(row[0] for row in known)}\n" if known else ""
        text += f"\n{name}:\n{shared}" + "".join(f"  {row[0]}: {row[1]!r}\n" for row in rows if row not in known)
    return text + "# "


def _column_rows(schema: pa.Schema) -> list[tuple[str, ...]]:
    rows = []
    for field in schema:
        words = {key.decode(): value.decode() for key, value in field.metadata.items()}
        unit = words["unit"] if not words["unit"].startswith("m") and words["unit"] not in ("", "1", "s") else ""
        more = ", ".join(filter(None, [unit, "null" if field.nullable else ""]))  # else the unit is in the name
        rows.append((field.name, f"{words['doc']}{more and f' ({more})'}"))
    return rows


def _result(name: str) -> dict[str, Any]:
    path = _ELSEWHERE.get(name, FOLDER / "validation" / f"{name}.json")
    return dict(json.loads(path.read_text(encoding="utf-8")))


def results_table(names: tuple[str, ...]) -> str:
    """Table of long runs; ratios are to the run of the episode mixture."""
    head = ("run", "tests", "crash rate", "ratio", "relvar")
    runs = {name: _result(name) for name in names}
    yardstick = next(found for name, found in runs.items() if "episode" in name)
    return _table(head, [(name, *_result_cells(found, yardstick)) for name, found in runs.items()])


def _ratio(found: dict[str, Any], yardstick: dict[str, Any]) -> str:
    """Rate over that of the yardstick, with its standard error."""
    if found == yardstick:
        return "1"
    ratio = found["crash_rate"] / yardstick["crash_rate"]
    return f"{ratio:.3f} ± {ratio * math.hypot(found['relative_error'], yardstick['relative_error']):.3f}"


def _result_cells(found: dict[str, Any], yardstick: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"{found['n_episodes']:,}",
        f"{found['crash_rate']:.4g}",
        _ratio(found, yardstick),
        f"{found['relvar']:.3g}",
    )


def _two_digits(value: float) -> int:
    size = 10 ** max(math.floor(math.log10(value)) - 1, 0)
    return round(value / size) * size


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


def limits_table() -> str:
    """What the crash rate of the default vehicle comes from, with its command."""
    found = _result("limits")
    rows = []
    for name, words in LIMITS.items():
        share, error = found["of_the_rate"][name]
        shown = f"{share:.1%}" if share < 0.999 else "> 99.9%"
        rows.append((words, f"{shown} ± {error:.1%}"))
    fast, short = found["of_the_tests"]["av_above_144_kmph"], found["of_the_cut_ins"]["lead_at_most_1.5_s"]
    return _listed(rows) + (
        f"\nOf all cut-ins {short:.1%} take at most 1.5 s; in {fast:.1%} of the tests the AV is faster than 144 km/h. "
        f"Default vehicle, {found['crash_rate']:.3g} per test, {found['n_crashes']:,} sampled crashes. "
        f"`{found['command']}`\n"
    )


VALIDATED = ("shells_acting", "shells_acting_room", "shells_acting_needed")
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


def _command(name: str) -> str:
    return f"`python -m studies validate scenarios/validate/{name}.yaml --out DIR`"


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
    return "".join(f"- `{name}`: {validated_range(name)}" for name in VALIDATED)


FORMER = ", by the former rule"


GATES = {"gate": "paper's; a rate", "gate_beside": "paper's; `r157-cc`", "gate_2": "default; `r157-cc`"}
"""Replication experiments of decisions: their traffic, and what the limit is."""


def decisions() -> str:
    """How often campaigns decided wrongly about limits at the rate itself, and in how many tests about others."""
    head = (
        *("experiment", "traffic; limit", "vehicles × campaigns", "accepted, rejected", "by the former rule"),
        *("tests: limit twice the rate", "half the rate"),
    )
    return f"{_table(head, [_decision_cells(name, of) for name, of in GATES.items()])}\n{_command('EXPERIMENT')}\n"


def _decision_cells(name: str, of: str) -> tuple[str, ...]:
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
    of_experiment = content["experiment"]
    driver, soon = of_experiment["beside"], of_experiment["budgets"][0]
    head = ("vehicle", f"times `{driver}`", "a run says (medians)", "tests", "decided after", f"within {soon:,}")
    rows, least = [], {"rate": 1.0, "ratio": 1.0, "decision": 1.0}
    for vehicle, of in _by_result(content["judgements"]).items():
        ratio, (early, late) = of[f"ratio to {driver}"], (of[key] for key in of if key.startswith("limit "))
        low, high = (_two_digits_of(ratio[end]) for end in ("low_median", "high_median"))
        after = f"{late['tests_median']:,.0f} tests" if late["reached"] > 0.5 else "–"
        rows.append(
            (
                *(vehicle, _two_digits_of(ratio["truth"]), f"{low} to {high}" if float(low) else f"below {high}"),
                *(f"{ratio['tests_median']:,.0f}", after, f"{early['reached']:.0%}"),
            )
        )
        found = zip(least, (of["shells"], ratio, late), strict=True)
        least |= {key: min(least[key], one["coverage"]) for key, one in found}
    return (
        f"{_table(head, rows)}\n"
        f"Coverage is at least {least['rate']:.3f} of the rate, {least['ratio']:.3f} of the ratio; at most "
        f"{1.0 - least['decision']:.1%} of decisions are wrong. {_command(name)} "
        f"([{name}.json](validation/{name}.json)).\n"
    )


def _two_digits_of(value: float) -> str:
    return f"{value:.2g}"


def _by_result(judgements: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for one in judgements:
        found.setdefault(one["subject"], {})[one["result"]] = one
    return found


def coverage_table() -> str:
    """Lowest coverage over the vehicles that meet the assumption, by experiment, its variants, and kind of result."""
    kinds = ("assumption-free", "given a statement", "ratio to a reference", "preventable")
    rows = []
    for name, (key, values) in VARIED.items():
        found = []
        for file in varied_files(name):
            lowest = dict.fromkeys(kinds, math.inf)
            for one in filter(_is_judged, _result(file)["judgements"]):
                if "upper bound" in one["result"]:
                    continue  # has a table of its own
                lowest[_kind(one)] = min(one["coverage"], lowest[_kind(one)])
            found.append(lowest)
        variants = f", {key.rpartition('.')[2]} {', '.join(values)}" if key else ""
        rows.append((f"`{name}`{variants}", *(", ".join(_coverage(of[kind]) for of in found) for kind in kinds)))
    return _table(("experiment", *kinds), rows)


def _coverage(lowest: float) -> str:
    return f"{lowest:.3f}" if lowest < math.inf else "–"


def _kind(one: dict[str, Any]) -> str:
    if not _is_rate(one):
        return "ratio to a reference" if one["result"].startswith("ratio to ") else "preventable"
    return "assumption-free" if _is_headline(one) else "given a statement"


def _is_headline(one: dict[str, Any]) -> bool:
    """Whether a result is the rate or difference itself, without an assumption."""
    return one["result"] in {"shells", "difference", "nade"}


def _is_judged(one: dict[str, Any]) -> bool:
    """Whether the vehicle keeps to what the result assumes; ratios and shares assume nothing."""
    return not _is_rate(one) or one["p_value_holm"] is not None


VARIED = {
    "shells_panel": ("campaign.stop.confidence", ("0.9", "0.95", "0.99")),
    "shells_adversaries": ("campaign.stop.confidence", ("0.9", "0.95", "0.99")),
    "shells_heaviest": ("campaign.stop.rhw", ("0.15", "0.05")),
    "lateral": ("campaign.environment.cut_in_lead_s", ("log-normal", "0.5", "1.0")),
    "shells_acting": ("", ("",)),
    "shells_pairs": ("", ("",)),
    "chains_shells": ("", ("",)),
}
"""Replication experiments of shells, repeated with other values of one key; the first is the file's own."""


def varied_files(name: str) -> list[str]:
    """Names of an experiment's committed results."""
    _, (_, *others) = VARIED[name]
    return [name, *(f"{name}-{value}" for value in others)]


def _is_rate(one: dict[str, Any]) -> bool:
    return not one["result"].startswith(("ratio to ", "preventable by "))


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
        f"{tests:,.0f} (median)" if needed is None else f"{_two_digits(needed):,}",
        "–" if needed is None or claimed <= 0.0 else f"{_two_digits(claimed):,}",
    )


PARTS: dict[str, Callable[[], str]] = {
    "settings": settings_reference,
    "validated-methods": methods_table,
    "limits": limits_table,
    "columns": columns_reference,
    **{f"results-{name}": partial(results_table, results) for name, results in RESULTS.items()},
    "validated-acting": validated_ranges,
    "validated-lateral": partial(validated_range, "lateral"),
    "coverage": coverage_table,
    "decisions": decisions,
    "beside": partial(beside_table, "traffic_2"),
}
"""All generated parts by name."""


def regenerate(text: str) -> str:
    """A page with its generated parts made anew."""
    return _PART.sub(lambda match: match[1] + PARTS[match[2]]() + match[3], text)


def pages() -> Iterator[Path]:
    """Pages that have generated parts."""
    files = [*sorted(FOLDER.rglob("*.md")), *sorted(FOLDER.glob("*.yaml"))]
    return (page for page in files if "<!-- generated:" in page.read_text(encoding="utf-8"))


MADE_BY = "\n\nMade by [`python -m studies case`](internals/validation.md#the-papers-case-study).\n\n"


def take_case_study(study: Path) -> None:
    """Copy the page of a study, whose plots then lie with the images, and whose links are those of a page here."""
    if not json.loads((study / "claims.json").read_text(encoding="utf-8"))["conclusive"]:
        raise SystemExit(f"{study} was made with --quick: its sizes are too small for a page")
    page = (study / "case_study.md").read_text(encoding="utf-8").replace("\n\n", MADE_BY, 1)
    page = page.replace("](plots/", "](images/case_study/").replace("(docs/scv-defect.md)", "([why](scv-defect.md))")
    (FOLDER / "case_study.md").write_text(page, encoding="utf-8")
    images = FOLDER / "images" / "case_study"
    shutil.rmtree(images, ignore_errors=True)
    shutil.copytree(study / "plots", images)


def main() -> int:
    """Rewrite, or with ``--check`` only compare; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--case-study", type=Path, metavar="FOLDER")
    asked = parser.parse_args()
    check: bool = asked.check
    if asked.case_study is not None:
        take_case_study(asked.case_study)
    stale = 0
    for page in pages():
        before = page.read_text(encoding="utf-8")
        after = regenerate(before)
        if after != before:
            stale += 1
            print(f"{page.relative_to(FOLDER.parent)}: {'out of date' if check else 'rewritten'}")  # noqa: T201
            if not check:
                page.write_text(after, encoding="utf-8")
    return int(check and stale > 0)


if __name__ == "__main__":
    raise SystemExit(main())
