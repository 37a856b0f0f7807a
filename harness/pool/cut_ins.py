"""What a pool is: shells with their probabilities, surrogates with their crash rates, and cut-ins to test with."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from harness.pool.library import Library
from harness.pool.walk import PILOT_PATHS
from harness.traffic.laws import Environment
from harness.vocabulary import BoolArray, Float32Array, FloatArray, Int8Array, IntArray, RecordArray, UInt64Array

FAR_OFF = 10.0
"""A surrogate whose rate varies this much more from path to path than the boundary's (relvar) crashes in traffic of its
own, which few paths meet: paths aimed there would be lost for all others."""


def onset_steps(step: IntArray, lead: IntArray) -> IntArray:
    """Steps of the onset of cut-ins in given steps (n,), with a ``lead`` (n,)."""
    onset: IntArray = np.maximum(step - lead, 0)
    return onset


@dataclass(frozen=True, eq=False)
class CutIns:
    """A weighted sample of cut-ins, each with the paths of LV and BV before and after it.

    Within a shell all have the same probability. ``path``, ``step``, ``cell`` (n,): which path of the pool, cut-in
    step, and cell; ``state`` (n,): initial states. ``lv``, ``bv`` (n, draws): maneuver indices as an episode records
    them, 31 marking the cut-in; ``n_lv``, ``n_bv`` (n,): how many of them are used. ``crashes`` (n, D + R): which
    surrogates crash, in the pool's order, and which references. ``path_mass`` (n, C) float32: the path's probability of
    a cut-in of each cell. ``motion`` (n,) are hashes of what the AV did through the step of the cut-in,
    in the pool of a vehicle that acts before it, or of its onset; else empty. ``lead`` (n,) is how many steps earlier
    that is: 0 where cut-ins are one step.
    """

    path: IntArray
    step: IntArray
    cell: IntArray
    state: RecordArray
    lv: Int8Array
    bv: Int8Array
    n_lv: IntArray
    n_bv: IntArray
    crashes: BoolArray
    path_mass: Float32Array
    lead: IntArray
    motion: UInt64Array = field(default_factory=lambda: np.zeros(0, np.uint64))

    @property
    def onset(self) -> IntArray:
        """Step of the onset of each, shape (n,)."""
        return onset_steps(self.step, self.lead)

    @property
    def row(self) -> IntArray:
        """Which row of the pool's paths each is of, shape (n,): in the pool of a vehicle its shadow run."""
        rows: IntArray = self.path - PILOT_PATHS
        return rows


@dataclass(frozen=True, eq=False)
class Pool:
    """Pool of one environment and one library.

    Attributes
    ----------
    key : str
        Content hash of all that it was made from; ``environment`` is that of its environment.
    names : tuple of str, length D
        Surrogates from careful to careless, by crash rate.
    n_paths : int
        Paths that the probabilities come from.
    p_cut_in, p_cut_in_se : float
        Probability that BV cuts in in a test, and its standard error.
    mu, mu_covariance : ndarray, shapes (D,) and (D, D)
        Crash rates of the surrogates, per test, and the covariance of their errors.
    p_cut_in_at_crash : ndarray, shape (D,)
        Mean P(cut-in | path) of the cut-ins on which each surrogate crashes, and three standard errors on top.
    cell_shell, cell_references : ndarray of int64, shape (C,)
        Cells divide shells by which references crash: the shell of each, and one bit per reference.
    cell_p : ndarray, shape (C,)
        Probability of each cell.
    reference_rate, reference_square : ndarray, shape (R,)
        Crash rates of the references, and mean squares of a path's probability that they crash.
    p_unknown : float
        Probability of cut-ins about which nothing is known, at most: of shadow runs that failed.
    """

    key: str
    environment: str
    library: Library
    names: tuple[str, ...]
    n_paths: int
    p_cut_in: float
    p_cut_in_se: float
    mu: FloatArray
    mu_covariance: FloatArray
    p_cut_in_at_crash: FloatArray
    cell_shell: IntArray
    cell_references: IntArray
    cell_p: FloatArray
    reference_rate: FloatArray
    reference_square: FloatArray
    cut_ins: CutIns
    p_unknown: float = 0.0

    @cached_property
    def shell_p(self) -> FloatArray:
        """Probability of each shell, shape (D + 1,); the last is a cut-in on which no surrogate crashes."""
        return np.asarray(np.bincount(self.cell_shell, self.cell_p, minlength=len(self.names) + 1), np.float64)

    @cached_property
    def shell(self) -> IntArray:
        """Shell of each kept cut-in, shape (n,)."""
        found: IntArray = self.cell_shell[self.cut_ins.cell]
        return found

    @property
    def boundary(self) -> int:
        """Index of the outermost shell that the statement library keeps."""
        return self.names.index(self.library.boundary)

    def to_json(self) -> dict[str, Any]:
        """What is known of surrogates and shells, as plain content."""
        p = self.shell_p.tolist()
        error = np.sqrt(np.diag(self.mu_covariance))
        reference_error = np.sqrt(np.maximum(self.reference_square - self.reference_rate**2, 0.0) / self.n_paths)
        surrogates = zip(self.names, self.mu.tolist(), error.tolist(), p[:-1], strict=True)
        references = zip(self.library.references, self.reference_rate.tolist(), reference_error.tolist(), strict=True)
        keys = "name", "crash_rate", "std_error", "shell_probability"
        return {
            "pool": self.key,
            "n_paths": self.n_paths,
            "p_cut_in": self.p_cut_in,
            "p_cut_in_std_error": self.p_cut_in_se,
            "boundary": self.library.boundary,
            "envelope": self.library.envelope,
            "delays_after_cut_in_s": {} if self.cut_ins.lead.any() else self.library.delays_after_cut_in_s,
            "surrogates": [dict(zip(keys, row, strict=True)) for row in surrogates],
            "no_surrogate_crashes": p[-1],
            "references": [dict(zip(keys[:-1], row, strict=True)) for row in references],
        }


def environment_hash(environment: Environment) -> str:
    """Hash of all numbers of an environment, level of lane changing and hold time included."""
    numbers = {name: environment.numbers[name].item() for name in environment.numbers.dtype.names or ()}
    if (lateral := environment.lateral).present:
        numbers["lateral"] = [lateral.distance_m, lateral.cumulative.tolist()]
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()[:24]


def shells_of(crashes: IntArray, order: IntArray) -> Int8Array:
    """Shell of cut-ins: the place in the order of the first surrogate that crashes, D if none does.

    ``crashes``, of any shape, has one bit per surrogate; ``order`` (D,) are the bits from the most careful surrogate to
    the most careless.
    """
    shell = np.full(crashes.shape, len(order), np.int8)
    for place in reversed(range(len(order))):
        shell[(crashes >> order[place]) & 1 == 1] = place
    return shell
