"""What crashes have in common: the scan finds narrow bands, keeps its level, and the page says it in words."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

from harness.report import telling_bands as scan
from harness.report.crash_contrast import CONDITIONS, Contrast, Group, crash_contrast
from harness.report.telling_bands import SIGNIFICANT, telling_bands

Q = len(CONDITIONS)
CRASH = np.arange(1_000) < 20


def noise(rng, q=Q):
    return rng.normal(0.0, 10.0, (q, CRASH.size))


@pytest.mark.parametrize("weighted", [False, True])
def test_a_narrow_band_inside_the_range_comes_first(weighted):
    rng = np.random.default_rng(1)
    values = noise(rng)
    values[3, CRASH] = rng.uniform(2.02, 2.48, 20)
    weight = rng.lognormal(0.0, 1.0, CRASH.size) if weighted else np.ones(CRASH.size)
    first, *others = telling_bands(values, CRASH, weight)
    assert (first.quantity, first.low, first.high, first.n_crashes) == (3, 2.0, 2.5, 20)
    assert first.crash_share == pytest.approx(1.0)
    inside = (values[3] >= 2.0) & (values[3] <= 2.5) & ~CRASH
    assert first.other_share == pytest.approx(weight[inside].sum() / weight[~CRASH].sum())
    assert first.significant
    assert not any(band.significant for band in others)


def test_an_open_end_and_missing_and_infinite_values():
    rng = np.random.default_rng(2)
    values = noise(rng, 2)
    values[1] = np.where(CRASH, rng.uniform(0.0, 1.0, CRASH.size), np.inf)
    values[0, ::3] = np.nan
    first = telling_bands(values, CRASH, np.ones(CRASH.size))[0]
    assert (first.quantity, first.low) == (1, -np.inf)
    assert first.high <= 1.0
    assert first.other_share == 0.0


@pytest.mark.parametrize("weighted", [False, True])
def test_chance_is_seldom_called_telling(weighted, monkeypatch):
    """Over 200 worlds without any difference, p ≤ 0.1 must not come more often than in a tenth (level 1e-4)."""
    monkeypatch.setattr(scan, "RELABELINGS", 19)  # of which an exact test has p ≤ 2/20 in one world of ten
    rng = np.random.default_rng(3)
    low = 0
    for _ in range(200):
        weight = rng.lognormal(0.0, 1.5, CRASH.size) if weighted else np.ones(CRASH.size)
        low += telling_bands(noise(rng, 4), CRASH, weight)[0].p_value <= 0.1
    assert binomtest(low, 200, 0.1, alternative="greater").pvalue > 1e-4
    assert low > 0


def test_without_the_price_of_many_comparisons_chance_would_be_telling():
    """The best of a thousand bands, judged by the usual limit of a likelihood ratio, «stands out» of mere noise."""
    rng = np.random.default_rng(4)
    best = scan.Scan(noise(rng), np.ones(CRASH.size)).log_ratios(np.flatnonzero(CRASH)).max()
    assert 2.0 * best > 6.63  # 1 % point of chi-squared with one degree of freedom


@pytest.fixture
def contrast_of(runs):
    return lambda name: crash_contrast(runs[name])


@pytest.mark.parametrize("name", ["shells", "shells_no_crashes", "shells_inside_only"])
def test_without_crashes_outside_there_is_nothing_to_compare(contrast_of, name):
    found = contrast_of(name)
    assert found.sentence == "No test outside the boundary crashed, so there is nothing to compare."


def test_of_shells_only_the_outside_is_compared(runs, contrast_of):
    found, outside = contrast_of("shells_refuted"), runs["shells_refuted"].shells.shells[-1]
    assert found.outside
    assert found.crashes.n == outside.n_crashes
    assert 0 < found.others.n <= outside.n_episodes - outside.n_crashes  # those that had a cut-in


def test_failed_tests_are_on_neither_side(runs, contrast_of):
    found = contrast_of("failed")
    assert not found.outside
    assert found.crashes.n + found.others.n <= runs["failed"].n_episodes - 25


def test_a_few_crashes_have_nothing_in_common():
    crashes, others = Group(), Group()
    crashes.weight, others.weight = np.ones(2), np.ones(50)
    few = Contrast(True, crashes, others, ())
    assert few.sentence.startswith("With 2 crashes outside the boundary and 50 cut-ins")
    assert SIGNIFICANT > 1.0 / (1.0 + scan.RELABELINGS)
