"""The page of several scenarios: the sum, each one's part of it as a bar, and the way to each one's own report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.report.hour_words import called, decided, exposures, family_rows, milder, reading_rows, scope, sum_rows
from harness.report.templates import write_page
from harness.runner.families import read_families


def write_hours(folder: str | Path) -> Path:
    """Write ``report.html`` into a folder of several scenarios anew, and return it.

    Raises `RunFolderError`: ``families.json`` is missing or damaged.
    """
    return write_hours_of(Path(folder), read_families(Path(folder)))


def write_hours_of(folder: Path, content: dict[str, Any]) -> Path:
    """Write the page of an answer in hand."""
    rows = list(family_rows(content))
    sizes = [content["families"][row[0]] for row in rows]
    return write_page(
        folder / "report.html", "hours.html.j2",
        content=content, sums=[*sum_rows(content), *reading_rows(content)], verdict=decided(content),
        rows=list(zip(rows, sizes, strict=True)),
        warnings=list(milder(content)), exposures=exposures(content), scope=scope(content), called=called,
    )  # fmt: skip
