"""What a pool and its shells are, the strata of a campaign that shells make up, and the tests drawn from them.

Surrogates are ordered by their crash rates, the most conservative first. An event belongs to the shell of the first of
them that crashes on it, or to the last shell if none does. Cells divide shells by which references crash.

Each shell up to the boundary is a stratum. All shells beyond it are one stratum, *outside*: there tests show that a
careful vehicle does not crash, and dividing a stratum without crashes only costs tests. The shell on which not even the
full-throttle envelope crashes is left out, with crash probability 0, if the vehicle cannot accelerate harder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from io import BytesIO
from typing import Any

import numpy as np
import pyarrow as pa

from harness import elementary
from harness.campaign.campaign import Campaign
from harness.campaign.drivers import BuiltInParameters
from harness.campaign.vehicle import AutomatedVehicle
from harness.families.protocol import Chosen
from harness.loop.cells import PrescribedEvents
from harness.loop.repeat import Traffic
from harness.pool.aim import PILOT_PATHS
from harness.resolved import Resolved
from harness.strata import FAILED_BASELINE, OUTSIDE, Reference, ShellDesign
from harness.vehicles.library import Library
from harness.vocabulary import BoolArray, Float32Array, FloatArray, Int8Array, IntArray, RecordArray, UInt64Array

FORMAT = 10
"""Raise it when the meaning of a pool changes."""
CANDIDATES = 32_768
"""Paths beside an AV that holds its speed, among which those of baseline runs are chosen: they cost milliseconds each,
and save two of three runs."""
_REFERENCES = {"r157-cc": "a careful and competent driver", "r157-fsm": "a driver by the fuzzy safety model"}
"""Drivers of UN Regulation No. 157 in plain words."""


def onset_steps(step: IntArray, lead: IntArray) -> IntArray:
    """Steps (n,) in which events begin that are done in ``step`` (n,), ``lead`` (n,) steps later."""
    return np.asarray(np.maximum(step - lead, 0))


@dataclass(frozen=True, eq=False)
class KeptEvents:
    """A weighted sample of events, each with what has to be known to repeat it.

    Within a shell all have the same weight. ``path``, ``step``, ``cell`` (n,): number of the path, place of the event
    on it, and its cell; ``facts``, ``at``, ``lead`` (n,): see `Chosen` of families. ``crashes`` (n, D + R): which
    surrogates crash, in the pool's order, and which references. ``path_mass`` (n, C) float32: the path's probability of
    an event of each cell. The pool of a vehicle that acts before the event has ``motion`` (n,), hashes of the vehicle's
    motion through the step of the event's onset, and ``mass`` (n,), the probability of the events that each stands for.
    """

    path: IntArray
    step: IntArray
    cell: IntArray
    facts: RecordArray
    at: IntArray
    lead: IntArray
    crashes: BoolArray
    path_mass: Float32Array
    motion: UInt64Array = field(default_factory=lambda: np.zeros(0, np.uint64))
    mass: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def acts(self) -> bool:
        """Whether they are of one vehicle, which acts before the event."""
        return self.motion.size > 0

    @property
    def onset(self) -> IntArray:
        """Step of the onset of each, shape (n,)."""
        return onset_steps(self.at, self.lead)

    @property
    def row(self) -> IntArray:
        """Row of its path among those of the pool, shape (n,): in the pool of a vehicle its baseline run."""
        return np.asarray(self.path - PILOT_PATHS)


@dataclass(frozen=True, eq=False)
class Pool:
    """Pool of one environment and one library.

    ``key`` is the hash of all that it was made from, ``family`` names the kind of its events, ``environment`` is the
    hash of its environment. ``names`` (D) are the surrogates, the most conservative first, ``mu`` (D,) their crash
    rates per test from ``n_paths`` paths, and ``mu_covariance`` (D, D) of their errors. ``p_event``, ``p_held`` and
    their standard errors, ``reference_rate`` and ``reference_square`` (R,) see `ShellDesign`. Cells divide shells by
    which references crash: ``cell_shell``, ``cell_references`` (C,) are the shell of each and one bit per reference,
    ``cell_p`` (C,) its probability. ``p_after_failure`` is the probability, at most, of events after a baseline run has
    failed, which are unknown.
    """

    key: str
    family: str
    environment: str
    library: Library
    names: tuple[str, ...]
    n_paths: int
    p_event: float
    p_event_se: float
    mu: FloatArray
    mu_covariance: FloatArray
    cell_shell: IntArray
    cell_references: IntArray
    cell_p: FloatArray
    reference_rate: FloatArray
    reference_square: FloatArray
    events: KeptEvents
    p_after_failure: float = 0.0
    p_held: float = math.nan
    p_held_se: float = 0.0

    @cached_property
    def shell_p(self) -> FloatArray:
        """Probability of each shell, shape (D + 1,); the last is an event on which no surrogate crashes."""
        return np.asarray(np.bincount(self.cell_shell, self.cell_p, minlength=len(self.names) + 1), np.float64)

    @cached_property
    def shell(self) -> IntArray:
        """Shell of each kept event, shape (n,)."""
        return np.asarray(self.cell_shell[self.events.cell])

    def to_json(self) -> dict[str, Any]:
        """What is known of surrogates and shells, as plain content."""
        p = self.shell_p.tolist()
        error = np.sqrt(np.diag(self.mu_covariance))
        reference_error = np.sqrt(np.maximum(self.reference_square - self.reference_rate**2, 0.0) / self.n_paths)
        surrogates = zip(self.names, self.mu.tolist(), error.tolist(), p[:-1], strict=True)
        references = zip(self.library.references, self.reference_rate.tolist(), reference_error.tolist(), strict=True)
        keys = "name", "crash_rate", "std_error", "shell_probability"
        return {
            "pool": self.key, "n_paths": self.n_paths, "p_event": self.p_event, "p_event_std_error": self.p_event_se,
            "boundary": self.library.boundary, "envelope": self.library.envelope,
            "surrogates": [dict(zip(keys, row, strict=True)) for row in surrogates],
            "no_surrogate_crashes": p[-1],
            "references": [dict(zip(keys[:-1], row, strict=True)) for row in references],
        }  # fmt: skip


def pool_content(pool: Pool) -> bytes:
    """A pool as the content of a file, without its library, which is part of the key."""
    columns = {each.name: getattr(pool, each.name) for each in fields(pool) if each.name not in ("library", "events")}
    np.savez(file := BytesIO(), **columns, **vars(pool.events))
    return bytes(pa.compress(file.getbuffer(), codec="zstd", asbytes=True))


def pool_from(content: bytes, library: Library) -> Pool:
    """The pool that `pool_content` has written, of a library."""
    packed = pa.input_stream(pa.BufferReader(content), compression="zstd")
    with np.load(BytesIO(packed.read())) as stored:
        arrays = {name: stored[name] for name in stored.files}
    events = KeptEvents(**{each.name: arrays.pop(each.name) for each in fields(KeptEvents)})
    names = tuple(arrays.pop("names").tolist())
    columns: dict[str, Any] = {name: array if array.ndim else array.item() for name, array in arrays.items()}
    return Pool(**columns, names=names, library=library, events=events)


def conservative_first(rates: FloatArray) -> IntArray:
    """Surrogates, as places in the library (D,), by their mean of the paths' rates (n, D + 1), the lowest first."""
    return np.asarray(np.argsort(rates[:, :-1].mean(0), kind="stable"))


