"""What a pool of cut-ins says in numbers: strata of known probability, and surrogates of known crash rate.

The pool makes both; estimators and the planner of a campaign use them, and need nothing else of a pool.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from harness.arrays import FloatArray

OUTSIDE = "outside"
"""Name of the stratum of everything beyond the boundary."""
FAILED_SHADOWS = "failed shadow runs"
"""Name of a stratum that cannot be tested: cut-ins on paths on which the vehicle failed before one could come."""


@dataclass(frozen=True, eq=False)
class ShellDesign:
    """Strata of a campaign, from careful to careless.

    Attributes
    ----------
    pool, n_paths : str, int
        Key of the pool, and its number of paths.
    strata : tuple of str
        The surrogate that is the first to crash in each; the last is everything outside.
    p : ndarray, shape (S,)
        Probability per test that a cut-in of the stratum happens.
    moments : ndarray, shape (S, S)
        Mean product of a pool path's probabilities in two strata.
    n_inside, boundary : int, str
        Strata up to the boundary, which is the most careless surrogate inside.
    p_cut_in, p_impossible : float
        Probability of a cut-in, and the part of it on which no vehicle within the envelope's acceleration can crash,
        and which is not tested.
    available : tuple of int, length S
        Cut-ins that the pool has kept of each; empty if that is no limit.
    """

    pool: str
    strata: tuple[str, ...]
    p: FloatArray
    moments: FloatArray
    n_paths: int
    n_inside: int
    boundary: str
    p_cut_in: float
    p_impossible: float
    available: tuple[int, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain content for a file."""
        lists = {name: np.array(getattr(self, name)).tolist() for name in ("strata", "p", "moments", "available")}
        return asdict(self) | lists

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> ShellDesign:
        """Back from `to_json`."""
        arrays = {name: np.array(content[name], dtype=np.float64) for name in ("p", "moments")}
        tuples = {name: tuple(content[name]) for name in ("strata", "available")}
        return cls(**(content | arrays | tuples))


@dataclass(frozen=True, eq=False)
class KnownRates:
    """Crash rates of surrogates as a pool knows them.

    Attributes
    ----------
    pool : str
        Its key.
    names : tuple of str, length D
        Surrogates from careful to careless.
    mu, covariance : ndarray, shape (D,) and (D, D)
        Crash rates per test, and the covariance of their errors.
    """

    pool: str
    names: tuple[str, ...]
    mu: FloatArray
    covariance: FloatArray
