"""How numbers are written in the report: few digits, common powers of ten, never more precision than there is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from harness.estimators.estimate import WIDEST_RHW

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MISSING = "–"
MINUS = "−"


def power_of_ten(exponent: int) -> str:
    """``10⁻⁷`` for -7."""
    return "10" + str(exponent).translate(SUPERSCRIPTS)


def exponent_of(value: float) -> int:
    """Power of ten to factor out of a number: 0 where plain digits read better."""
    if value == 0.0 or not math.isfinite(value):
        return 0
    exponent = math.floor(math.log10(abs(value)))
    return exponent if exponent < -2 or exponent > 4 else 0


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with ``digits`` significant digits, as ``1.23 × 10⁻⁷`` where it is small or large."""
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else MINUS + "∞"
    exponent = exponent_of(rounded(value, digits))
    mantissa = significant(value / 10.0**exponent, digits)
    return mantissa if exponent == 0 else f"{mantissa} × {power_of_ten(exponent)}"


def significant(value: float, digits: int = 3) -> str:
    """Plain digits with ``digits`` significant ones, trailing zeros kept, whole numbers not cut."""
    return fixed(value, 0, rounded(value, digits), digits)


def rounded(value: float, digits: int) -> float:
    """Round to significant digits first, so that 9.999e-8 gets the power of ten of 1.00e-7."""
    return float(f"{value:.{digits - 1}e}")


def interval(low: float | None, high: float | None, digits: int = 3) -> str:
    """``(1.17 to 1.29) × 10⁻⁷``: both ends with the same power of ten and the same decimals."""
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        return f"{number(low, digits)} to {number(high, digits)}"
    exponent = exponent_of(max(abs(low), abs(high)))
    ends = f"{fixed(low, exponent, high, digits)} to {fixed(high, exponent, high, digits)}"
    return ends if exponent == 0 else f"({ends}) × {power_of_ten(exponent)}"


def with_interval(rate: float, low: float, high: float, digits: int = 3) -> str:
    """``1.23 (1.17 to 1.29) × 10⁻⁷``: a rate and its interval in one power of ten."""
    exponent = exponent_of(rate)
    point, left, right = (fixed(value, exponent, rate, digits) for value in (rate, low, high))
    text = f"{point} ({left} to {right})"
    return text if exponent == 0 else f"{text} × {power_of_ten(exponent)}"


def fixed(value: float | None, exponent: int, reference: float, digits: int = 3) -> str:
    """``value`` in units of 10^exponent, with as many decimals as ``reference`` needs for ``digits`` digits."""
    if value is None or not math.isfinite(value):
        return number(value)
    scaled = reference / 10.0**exponent
    decimals = 0 if scaled == 0.0 else max(digits - 1 - math.floor(math.log10(abs(scaled))), 0)
    return f"{value / 10.0**exponent:,.{decimals}f}".replace("-", MINUS)


def decimal(value: float) -> str:
    """Write a measured quantity to a tenth; a dash when it was not recorded."""
    return MISSING if math.isnan(value) else f"{value:,.1f}".replace("-", MINUS)


def plain(value: float) -> str:
    """Write a number as somebody would type it, with thousands separators: ``0.5``, ``100``, ``2,000,000``."""
    return f"{value:,.10g}".replace("-", MINUS)


def count(value: float | None) -> str:
    """Write a whole number with thousands separators."""
    return MISSING if value is None or math.isnan(value) else f"{value:,.0f}"


def percent(value: float | None) -> str:
    """Write a share as per cent with two or three significant digits."""
    if value is None or math.isnan(value):
        return MISSING
    shown = 100.0 * value
    if shown == 0.0 or shown >= 99.95:
        return f"{shown:.0f} %"
    return f"{significant(shown, 2)} %" if shown >= 0.01 else f"{number(shown, 2)} %"


def half_width(rhw: float | None) -> str:
    """Write a relative half-width, without digits where it only says that next to nothing is known."""
    return f"> {WIDEST_RHW:g}" if rhw is not None and rhw > WIDEST_RHW else number(rhw)


def coarse_percent(value: float) -> str:
    """Write a share of something that only matters where it is large: ``90 %``, ``1.2 %``, ``< 0.1 %``."""
    return "< 0.1 %" if 0.0 < value < 1e-3 else percent(value)


def duration(seconds: float | None) -> str:
    """Wall-clock time as ``1 h 02 min``, ``3 min 20 s`` or ``12.3 s``."""
    if seconds is None:
        return MISSING
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    if seconds < 3600.0:
        return f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"
    return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:02.0f} min"


def size(n_bytes: float) -> str:
    """Bytes as ``1.2 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if n_bytes < 1000.0 or unit == "GB":
            break
        n_bytes /= 1000.0
    return f"{n_bytes:.0f} {unit}" if unit == "B" else f"{significant(n_bytes, 2)} {unit}"


def value(content: Any) -> str:
    """Anything from a YAML or JSON file, written plainly; every digit of a number, so that it can be typed again."""
    if content is None:
        return MISSING
    if isinstance(content, bool):
        return "yes" if content else "no"
    if isinstance(content, int):
        return f"{content:,}" if abs(content) >= 10_000 else str(content)
    return _listed(content, value) if isinstance(content, list) else str(content)


def result(content: Any) -> str:
    """Write a computed value: numbers rounded to four digits, everything else as `value` writes it."""
    if isinstance(content, list):
        return _listed(content, result)
    if isinstance(content, float):
        return number(content, 4)
    return count(content) if isinstance(content, int) and not isinstance(content, bool) else value(content)


def _listed(items: list[Any], written: Callable[[Any], str]) -> str:
    shown = ", ".join(map(written, items[:12]))
    return f"{shown}, … ({len(items)} values)" if len(items) > 12 else shown


def sentence(text: str) -> str:
    """Write a phrase as a sentence: capital first, full stop last."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text[-1:] in ".!?" else ".")


def signed_percent(share: float) -> str:
    """Write a relative difference with its sign: ``+1.2 %``."""
    return f"{100.0 * share:+.1f} %".replace("-", MINUS)
