"""Coverage of every interval with its own uncertainty, and the tests that it took."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.report.plot_style import BLUE, FULL_WIDTH_IN, GREY, INK, VERMILLION, Plot, new_figure
from harness.studies.judgement import Judgement


def coverage_plot(judgements: Sequence[Judgement], confidence: float) -> Plot:
    """Draw coverage on the left and tests on the right, one line for each vehicle and result.

    Parameters
    ----------
    judgements : sequence of Judgement
    confidence : float
        Nominal coverage.
    """
    n = len(judgements)
    figure = new_figure(FULL_WIDTH_IN, 1.2 + 0.2 * n)
    left, right = figure.subplots(1, 2, sharey=True)
    for place, one in enumerate(judgements):
        colour = VERMILLION if one.too_low else BLUE if one.p_value_holm is not None else GREY
        left.plot([one.coverage_low, one.coverage_high], [place, place], color=colour)
        left.plot(one.coverage, place, "o", color=colour, markersize=4.0)
        right.plot([one.tests_5, one.tests_95], [place, place], color=GREY)
        right.plot(one.tests_median, place, "o", color=INK, markersize=4.0)
    left.axvline(confidence, color=INK, linewidth=0.8)
    left.set_title("Coverage, 95 % interval")
    right.set_title("Tests: median, 5 to 95 %")
    right.set_xscale("log")
    left.set_yticks(np.arange(n), [f"{one.subject}: {one.result}" for one in judgements])
    left.set_ylim(n - 0.5, -0.5)
    low = sum(one.too_low for one in judgements)
    caption = f"{low} of {n} coverages are significantly below {confidence:g}; grey ones are not judged."
    return Plot("coverage", figure, f"Coverage and tests of {n} results. {caption}", caption)
