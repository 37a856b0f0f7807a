"""JUnit XML as a CI system reads it."""

from __future__ import annotations

import pytest
from junitparser import JUnitXml

from harness.report.junit import Case, outcome_of, statement_cases, write_junit

CONTENT = {
    "decision": {"sentence": "REJECTED: <above> & beyond\x1b[31m."},
    "statement": "The crash rate is 1e-07 per test.",
    "boundary_statements": {"library": "If it crashes only where …"},
}


@pytest.mark.parametrize(("code", "kind"), [(0, None), (4, "Error"), (5, "Failure"), (3, "Failure")])
def test_what_was_asked_decides_and_the_rest_is_shown(tmp_path, code, kind):
    file, report = tmp_path / "gate.xml", tmp_path / "report.html"
    write_junit(file, "smoke", statement_cases(CONTENT, "assumption_free", code), [report])
    (suite,) = JUnitXml.fromfile(str(file))
    assert (suite.name, suite.tests, suite.skipped) == ("smoke", 2, 1)
    assert (suite.failures, suite.errors) == (int(kind == "Failure"), int(kind == "Error"))
    asked, other = suite
    assert (asked.name, other.name) == ("assumption_free", "library")
    assert [type(each).__name__ for each in asked.result] == ([] if kind is None else [kind])
    assert [type(each).__name__ for each in other.result] == ["Skipped"]
    message = f"REJECTED: <above> & beyond\\u001b[31m. {CONTENT['statement']}"
    assert all(each.message == message for each in asked.result)
    assert f"[[ATTACHMENT|{report}]]" in asked.system_out


def test_a_gate_never_passes_because_nothing_was_asked():
    """A method without shells may still carry a statement's name in its settings."""
    cases = statement_cases({**CONTENT, "decision": None, "boundary_statements": {}}, "library", 4)
    assert [(case.name, case.outcome) for case in cases] == [("assumption_free", "error")]


def test_a_comparison_is_one_case(tmp_path):
    write_junit(tmp_path / "c.xml", "a and b", [Case("difference", "B is worse.", outcome_of(5))], [])
    (suite,) = JUnitXml.fromfile(str(tmp_path / "c.xml"))
    assert (suite.failures, [case.name for case in suite]) == (1, ["difference"])
