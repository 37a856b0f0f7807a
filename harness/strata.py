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


@dataclass(frozen=True, eq=False)
class ShellDesign:
    """Strata of a campaign, from careful to careless.

    Attributes
    ----------
    pool : str
        Key of the pool.
    strata : tuple of str
        The surrogate that is the first to crash in each; the last is everything outside.
    p : ndarray, shape (S,)
        Probability per test that a cut-in of the stratum happens.
    moments : ndarray, shape (S, S)
        Mean product of a pool path's probabilities in two strata.
    n_paths : int
        Paths of the pool.
    n_inside : int
        Strata up to the boundary.
    boundary : str
        The most careless surrogate inside.
    p_cut_in : float
        Probability of a cut-in.
    p_impossible : float
        Part of it on which no vehicle within the envelope's acceleration can crash, and which is not tested.
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
        content = asdict(self)
        return {
            **content,
            "strata": list(self.strata),
            "p": self.p.tolist(),
            "moments": self.moments.tolist(),
            "available": list(self.available),
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> ShellDesign:
        """Back from `to_json`."""
        arrays = {name: np.array(content[name], dtype=np.float64) for name in ("p", "moments")}
        return cls(
            **{**content, **arrays, "strata": tuple(content["strata"]), "available": tuple(content["available"])}
        )


@dataclass(frozen=True, eq=False)
class KnownRates:
    """Crash rates of surrogates as a pool knows them.

    Attributes
    ----------
    pool : str
        Its key.
    names : tuple of str, length D
        Surrogates from careful to careless.
    mu : ndarray, shape (D,)
        Crash rates per test.
    covariance : ndarray, shape (D, D)
        Of their errors.
    """

    pool: str
    names: tuple[str, ...]
    mu: FloatArray
    covariance: FloatArray
