"""Results as JUnit XML, which every CI system shows: a test case for each statement."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, printable
from harness.estimators.short_answer import lines, within
from harness.records.folder import write_text
from harness.strata import ASSUMPTION_FREE

Outcome = Literal["passed", "failure", "error", "skipped"]


@dataclass(frozen=True)
class Case:
    """A statement: its name, what it says, and what that means for a gate.

    An ``error`` is a question left open, as by a spent budget.
    """

    name: str
    message: str
    outcome: Outcome


def outcome_of(exit_code: int) -> Outcome:
    """What a command's exit code means for a gate."""
    if exit_code == EXIT_DONE:
        return "passed"
    return "error" if exit_code == EXIT_BUDGET_SPENT else "failure"


def statement_cases(content: dict[str, Any], asked: str, exit_code: int) -> list[Case]:
    """Cases of ``estimates.json``: the statement that was asked about decides, the others are shown.

    Where there is no such statement, as under other methods than shells, the answer itself decides: a gate in which
    nothing does would let everything pass. One that tests have refuted fails, whatever was decided.
    """
    statements = content["estimates"][content["headline"]]["details"].get("statements", ())
    answer, of = "\n".join(lines(content["answer"], None)), {each["name"]: each for each in statements}
    asked = asked if asked in of else ASSUMPTION_FREE
    outcome = "failure" if asked in of and of[asked]["refuted"] else outcome_of(exit_code)
    told = {ASSUMPTION_FREE: answer, **{name: " ".join(filter(None, within(each).texts)) for name, each in of.items()}}
    told[asked] = answer
    return [Case(name, text, outcome if name == asked else "skipped") for name, text in told.items()]


def write_junit(path: Path, suite: str, cases: Sequence[Case], attachments: Sequence[Path]) -> None:
    """Write a suite; attachments are named as CI systems look for them, in the output of each case."""
    kinds: list[str] = [case.outcome for case in cases]
    root = ET.Element("testsuites")
    of_suite = ET.SubElement(root, "testsuite", name=suite, tests=str(len(cases)))
    for kind, key in (("failure", "failures"), ("error", "errors"), ("skipped", "skipped")):
        of_suite.set(key, str(kinds.count(kind)))
    for case in cases:
        element = ET.SubElement(of_suite, "testcase", classname=suite, name=case.name)
        if case.outcome != "passed":
            ET.SubElement(element, case.outcome, message=case.message)
        attached = "\n".join(f"[[ATTACHMENT|{each.resolve()}]]" for each in attachments)
        told = f"{case.message}\n" if case.outcome == "passed" else ""  # else it is in the element of the outcome
        ET.SubElement(element, "system-out").text = f"{told}{attached}\n"
    ET.indent(root)
    write_text(path, printable(ET.tostring(root, encoding="unicode", xml_declaration=True)) + "\n")
