"""Results as JUnit XML, which every CI system shows: a test case for what was asked."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, printable
from harness.records.folder import write_bytes
from harness.report.rows import limit_words
from harness.report.several import pair_words
from harness.strata import LIBRARY_STATEMENT

Outcome = Literal["passed", "failure", "error"]
OUTCOMES: Mapping[int, Outcome] = {EXIT_DONE: "passed", EXIT_BUDGET_SPENT: "error"}
"""What a command's exit code means for a gate; any other is a failure."""


@dataclass(frozen=True)
class Case:
    """A gate's case: its name, what it says, and the outcome; an ``error`` is a question left open."""

    name: str
    message: str
    outcome: Outcome
    verdict: str = ""
    """In one line; by default the message's second row, below what was tested."""


def statement_case(content: dict[str, Any], message: str, statement: str, exit_code: int) -> Case:
    """Case of an answer, which the ``message`` tells: the statement that was asked about decides.

    It fails where a test has refuted it. Where there is no such statement, as under other methods than shells, the
    answer itself decides: a gate in which nothing does would let everything pass. What was not asked is not told.
    """
    name, within = "crashes per hour", dict[str, Any]()
    if "families" not in content:
        name, answer = "crash rate", content["estimates"][content["headline"]]
        within = answer.get("details", {}).get("within") or {}
    asks = bool(within) and statement == LIBRARY_STATEMENT
    outcome = "failure" if asks and within["refuted"] else OUTCOMES.get(exit_code, "failure")
    if (decision := content.get("decision")) is not None:
        limit = limit_words(decision, "hour" if "families" in content else "test")
        name = f"crashes below {limit}" if limit.endswith("per hour") else f"{name} below {limit}"
    return Case(f"{name}, given the {LIBRARY_STATEMENT}" if asks else name, message, outcome)


def difference_case(content: dict[str, Any], message: str, exit_code: int) -> Case:
    """Case of ``compare.json``, which the ``message`` tells: that B is not worse by more than the margin, if any."""
    decision = content["decision"]
    name = pair_words({**decision, "verdict": "proven"}) if decision["margin"] is not None else "difference"
    return Case(name, message, OUTCOMES.get(exit_code, "failure"), verdict=pair_words(decision))


def write_junit(path: Path, suite: str, case: Case, attachments: Sequence[Path]) -> None:
    """Write a suite of one case; attachments are named as CI systems look for them, in its output."""
    counted = {f"{kind}s": str(int(case.outcome == kind)) for kind in ("failure", "error")}
    root = ET.Element("testsuites")
    of_suite = ET.SubElement(root, "testsuite", {"name": suite, "tests": "1", **counted})
    element = ET.SubElement(of_suite, "testcase", classname=suite, name=case.name)
    attached = [f"[[ATTACHMENT|{each.resolve()}]]" for each in attachments]
    output = [case.message] if case.outcome == "passed" else []
    if not output:
        rows = case.message.replace("\n    ", " ").splitlines()[:2] or [""]  # those too long go on below
        what, *parts = re.split(" {2,}", rows[-1].strip())  # cells of a row
        message = case.verdict or ": ".join(filter(None, [what, ", ".join(parts)]))
        ET.SubElement(element, case.outcome, message=message).text = case.message
    ET.SubElement(element, "system-out").text = "\n".join([*output, *attached, ""])
    ET.indent(root)
    text = printable(ET.tostring(root, encoding="unicode", xml_declaration=True))
    write_bytes(path, f"{text}\n".encode())
