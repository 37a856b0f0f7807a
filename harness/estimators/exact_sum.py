"""Sums of floating-point numbers without rounding, so that the order of addition cannot matter.

Every finite double is an integer times 2^-1127 (53 bits of significand, lowest exponent -1074). `ExactSum` adds these
integers, grouped by exponent, in 64-bit counters: addition is then associative and commutative to the last bit, and
one worker or many, in whatever order, arrive at the same number.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from harness.arrays import FloatArray, IntArray

_SIGNIFICAND_BITS = 53
_LOW_BITS = 26
_LOWEST_EXPONENT = -1074
_N_EXPONENTS = 1024 - _LOWEST_EXPONENT + 1
_UNIT = 1 << (_SIGNIFICAND_BITS - _LOWEST_EXPONENT)
_SPLITTER = float((1 << 27) + 1)
_MAX_ROWS = 1 << 20
"""Rows per pass: 27-bit halves of 2^20 numbers stay below 2^53, where bincount's own sums are exact."""


class ExactSum:
    """The exact sum of up to 2^36 doubles; infinities and NaN are carried apart and decide the value."""

    def __init__(self) -> None:
        self._high: IntArray = np.zeros(_N_EXPONENTS, dtype=np.int64)
        self._low: IntArray = np.zeros(_N_EXPONENTS, dtype=np.int64)
        self._not_finite = 0.0

    def add(self, values: FloatArray) -> None:
        """Add all entries of a one-dimensional array."""
        for start in range(0, len(values), _MAX_ROWS):
            self._add_some(values[start : start + _MAX_ROWS])

    def _add_some(self, values: FloatArray) -> None:
        finite = np.isfinite(values)
        if not finite.all():
            with np.errstate(invalid="ignore"):
                self._not_finite += float(np.sum(values[~finite]))
            values = values[finite]
        significand, exponent = np.frexp(values)
        whole = (significand * float(1 << _SIGNIFICAND_BITS)).astype(np.int64)
        low = whole & ((1 << _LOW_BITS) - 1)
        place = exponent - _LOWEST_EXPONENT
        self._high += np.bincount(place, weights=whole >> _LOW_BITS, minlength=_N_EXPONENTS).astype(np.int64)
        self._low += np.bincount(place, weights=low, minlength=_N_EXPONENTS).astype(np.int64)

    def merge(self, other: ExactSum) -> None:
        """Add the sum of other numbers."""
        self._high += other._high
        self._low += other._low
        self._not_finite += other._not_finite

    def fraction(self) -> Fraction:
        """Sum of the finite numbers, without rounding."""
        total = 0
        for place in np.flatnonzero(self._high | self._low).tolist():
            total += ((int(self._high[place]) << _LOW_BITS) + int(self._low[place])) << place
        return Fraction(total, _UNIT)

    def value(self) -> float:
        """Sum, rounded once; infinite or NaN if an addend was."""
        if self._not_finite != 0.0:
            return self._not_finite
        return float(self.fraction())


class MomentSums:
    """Exact sums of x and x², enough for a mean and its standard error.

    Attributes
    ----------
    total, squares : ExactSum
        Σx and Σx². Squares enter with their rounding errors, so that equal numbers have variance 0 exactly.
    """

    def __init__(self) -> None:
        self.total = ExactSum()
        self.squares = ExactSum()

    def add(self, values: FloatArray) -> None:
        """Add all entries of a one-dimensional array."""
        self.total.add(values)
        squares, errors = _exact_squares(values)
        self.squares.add(squares)
        self.squares.add(errors)

    def merge(self, other: MomentSums) -> None:
        """Add the sums over other numbers."""
        self.total.merge(other.total)
        self.squares.merge(other.squares)

    def mean(self, n: int) -> float:
        """Σx/n."""
        return self.total.value() / n

    def variance(self, n: int) -> float:
        """Sample variance (Σx² - (Σx)²/n)/(n - 1), subtracted without rounding; infinite for n < 2."""
        if n < 2 or not (np.isfinite(self.total.value()) and np.isfinite(self.squares.value())):
            return float("inf")
        total = self.total.fraction()
        return max(0.0, float((self.squares.fraction() - total * total / n) / (n - 1)))

    def std_error(self, n: int) -> float:
        """Compute the standard error of the mean."""
        return float(np.sqrt(self.variance(n) / n))


class SkewedSums(MomentSums):
    """Exact sums of x and x², and of rounded x³: enough for the skewness of a mean too.

    Attributes
    ----------
    cubes : ExactSum
        Σx³, each cube rounded once; skewness needs no more.
    """

    def __init__(self) -> None:
        super().__init__()
        self.cubes = ExactSum()

    def add(self, values: FloatArray) -> None:
        """Add all entries of a one-dimensional array."""
        super().add(values)
        with np.errstate(over="ignore", under="ignore"):
            self.cubes.add(values * values * values)

    def merge(self, other: MomentSums) -> None:
        """Add the sums over other numbers."""
        super().merge(other)
        assert isinstance(other, SkewedSums)
        self.cubes.merge(other.cubes)

    def third_moment(self, n: int) -> float:
        """Third central moment of the mean, Σ(x - x̄)³/n³; 0 where a sum is not finite."""
        sums = (self.total.value(), self.squares.value(), self.cubes.value())
        if n < 1 or not np.isfinite(sums).all():
            return 0.0
        mean = self.total.fraction() / n
        central = self.cubes.fraction() - 3 * mean * self.squares.fraction() + 2 * n * mean**3
        return float(central / n**3)


def _exact_squares(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rounded squares and what rounding took from them (Dekker's product), each of the shape of `values`.

    The errors are exact unless they underflow, or the square overflows; they are 0 there.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        squares = values * values
        stretched = values * _SPLITTER
        high = stretched - (stretched - values)
        low = values - high
        errors = ((high * high - squares) + 2.0 * high * low) + low * low
    return squares, np.where(np.isfinite(errors), errors, 0.0)
