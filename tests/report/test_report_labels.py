"""Names of lines: where no line is, and one for each."""

from __future__ import annotations

import numpy as np
import pytest
from test_report_page import estimates_of

from harness.report.convergence_plot import convergence_plot
from harness.report.plot_style import svg
from harness.report.time_space_plot import NAME_HEIGHT, Track, time_space_plot
from harness.report.worst_crashes import Crash


@pytest.mark.parametrize("name", ["full", "shells", "shells_inside_only"])
def test_legends_of_convergence_lie_outside_the_panels(reports, name):
    plot = convergence_plot(estimates_of(reports[name]), 0.05)
    svg(plot)  # lays out
    for axes in plot.figure.axes:
        legend = axes.get_legend().get_window_extent()
        assert legend.y0 >= axes.get_window_extent().y1 - 1.0
        assert legend.x1 <= plot.figure.bbox.x1


def test_speeds_are_named_apart_even_if_equal():
    crash = Crash(
        episode=7, impact_speed_mps=10.0, crash_time_s=8.0, log_weight=0.0, cut_in_step=70.0, cut_in_r2_m=9.0,
        cut_in_r2dot_mps=-10.0, v_bv_mps=20.0, n_control_steps=1.0, component=0,
    )  # fmt: skip
    time_s = np.arange(0.0, 8.05, 0.1)
    speeds = {"LV": 20.0, "BV": 20.0, "AV": 30.0}
    tracks = {
        name: Track(time_s, 10.0 * k + speed * time_s, np.full(time_s.size, speed), np.zeros(time_s.size))
        for k, (name, speed) in enumerate(speeds.items())
    }
    speed = time_space_plot(crash, tracks, worth="weight 1").figure.axes[1]
    heights = {text.get_text(): text.xy[1] for text in speed.texts}
    assert set(heights) == set(speeds)
    assert abs(heights["LV"] - heights["BV"]) >= NAME_HEIGHT
    assert heights["AV"] == max(heights.values())
