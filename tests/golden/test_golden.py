"""Golden runs give the bits that they gave when they were recorded (see record.py).

Estimates may differ in the last digits from one processor to another; ``python -m tests.golden.record --only …`` on
one like that which recorded them asks for all.
"""

import json

import pytest

from tests.golden import record
from tests.golden.campaigns import BEGUN, CONTINUED, RUNS, quick
from tests.in_process import run_here
from tests.stored_runs import golden

GOLDEN = json.loads(record.GOLDEN.read_text())
DIGITS = 1e-9  # as docs/determinism.md promises


@pytest.mark.parametrize("name", quick(RUNS))
def test_a_run_gives_the_same_bits(name, stored_run):
    assert record.unlike(record.seen_in(stored_run(name)), GOLDEN["runs"][name], digits=DIGITS) == []


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[pytest.mark.slow] * (each == "shells-acting-twin")) for each in CONTINUED]
)
def test_a_run_that_is_continued_ends_the_same(name, tmp_path):
    run_here(golden(name, BEGUN), tmp_path / "run")
    run_here(golden(name), tmp_path / "run", resume=True)
    assert record.unlike(record.seen_in(tmp_path / "run"), GOLDEN["runs"][name], digits=DIGITS) == []


def test_a_comparison_gives_the_same_bits(tmp_path):
    found = record.seen_in_comparison(record.compare(tmp_path / "compared"))
    assert record.unlike(found, GOLDEN["compared"], digits=DIGITS) == []


def test_all_that_is_golden_is_run():
    assert set(GOLDEN["runs"]) == set(RUNS)
