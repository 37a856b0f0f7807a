"""Columns of the sparse control variates: products of q_j/q_alpha over the first control steps of an episode.

[paper] section VI-D, Algorithm 1: an episode with control steps c_1 … c_l gets the columns
vec(Π_t q_{j_t}(a_t|s_t)/q_alpha(a_t|s_t)). Algorithm 1 lets every j_t run over 1 … J-1 (``reduced``); section IV-A
defines the SCV with j_t = 1 … J (``full``). The full basis spans more: since Σ_j alpha_j q_j/q_alpha = 1, it contains
the products over every subset of the steps, the reduced one only those over all of them.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from harness.arrays import FloatArray
from harness.estimators.block import MAX_CONTROL_STEPS

Basis = Literal["reduced", "full"]
MAX_COLUMNS = 729
"""Most columns of one stratum. The reduced basis of J = 3 reaches 2^9 = 512; the full one 3^6 = 729 at six steps."""


def n_functions(n_surrogates: int, basis: Basis) -> int:
    """How many importance functions each j_t runs over."""
    return n_surrogates if basis == "full" else n_surrogates - 1


def steps_used(n_control_steps: int, n_surrogates: int, basis: Basis) -> int:
    """Control steps that the columns of stratum l are built from.

    All up to nine ([paper] section VI-E), fewer where the products would exceed `MAX_COLUMNS`.
    """
    base = n_functions(n_surrogates, basis)
    steps = min(n_control_steps, MAX_CONTROL_STEPS)
    while steps > 0 and base > 1 and base**steps > MAX_COLUMNS:
        steps -= 1
    return steps


def n_columns(n_control_steps: int, n_surrogates: int, basis: Basis) -> int:
    """Columns of stratum l: base^steps, and none where nothing was controlled."""
    base = n_functions(n_surrogates, basis)
    steps = steps_used(n_control_steps, n_surrogates, basis)
    return 0 if steps == 0 or base == 0 else int(math.pow(base, steps))


def product_columns(first_ratios: FloatArray, n_control_steps: int, basis: Basis) -> FloatArray:
    """Columns of episodes of one stratum, not yet centred.

    Parameters
    ----------
    first_ratios : (m, 9, J) float64
        q_j/q_alpha per control step.
    n_control_steps : int
        Stratum l of all m episodes.
    basis : {"reduced", "full"}
        Which q_j the products run over.

    Returns
    -------
    (m, d) float64
        In Fortran order; the last step's j runs fastest.
    """
    n_rows, _, n_surrogates = first_ratios.shape
    columns = np.empty((n_rows, n_columns(n_control_steps, n_surrogates, basis)), order="F")
    fill_product_columns(first_ratios, n_control_steps, basis, columns)
    return columns


def fill_product_columns(first_ratios: FloatArray, n_control_steps: int, basis: Basis, out: FloatArray) -> None:
    """Write the columns of `product_columns` to ``out`` (m, d), which must be in Fortran order."""
    if not out.flags.f_contiguous:
        raise ValueError("columns are written in Fortran order")
    n_rows, _, n_surrogates = first_ratios.shape
    if out.shape[1] == 0:
        return
    used = first_ratios[:, : steps_used(n_control_steps, n_surrogates, basis), : n_functions(n_surrogates, basis)]
    by_step = np.ascontiguousarray(np.moveaxis(used, 0, 2))
    products: FloatArray = np.ones((1, n_rows))
    for ratios in by_step[:-1]:
        products = (products[:, None, :] * ratios[None, :, :]).reshape(-1, n_rows)
    np.multiply(products[:, None, :], by_step[-1][None, :, :], out=out.T.reshape(len(products), -1, n_rows))
