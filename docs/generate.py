"""Write the generated parts of the documentation: settings, columns, results of long runs.

    python -m docs.generate                                 rewrites them in place
    python -m docs.generate --check                         says which pages are out of date (exit code 1)
    python -m docs.generate --case-study runs/case_study    takes page and plots of a full `python -m studies case`

A generated part stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``. Its source is the code (models of the
campaign, Arrow schemas) or the committed results (`docs.results`), so that it cannot drift from them.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_origin

import pyarrow as pa
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from docs import results
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


PARTS: dict[str, Callable[[], str]] = {
    "settings": settings_reference,
    "columns": columns_reference,
    "limits": results.limits_list,
    **{f"results-{level}": partial(results.results_table, runs) for level, runs in results.LEVELS.items()},
    "validated-methods": results.methods_table,
    "validated-acting": results.validated_ranges,
    "validated-lateral": partial(results.validated_range, "lateral"),
    "coverage": results.coverage_table,
    "decisions": results.decisions,
    "beside": partial(results.beside_table, "traffic_2"),
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
