from __future__ import annotations

import math

import pytest

from harness.report import number_format as f
from harness.report.plot_style import tick_label


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.2345e-7, "1.23 × 10⁻⁷"),
        (9.999e-8, "1.00 × 10⁻⁷"),
        (0.0, "0"),
        (0.05, "0.0500"),
        (1234.5, "1,234"),
        (-2.5, "−2.50"),
        (1e9, "1.00 × 10⁹"),
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "∞"),
    ],
)
def test_number(value, text):
    assert f.number(value) == text


@pytest.mark.parametrize(
    ("rhw", "text"), [(0.05, "0.0500"), (9.99, "9.99"), (842.79, "> 10"), (math.inf, "> 10"), (None, "–")]
)
def test_a_half_width_that_says_nothing_has_no_digits(rhw, text):
    assert f.half_width(rhw) == text


def test_interval_shares_power_and_decimals():
    assert f.interval(9.67e-8, 1.11e-7) == "(0.97 to 1.11) × 10⁻⁷"
    assert f.with_interval(1.04e-7, 9.67e-8, 1.11e-7) == "1.04 (0.97 to 1.11) × 10⁻⁷"
    assert f.interval(0.0, 3.2e-4) == "(0.00 to 3.20) × 10⁻⁴"
    assert f.interval(None, 1.0) == "– to 1.00"


@pytest.mark.parametrize(
    ("share", "text"), [(0.0, "0 %"), (1.0, "100 %"), (0.0123, "1.2 %"), (0.9, "90 %"), (1e-7, "1.0 × 10⁻⁵ %")]
)
def test_percent(share, text):
    assert f.percent(share) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(1e-7, "10⁻⁷"), (2e-7, "2·10⁻⁷"), (0.01, "0.01"), (0.5, "0.5"), (1e3, "1000"), (5e4, "5·10⁴"), (1e5, "10⁵")],
)
def test_tick_label(value, text):
    assert tick_label(value) == text


def test_other_quantities():
    assert f.duration(12.34) == "12.3 s"
    assert f.duration(200.0) == "3 min 20 s"
    assert f.duration(3720.0) == "1 h 02 min"
    assert f.size(999) == "999 B"
    assert f.size(1_500_000) == "1.5 MB"
    assert f.decimal(-10.71) == "−10.7"
    assert f.value(1e-05) == "1e-05"
    assert f.value([1.0, 2.5]) == "1.0, 2.5"
    assert f.sentence("the bound is not safe") == "The bound is not safe."
    assert f.signed_percent(-0.012) == "−1.2 %"
