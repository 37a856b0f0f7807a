"""Numbers of a pool: strata of known probability, and surrogates of known crash rate.

Estimators and the planner of a campaign use these, and need nothing else of a pool.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, FiniteFloat, PlainSerializer, PlainValidator, TypeAdapter

from harness.vocabulary import BoolArray, FloatArray, IntArray

OUTSIDE = "outside"
"""Name of the stratum of everything beyond the boundary."""
ASSUMPTION_FREE, LIBRARY_STATEMENT = "assumption_free", "library"
"""Statements: the rate without an assumption, or that of a vehicle that crashes only inside the boundary."""
FAILED_BASELINE = "failed shadow runs"
"""Name of a stratum that cannot be tested: events on paths on which the vehicle failed before one could come."""


_FLOATS = TypeAdapter(list[FiniteFloat])
Numbers = Annotated[
    FloatArray,
    PlainValidator(lambda content: np.array(_FLOATS.validate_python(content, strict=True))),
    PlainSerializer(lambda array: array.tolist()),
]
"""An array that a JSON file holds as a list of numbers."""


def weight_of_a_test(p: FloatArray, tests: IntArray) -> FloatArray:
    """Weight of a test in the rate by its stratum, p_s/n_s, shape (S,).

    A stratum without a test counts as one with a single test, which has not crashed.
    """
    return np.asarray(p / np.maximum(tests, 1))


@dataclass(frozen=True)
class Reference:
    """A driver that the vehicle is compared with: its name, the driver in plain words, and when it acts.

    ``delay_s`` is the time (s) after the event at which it begins to brake, None if it has no delay of its own, or if
    events take time, and it sees them come.
    """

    name: str
    described: str
    delay_s: float | None = None


@dataclass(frozen=True)
class Assumed:
    """A number of the traffic that data leave open, of close cut-ins, and how it moves the probabilities of strata.

    Either the ``share`` of drivers who do not look, stated up to ``highest``; or the rate of lane changes at times to
    collision ``where`` none was seen. ``times`` (2, S) are factors of the probabilities at the two ends of what it may
    be, and ``reference_times`` of the first reference driver's rate; None where no strata are known.
    """

    where: str = ""
    highest: float | None = None
    times: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    share: float | None = None
    reference_times: tuple[float, float] | None = None

    @property
    def at_most(self) -> float:
        """Factor of the rate of a vehicle that crashes on events of drivers who do not look, and on no others."""
        return (self.highest or 0.0) / (self.share or 1.0)


@dataclass(frozen=True, eq=False)
class ShellDesign:
    """Strata (S,) of a campaign, the most conservative first, by the key of the ``pool`` and its ``n_paths``.

    ``strata`` are named by the surrogate that is the first to crash in each; the last is everything outside. Cells (C,)
    divide them by what the reference drivers (R,) do: ``cell_stratum``, one bit in ``cell_references`` for each that
    crashes, and ``cell_p``, the probability per test that an event of the cell happens. ``reference_rate`` are crash
    rates in the pool, ``reference_square`` the mean squares of a path's probability that they crash.

    ``boundary`` is the most aggressive surrogate inside the library's boundary, up to which ``n_inside`` strata are
    shells; ``assumes`` ends the sentence that begins with "If this vehicle". ``p_event`` is the probability of an
    event, with its standard error ``p_event_se``, ``p_unreachable`` the part of it on which no vehicle within the
    envelope's acceleration can crash, and which is not tested. ``available`` are events that the pool has kept of each
    stratum; empty if that is no limit.

    With ``shadow_runs`` the paths are the few that the vehicle has walked itself, chosen from so many ``candidates``
    (else 0). Events on the road are counted ahead of drivers who do not provoke them: ``p_held``, with its standard
    error ``p_held_se``, is the probability of one ahead of an AV that holds its speed, where that is not ``p_event``.
    """

    pool: str
    strata: tuple[str, ...]
    cell_stratum: tuple[int, ...]
    cell_p: Numbers
    n_paths: int
    boundary: str
    assumes: str
    n_inside: int
    p_event: float
    p_unreachable: float
    p_event_se: float = 0.0
    cell_references: tuple[int, ...] = ()
    references: tuple[Reference, ...] = ()
    reference_rate: Numbers = field(default_factory=lambda: np.zeros(0))
    reference_square: Numbers = field(default_factory=lambda: np.zeros(0))
    available: tuple[int, ...] = ()
    shadow_runs: bool = False
    candidates: int = 0
    p_held: float | None = None
    p_held_se: float = 0.0

    @cached_property
    def p(self) -> FloatArray:
        """Probability per test that an event of each stratum happens, shape (S,)."""
        return np.asarray(np.bincount(self.cell_stratum, self.cell_p, minlength=len(self.strata)), np.float64)

    @property
    def p_counted(self) -> float:
        """Probability of an event as events per hour are counted."""
        return self.p_event if self.p_held is None else self.p_held

    @property
    def p_event_error(self) -> float:
        """Relative standard error of ``p_counted``."""
        return (self.p_event_se if self.p_held is None else self.p_held_se) / self.p_counted

    def n_within(self, statement: str) -> int:
        """Strata that are asked about: those inside the boundary, or all."""
        return self.n_inside if statement == LIBRARY_STATEMENT else len(self.strata)

    def crashes_too(self, r: int) -> BoolArray:
        """In which cells a reference crashes, shape (C,)."""
        return np.asarray((np.array(self.cell_references) >> r) & 1, np.bool_)

    def reference_error(self, r: int) -> float:
        """Standard error of a reference's crash rate."""
        rate, square = float(self.reference_rate[r]), float(self.reference_square[r])
        return math.sqrt(max(square - rate * rate, 0.0) / self.n_independent)

    @property
    def readings(self) -> list[str]:
        """The first reference driver, and other readings of it: references that are named after that one."""
        names = [each.name for each in self.references]
        return [name for name in names if name == names[0] or name.startswith(f"{names[0]}-")]

    @property
    def n_independent(self) -> float:
        """Paths that would err as the pool's do; fewer where they were chosen from a finite number, which errs too."""
        return self.n_paths / (1.0 + self.n_paths / self.candidates) if self.candidates else self.n_paths

    def without_references(self) -> ShellDesign:
        """The same strata, each one cell."""
        n, none = len(self.strata), np.zeros(0)
        one_each = replace(self, cell_stratum=tuple(range(n)), cell_references=(0,) * n, cell_p=self.p)
        return replace(one_each, references=(), reference_rate=none, reference_square=none)

    @cached_property
    def joined(self) -> FloatArray:
        """1 where a cell belongs to a stratum, shape (C, S)."""
        return np.asarray(np.eye(len(self.strata))[list(self.cell_stratum)])


def _of_one_size(design: ShellDesign) -> ShellDesign:
    n, r, strata = len(design.cell_stratum), len(design.references), set(range(len(design.strata)))
    if not design.cell_p.size == len(design.cell_references) == n or set(design.cell_stratum) != strata:
        raise ValueError("cells need a stratum, a probability and references each, and strata a cell")
    if not design.reference_rate.size == design.reference_square.size == r:
        raise ValueError("references need a rate and a mean square each")
    if not 0 <= design.n_inside <= len(design.strata):
        raise ValueError("the boundary lies among the strata")
    return design


StoredDesign = Annotated[ShellDesign, AfterValidator(_of_one_size)]
"""``shells.json`` of a run."""
STORED_DESIGN = TypeAdapter(StoredDesign)
