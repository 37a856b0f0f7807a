"""exp, log, log1p and expm1 of arrays, by the C library: numpy's own have other last digits on CPUs with AVX-512.

Whatever decides which tests are driven, and how, is computed by these, so that bits are the same on all processors.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from harness.compiled import compiled
from harness.vocabulary import FloatArray


@compiled
def _apply(which: int, values: FloatArray) -> None:
    for i in range(values.size):
        x = values[i]
        if which == 0:
            values[i] = math.exp(x)
        elif which == 1:
            values[i] = math.log(x) if x != 0.0 else -math.inf
        else:
            values[i] = math.log1p(x) if which == 2 else math.expm1(x)


def _of(which: int, x: ArrayLike) -> FloatArray:
    values = np.array(x, np.float64)
    _apply(which, values.reshape(-1))
    return values


exp, log, log1p, expm1 = (partial(_of, which) for which in range(4))
"""Elementwise; log is minus infinity at 0, and NaN below."""
