"""Golden runs give the bits that they gave when they were recorded (see record.py)."""

import json

import pytest

from tests.golden import record
from tests.golden.campaigns import BEGUN, CONTINUED, RUNS

GOLDEN = json.loads(record.GOLDEN.read_text())


@pytest.mark.parametrize("name", RUNS)
def test_a_run_gives_the_same_bits(name, tmp_path):
    assert record.unlike(record.seen_in(record.run_here(name, tmp_path / "run")), GOLDEN["runs"][name]) == []


@pytest.mark.parametrize("name", CONTINUED)
def test_a_run_that_is_continued_ends_the_same(name, tmp_path):
    record.run_here(name, tmp_path / "run", BEGUN)
    continued = record.seen_in(record.run_here(name, tmp_path / "run", resume=True))
    assert record.unlike(continued, GOLDEN["runs"][name]) == []


def test_a_comparison_gives_the_same_bits(tmp_path):
    found = record.seen_in_comparison(record.compare_here(tmp_path / "compared"))
    assert record.unlike(found, GOLDEN["compared"]) == []


def test_all_that_is_golden_is_run():
    assert set(GOLDEN["runs"]) == set(RUNS)
