"""Algorithm 1 once more, from the paper alone: explicit columns, explicit centring, numpy's least squares."""

from __future__ import annotations

import itertools

import numpy as np

from harness.arrays import FloatArray
from harness.estimators.block import Block


def algorithm_1(blocks: list[Block], functions: int) -> tuple[float, float, dict[int, tuple[int, int, int]]]:
    """Estimate, var(Z) and per stratum (n, columns, rank); j_t runs over the first `functions` importance functions."""
    y = np.concatenate([block.weighted_crashes() for block in blocks])
    ratios = np.concatenate([block.first_ratios for block in blocks])
    level = np.concatenate([block.n_control_steps for block in blocks])
    n, estimate, z, strata = len(y), 0.0, [], {}
    for l in np.unique(level):  # noqa: E741 - the paper's letter
        rows = level == l
        columns = _columns(ratios[rows], min(int(l), 9), functions)
        centred = columns - columns.mean(axis=0)
        x = np.column_stack([np.ones(rows.sum()), centred])
        coefficients = np.linalg.lstsq(x, y[rows], rcond=None)[0]
        estimate += rows.sum() * coefficients[0] / n
        z.append(y[rows] - centred @ coefficients[1:])
        rank = int(np.linalg.matrix_rank(centred)) if centred.shape[1] else 0
        strata[int(l)] = (int(rows.sum()), centred.shape[1], rank)
    return estimate, float(np.var(np.concatenate(z), ddof=1)), strata


def _columns(ratios: FloatArray, steps: int, functions: int) -> FloatArray:
    if steps == 0:
        return np.empty((len(ratios), 0))
    choices = itertools.product(range(functions), repeat=steps)
    return np.column_stack([ratios[:, range(steps), js].prod(axis=1) for js in choices])
