"""How numbers are written."""

from __future__ import annotations

import math

import pytest

from harness import numbers as n


@pytest.mark.parametrize(
    ("written", "text"),
    [
        (n.number(1.2345e-7), "1.23 × 10⁻⁷"),
        (n.number(0.0), "0"),
        (n.number(0.05), "0.0500"),
        (n.number(1234.5), "1,234"),
        (n.number(-2.5), "−2.50"),
        (n.number(None), "–"),
        (n.number(math.nan), "–"),
        (n.number(math.inf), "∞"),
        (n.number(1.2e-7, 2, exponent=-8), "12"),
        (n.number(1.2e-7, exponent=-7, like=4e-9), "1.2000"),
        (n.interval(9.67e-8, 1.11e-7), "(0.97 to 1.11) × 10⁻⁷"),
        (n.interval(9.67e-8, 1.11e-7, 1.04e-7), "1.04 (0.97 to 1.11) × 10⁻⁷"),
        (n.interval(None, 1.0), "– to 1.00"),
        (n.share(0.0), "0 %"),
        (n.share(0.0123), "1.2 %"),
        (n.share(1e-7), "1.0 × 10⁻⁵ %"),
        (n.share(1e-7, least=1e-3), "< 0.1 %"),
        (n.half_width(0.05), "0.0500"),
        (n.half_width(842.79), "> 10"),
        (n.half_width(None), "–"),
        (n.duration(12.34), "12.3 s"),
        (n.duration(200.0), "3 min 20 s"),
        (n.duration(3720.0), "1 h 02 min"),
        (n.size(999), "999 B"),
        (n.size(1_500_000), "1.5 MB"),
        (n.tenths(-10.71), "−10.7"),
        (n.words(1e-05), "1e-05"),
        (n.words([1.0, 2.5]), "1.0, 2.5"),
        (n.words([1.0, True, None], 4), "1.000, yes, –"),
    ],
)
def test_numbers_are_written_with_few_digits_and_never_more_than_there_are(written, text):
    assert written == text