def shells_of(crashes: IntArray, order: IntArray) -> Int8Array:
    """Shell of events: the place in the ``order`` (D,) of the first surrogate that crashes, D if none does.

    ``crashes``, of any shape, has one bit per surrogate, in the library's order.
    """
    shell = np.full(crashes.shape, len(order), np.int8)
    for place in reversed(range(len(order))):
        shell[(crashes >> order[place]) & 1 == 1] = place
    return shell


def cells_of(
    mass: FloatArray, shell: Int8Array, references: IntArray, n_references: int
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Divide events into cells, by their ``shell`` and the ``references`` that crash (one bit each).

    ``mass``, ``shell`` and ``references`` are (n, steps). Returns the cell of each event (n, steps), shell and
    references of each cell (C,), and each path's mass in it (n, C).
    """
    kind = (shell.astype(np.int64) << n_references) | references
    kinds = np.unique(kind[mass > 0.0])
    cell = np.minimum(np.searchsorted(kinds, kind), kinds.size - 1)  # an event without mass may have no cell
    flat = np.arange(len(mass))[:, None] * kinds.size + cell
    by_path: FloatArray = np.bincount(flat.ravel(), mass.ravel(), minlength=len(mass) * kinds.size).astype(np.float64)
    return cell, kinds >> n_references, kinds & ((1 << n_references) - 1), by_path.reshape(len(mass), kinds.size)


def acceleration_limit(av: AutomatedVehicle) -> float:
    """Hardest acceleration (m/s²) that an AV can reach; infinite if nothing in the harness limits it."""
    if isinstance(av.parameters, BuiltInParameters):
        return av.parameters.max_acceleration_mps2
    return math.inf if av.sumo is not None else av.limits.max_acceleration_mps2


def tested_limit(campaign: Campaign) -> float:
    """Hardest acceleration (m/s²) that a campaign's strata allow for."""
    return math.inf if campaign.testing.shells.beyond_envelope else acceleration_limit(campaign.av)


def shells_in_strata(pool: Pool, limit_mps2: float) -> list[list[int]]:
    """Shells of each stratum, for a vehicle with this limit of acceleration; shells without events in none."""
    boundary = boundary_shell(pool)
    present = [s for s in range(pool.shell_p.size) if pool.shell_p[s] > 0.0]
    tested = present if limit_mps2 > pool.library.envelope_mps2 else [s for s in present if s < len(pool.names)]
    inside = [[s] for s in tested if s <= boundary]
    outside = [s for s in tested if s > boundary]
    return [*inside, outside] if outside else inside


def strata_of_shells(pool: Pool, groups: list[list[int]]) -> IntArray:
    """In which stratum each shell is, shape (D + 1,); -1 for none."""
    stratum = np.full(pool.shell_p.size, -1, np.int64)
    for place, group in enumerate(groups):
        stratum[group] = place
    return stratum


def boundary_shell(pool: Pool) -> int:
    """Index of the shell up to which strata are shells: that of the library's boundary."""
    return pool.names.index(pool.library.boundary)


def design_shells(pool: Pool, limit_mps2: float) -> ShellDesign:
    """Strata of a campaign whose vehicle accelerates at most so hard (`acceleration_limit`)."""
    groups = shells_in_strata(pool, limit_mps2)
    boundary = pool.library.boundary
    cells, stratum, references = cells_in_strata(pool, groups)
    shows = bool(pool.events.lead.any())
    p = np.asarray(np.bincount(cells[cells >= 0], pool.cell_p[cells >= 0]), np.float64)
    design = ShellDesign(
        pool=pool.key,
        strata=tuple(OUTSIDE if s > boundary_shell(pool) else pool.names[s] for s, *_ in groups),
        cell_stratum=tuple(stratum.tolist()),
        cell_p=p,
        cell_references=tuple(references.tolist()),
        references=tuple(
            Reference(name, _REFERENCES.get(each.model, "the driver"), None if shows else each.delay_after_event_s)
            for name, each in pool.library.references.items()
        ),
        reference_rate=pool.reference_rate,
        reference_square=pool.reference_square,
        n_paths=pool.n_paths,
        boundary=boundary,
        assumes=pool.library.assumes or f"crashes only where the surrogate {boundary} or a more careful one crashes",
        n_inside=sum(group[-1] <= boundary_shell(pool) for group in groups),
        p_event=pool.p_event,
        p_event_se=pool.p_event_se,
        p_held=None if math.isnan(pool.p_held) else pool.p_held,
        p_held_se=pool.p_held_se,
        p_unreachable=max(pool.p_event - float(p.sum()), 0.0),
        shadow_runs=(acts := pool.events.acts),
        candidates=CANDIDATES if acts else 0,
    )
    if pool.p_after_failure == 0.0:
        return design
    return replace(  # one more stratum: as it has no test, it may crash as often as it happens
        design,
        strata=(*design.strata, FAILED_BASELINE),
        cell_stratum=(*design.cell_stratum, len(design.strata)),
        cell_p=np.append(design.cell_p, pool.p_after_failure),
        cell_references=(*design.cell_references, 0),
    )


def cells_in_strata(pool: Pool, groups: list[list[int]]) -> tuple[IntArray, IntArray, IntArray]:
    """Cell of a campaign that each cell of the pool belongs to, -1 for none, (C,); stratum and references of each."""
    stratum, n_references = strata_of_shells(pool, groups)[pool.cell_shell], len(pool.library.references)
    kind = np.where(stratum < 0, -1, (stratum << n_references) | pool.cell_references)
    kinds = np.unique(kind[kind >= 0])
    cells = np.where(kind < 0, -1, np.searchsorted(kinds, kind))
    return cells, kinds >> n_references, kinds & ((1 << n_references) - 1)


@dataclass(frozen=True)
class Draw:
    """Consecutive draws from one stratum."""

    stratum: int
    first: int
    n: int


class PrescribedEpisodes:
    """The tests of a shells campaign.

    Each stratum takes its events in a random order that the campaign's seed fixes, without replacement. In a stratum of
    several shells each draw first chooses the shell, by its probability; the order ends where a shell has no event
    left.
    """

    def __init__(self, resolved: Resolved, pool: Pool) -> None:
        campaign, self._resolved = resolved.campaign, resolved
        limit = tested_limit(campaign)
        design, groups = design_shells(pool, limit), shells_in_strata(pool, limit)
        self._events = pool.events
        self._cells = cells_in_strata(pool, groups)[0]
        self._order = [_order(pool, group, campaign.seed, stratum) for stratum, group in enumerate(groups)]
        self._order += [np.zeros(0, np.int64)] * (len(design.strata) - len(groups))
        self.design = replace(design, available=tuple(order.size for order in self._order))

    @property
    def available(self) -> IntArray:
        """How many draws each stratum allows, shape (S,)."""
        return np.array(self.design.available, np.int64)

    def rows(self, draws: tuple[Draw, ...]) -> tuple[IntArray, IntArray]:
        """Rows of the pool's events, and their strata, shape (n,) each; IndexError beyond what a stratum allows."""
        for draw in draws:
            available, end = self.design.available[draw.stratum], draw.first + draw.n
            if end > available:
                raise IndexError(f"stratum {draw.stratum} allows {available} draws, {end} were asked for")
        rows = [self._order[draw.stratum][draw.first : draw.first + draw.n] for draw in draws]
        return np.concatenate(rows), np.repeat([draw.stratum for draw in draws], [draw.n for draw in draws])

    def events(self, rows: IntArray) -> PrescribedEvents:
        """Columns of the records for given events of the pool (n,)."""
        events = self._events
        joined = np.eye(len(self.design.cell_stratum) + 1)[self._cells, :-1]  # row -1 is for cells that are not tested
        mass = events.path_mass[rows] @ joined
        acts = rows if self.design.shadow_runs else rows[:0]
        return PrescribedEvents(rows, self._cells[events.cell[rows]], mass, events.row[acts], events.mass[acts])

    def of_rows(self, rows: IntArray, stratum: IntArray) -> Traffic:
        """Tests of given events of the pool (n,), for given strata (n,)."""
        events, resolved = self._events, self._resolved
        chosen = Chosen(events.facts[rows], events.at[rows], events.lead[rows])
        script = resolved.family.script(resolved.environment, chosen)
        log_weight = elementary.log(self.design.p[stratum])
        script = script._replace(stratum=stratum.astype(np.int64), log_weight=log_weight)
        if events.acts:
            script = script._replace(announced_index=events.row[rows], motion_hash=events.motion[rows])
        return Traffic(script, chosen.facts)


def _order(pool: Pool, group: list[int], seed: int, stratum: int) -> IntArray:
    """Rows of the pool's events in the order in which a stratum, made of a group of shells, takes them."""
    rng = np.random.Generator(np.random.Philox(key=np.array([seed, stratum], np.uint64)))
    rows = [rng.permutation(np.flatnonzero(pool.shell == s)) for s in group]
    if len(rows) == 1:
        return rows[0]
    p = pool.shell_p[group]
    u = rng.random(sum(map(len, rows)))
    shell = np.minimum(np.searchsorted(np.cumsum(p) / p.sum(), u, side="right"), len(rows) - 1)
    order, end = np.zeros(shell.size, np.int64), shell.size
    for s, members in enumerate(rows):
        draws = np.flatnonzero(shell == s)
        order[draws[: members.size]] = members[: draws.size]
        if draws.size > members.size:
            end = min(end, int(draws[members.size]))
    return order[:end]
