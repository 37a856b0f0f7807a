"""Axes that show small probabilities and large counts: a common power of ten in the label, or decades as 10⁻⁷."""

from __future__ import annotations

import math

from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from harness.report.number_format import exponent_of, plain, power_of_ten

FEW_DECADES = 1.7


def decades(axis: Axis, low: float, high: float) -> None:
    """Label a logarithmic axis from ``low`` to ``high`` by powers of ten; also by 2 and 5 where it spans few."""
    few = math.log10(high / low) < FEW_DECADES
    axis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=9))
    axis.set_minor_locator(LogLocator(base=10.0, subs=tuple(range(2, 10)), numticks=99 if few else 9))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(FuncFormatter(lambda value, _: tick_label(value)))


def tick_label(value: float) -> str:
    """Plain digits from 0.01 to 9999, else ``10⁻⁷`` or ``2·10⁻⁷``."""
    if value <= 0.0:
        return ""
    if 0.0099 < value < 9_999.5:
        return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"
    # log10 of a tick such as 1e-7 may come out just below -7.
    exponent = math.floor(math.log10(value) + 1e-9)
    mantissa = f"{value / 10.0**exponent:.3g}"
    return power_of_ten(exponent) if mantissa == "1" else f"{mantissa}·{power_of_ten(exponent)}"


def scaled(axis: Axis, largest: float) -> str:
    """Label a linear axis in units of a power of ten; returns the text to append to the axis label."""
    exponent = exponent_of(largest)
    factor = 10.0**exponent
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain(float(f"{value / factor:.6g}"))))
    return f", × {power_of_ten(exponent)}" if exponent else ""
