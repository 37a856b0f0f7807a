from __future__ import annotations

import pytest

from harness.report.answer_plot import answer_plot


def estimates(**rates: tuple[float, float, float] | None) -> dict:
    entries = {
        name: {"crash_rate": None, "reason": "not allowed"}
        if rate is None
        else dict(zip(("crash_rate", "ci_low", "ci_high"), rate, strict=True))
        for name, rate in rates.items()
    }
    return {
        "headline": next(iter(rates)),
        "estimates": entries,
        "lane_change_level": 1.0,
        "confidence": 0.9,
        "distance_per_test_km": 0.3,
    }


@pytest.mark.parametrize(
    ("rates", "scale"),
    [
        ({"nade": (1.0e-7, 0.9e-7, 1.1e-7)}, "linear"),
        ({"nade": (1.0e-8, 1.0e-12, 2.0e-8)}, "linear"),
        ({"nde": (0.0, 0.0, 3.0e-4)}, "linear"),
        ({"nade": (1.0e-7, 0.9e-7, 1.1e-7), "nde": (0.0, 0.0, 1e-4)}, "log"),
        ({"nade": (1.0e-7, 0.9e-7, 1.1e-7), "other": (1.0e-4, 0.0, 2e-4)}, "log"),
    ],
)
def test_axis_is_logarithmic_only_where_estimators_differ_by_orders_of_magnitude(rates, scale):
    plot = answer_plot(estimates(**rates))
    axes = plot.figure.axes[0]
    plot.figure.draw_without_rendering()
    assert axes.get_xscale() == scale
    low, high = axes.get_xlim()
    for rate, _, end in rates.values():
        assert end <= high
        assert rate >= low or rate == 0.0


def test_intervals_are_drawn_where_they_are_with_the_headline_first():
    plot = answer_plot(estimates(cv=(2.0e-7, 1.5e-7, 2.5e-7), nade=(2.1e-7, 1.0e-7, 3.0e-7), scv=None))
    axes = plot.figure.axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["cv", "nade"]
    assert list(axes.lines[0].get_xdata()) == [1.5e-7, 2.5e-7]
    assert "2.00 (1.50 to 2.50) × 10⁻⁷" in [text.get_text() for text in axes.texts]


def test_nothing_to_draw_without_any_rate():
    assert answer_plot(estimates(scv=None)) is None
