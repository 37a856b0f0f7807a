"""Answers laid out for a terminal: some nine lines of 100 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.estimators.answer import STORED_ESTIMATES, Estimates
from harness.numbers import count, duration, interval, share
from harness.report.words import ShortAnswer, short_answer

WIDTH, LINES, LABEL = 100, 9, 26
MOST_WARNINGS = 3


def lines(answer: ShortAnswer, took_s: float | None = None, report: Path | None = None) -> list[str]:
    """An answer for a terminal: at most `LINES` lines.

    Those of more than `WIDTH` columns go on below. Where there is much to warn of the last rows give way: all of it is
    on the page.
    """
    warnings = [f"! {text}" for text in answer.warnings]
    if len(warnings) > MOST_WARNINGS:
        warnings[MOST_WARNINGS - 1 :] = [f"! {count(len(warnings) - MOST_WARNINGS + 1)} more warnings: see the report"]
    ends = [answer.scope, *([] if report is None else [f"report  {report}"])]
    rows = answer.rows[: LINES - 1 - len(warnings) - len(ends)]
    table = columns([row.texts for row in rows])
    return [headed(answer, took_s), *table, *wrapped([*warnings, ends[0]]), *(f"  {line}" for line in ends[1:])]


def headed(answer: ShortAnswer, took_s: float | None) -> str:
    """The first line: who was tested, with as many of its parameters as there is room for, and how often."""
    head = [answer.vehicle, answer.tests, *([] if took_s is None else [duration(took_s)])]
    if told := ", ".join(map(" ".join, answer.parameters)):
        room = WIDTH - len(" · ".join(head)) - 3
        head[0] += f" ({textwrap.shorten(told, max(room, 8), placeholder=' …')})"
    return " · ".join(head)


def run_lines(
    campaign: Campaign, manifest: Mapping[str, Any], content: Estimates | Mapping[str, Any], report: Path
) -> list[str]:
    """The answer of a run; the ``report`` is named if it is there, and of the same traffic."""
    told = STORED_ESTIMATES.validate_python(content)
    page = report if told.elsewhere is None and report.is_file() else None
    return lines(short_answer(campaign, manifest, told), manifest.get("wall_time_s"), page)


def estimate_lines(content: Mapping[str, Any]) -> list[str]:
    """The estimators of ``estimates.json``, a line each; those that its records do not allow are not named."""
    head = f"{content['campaign']}: {count(content['n_crashes'])} crashes in {count(content['n_episodes'])} tests"
    found = {name: each for name, each in content["estimates"].items() if each["crash_rate"] is not None}
    rows = [
        (name, interval(each.get("ci_low"), each.get("ci_high"), each["crash_rate"])) for name, each in found.items()
    ]
    return [f"{head}; crash rate per test ({share(content['confidence'])})", *(columns(rows) if rows else ())]


def columns(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Rows of equally many texts, each column as wide as its widest; a row too long for that is narrower at its end."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        padded = [text.ljust(width) for text, width in zip(row, widths, strict=True)]
        left, remark = "  ".join(["", *padded[:-1]]).rstrip(), row[-1]
        line = "  ".join(["", *padded]).rstrip()
        if len(line) > WIDTH:
            line = f"{left}  {remark:>{max(WIDTH - 2 - len(left), 0)}}"
        for n in reversed(range(len(row) - 1)):
            line = line if len(line) <= WIDTH else "  ".join(["", *padded[:n], *filter(None, row[n:])])
        yield from [line] if len(line) <= WIDTH else wrapped(["  ".join(filter(None, row))])


def wrapped(texts: Iterable[str]) -> Iterator[str]:
    """Lines of at most `WIDTH` columns, which begin after two spaces and go on after four."""
    fill = textwrap.TextWrapper(WIDTH, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False)
    for text in texts:
        whole = text.replace(" %", "\u00a0%").replace("± ", "±\u00a0")  # a number and its sign stay together
        yield from (line.replace("\u00a0", " ") for line in fill.wrap(whole))
