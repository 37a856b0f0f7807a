"""How numbers are written for people: few digits, common powers of ten, never more precision than there is."""

from __future__ import annotations

import math
from typing import Any

MISSING, MINUS = "–", "−"
WIDEST_RHW = 10.0
"""Relative half-widths above are not given as a number: next to nothing is known, and the digits would mean nothing."""
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LISTED, FAR_APART = 12, 100.0


def power_of_ten(exponent: int) -> str:
    """``10⁻⁷`` for -7."""
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def exponent_of(value: float) -> int:
    """Power of ten to factor out of a number: 0 where plain digits read better."""
    if value == 0.0 or not math.isfinite(value):
        return 0
    exponent = max(math.floor(math.log10(abs(value))), -323)  # 10.0**-324 is 0
    return exponent if exponent < -2 or exponent > 4 else 0


def number(value: float | None, digits: int = 3, *, exponent: int | None = None, like: float | None = None) -> str:
    """``1.23 × 10⁻⁷``: ``digits`` significant digits, by a power of ten where it is small or large.

    With an ``exponent`` the power of ten is that one and not written, since a column's head says it; with ``like``
    there are as many decimals as this other number needs.
    """
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else MINUS + "∞"
    # Rounded first, so that 9.999e-8 gets the power of ten of 1.00e-7.
    rounded = float(f"{value if like is None else like:.{digits - 1}e}")
    power = exponent_of(rounded) if exponent is None else exponent
    scaled = abs(rounded / 10.0**power)
    decimals = 0 if scaled == 0.0 else max(digits - 1 - math.floor(math.log10(scaled)), 0)
    text = f"{value / 10.0**power:,.{decimals}f}".replace("-", MINUS)
    return text if exponent is not None or power == 0 else f"{text} × {power_of_ten(power)}"


def interval(low: float | None, high: float | None, point: float | None = None, *, beside: float | None = None) -> str:
    """``(1.17 to 1.29) × 10⁻⁷``, or ``1.23 (1.17 to 1.29) × 10⁻⁷``: in one power of ten.

    The power is that of the rate that stands ``beside`` it; ends that are far apart have one each.
    """
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        return f"{number(low)} to {number(high)}"
    like = point or max(abs(low), abs(high))
    if beside and like < FAR_APART * abs(beside):
        like = abs(beside)
    exponent = exponent_of(like)
    if exponent and 0.0 < abs(low) * FAR_APART <= abs(high):
        ends = f"{number(low)} to {number(high)}"
        return ends if point is None else f"{number(point)} ({ends})"
    ends = " to ".join(number(end, exponent=exponent, like=max(like, abs(end))) for end in (low, high))
    if point is not None:
        ends = f"{number(point, exponent=exponent)} ({ends})"
    elif exponent:
        ends = f"({ends})"
    return f"{ends} × {power_of_ten(exponent)}" if exponent else ends


def share(value: float | None, *, least: float = 0.0) -> str:
    """A share as per cent: ``90 %``, ``1.2 %``; ``< 0.1 %`` where it is below ``least``, of which 0.001 is one."""
    if value is not None and 0.0 < value < least:
        return f"< {number(100.0 * least, 1)} %"
    return MISSING if value is None or math.isnan(value) else f"{number(100.0 * value, 2)} %"


def half_width(rhw: float | None) -> str:
    """A relative half-width, without digits where it only says that next to nothing is known."""
    return f"> {WIDEST_RHW:g}" if rhw is not None and rhw > WIDEST_RHW else number(rhw)


def ratio(value: float | None) -> str:
    """A ratio of rates: ``0.84``, ``1.16``, ``138``."""
    return number(value, 2 if value is not None and value < 1.0 else 3)


def count(value: float | None) -> str:
    """A whole number with thousands separators."""
    return MISSING if value is None or math.isnan(value) else f"{value:,.0f}"


def tests(n: int) -> str:
    """``1 test``, or ``2,000 tests``."""
    return f"{count(n)} test{'s' * (n != 1)}"


def tenths(value: float) -> str:
    """A measured quantity; a dash where it was not recorded."""
    return MISSING if math.isnan(value) else f"{value:,.1f}".replace("-", MINUS)


def plain(value: float | str) -> str:
    """A number that somebody has chosen, with all its digits, ``0.5``, ``2,000,000``, ``3 × 10⁻⁷``; a text as it is."""
    if isinstance(value, str):
        return value
    if 0.0 < abs(value) < 1e-4:
        digits, power = f"{value:.9e}".split("e")
        return f"{plain(float(digits))} × {power_of_ten(int(power))}"
    return f"{value:,.10g}".replace("-", MINUS)


def two_digits_up(value: float) -> int:
    """The next number of two digits and zeros that is no smaller."""
    unit = 10.0 ** max(math.floor(math.log10(max(value, 1.0))) - 1, 0)
    return round(math.ceil(value / unit - 1e-9) * unit)


def duration(seconds: float | None) -> str:
    """``1 h 02 min``, ``3 min 20 s`` or ``12.3 s``."""
    if seconds is None:
        return MISSING
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    if seconds < 3600.0:
        return f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"
    return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:02.0f} min"


def leaves(content: Any, path: str = "") -> list[tuple[str, Any]]:
    """Leaves of nested mappings as (dotted path, value), in order; none of an empty one."""
    if isinstance(content, dict) and (content or not path):
        return [leaf for key, part in content.items() for leaf in leaves(part, f"{path}.{key}" if path else str(key))]
    return [(path, content)]


def words(content: Any, digits: int | None = None) -> str:
    """Anything from a YAML or JSON file: numbers with every digit, to be typed again, or rounded to ``digits``."""
    if content is None:
        return MISSING
    if isinstance(content, bool):
        return "yes" if content else "no"
    if isinstance(content, float) and digits is not None:
        return number(content, digits)
    if isinstance(content, int):
        return str(content) if digits is None and abs(content) < 10_000 else f"{content:,}"
    if isinstance(content, list):
        items = ", ".join(words(item, digits) for item in content[:_LISTED])
        return f"{items}, … ({len(content)} values)" if len(content) > _LISTED else items
    return str(content)
