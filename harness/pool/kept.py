"""What a pool is: cells with their probabilities, surrogates with their crash rates, and events to test with.

On disk it is one Parquet file of events, with all that is known of cells and surrogates in its metadata.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.families import family_named
from harness.pool.aim import PILOT_PATHS
from harness.records.folder import parquet
from harness.records.schemas import fact_columns, facts_from, rows
from harness.vehicles.library import Library
from harness.vocabulary import BoolArray, Float32Array, FloatArray, IntArray, RecordArray, UInt64Array

FORMAT = 8
"""Raise it when the meaning of a pool changes."""
_METADATA = b"harness_pool"


def onset_steps(step: IntArray, lead: IntArray) -> IntArray:
    """Steps of the onset of events in given steps (n,), with a ``lead`` (n,)."""
    return np.asarray(np.maximum(step - lead, 0))


@dataclass(frozen=True, eq=False)
class KeptEvents:
    """A weighted sample of events, each with what has to be known to repeat it.

    Within a shell all have the same probability. ``path``, ``step``, ``cell`` (n,): which path of the pool, which of
    its events, and cell; ``facts``, ``at``, ``lead`` (n,): see `Chosen` of families. ``crashes`` (n, D + R): which
    surrogates crash, in the pool's order, and which references. ``path_mass`` (n, C) float32: the path's probability of
    an event of each cell. ``motion`` (n,) are hashes of what the AV did through the step of the event,
    in the pool of a vehicle that acts before it, or of its onset, and ``mass`` (n,) the probability of those
    that each stands for; else empty. ``lead`` (n,) is how many steps earlier the onset is: 0 where events are one
    step.
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
        """Which row of the pool's paths each is of, shape (n,): in the pool of a vehicle its baseline run."""
        return np.asarray(self.path - PILOT_PATHS)


@dataclass(frozen=True, eq=False)
class Pool:
    """Pool of one environment and one library.

    ``key`` is the hash of all that it was made from, ``family`` names the kind of its events, ``environment`` is
    the hash of its environment. ``names`` (D) are
    the surrogates, the most conservative first, ``mu`` (D,) their crash rates per test from ``n_paths`` paths, and
    ``mu_covariance`` (D, D) of their errors. ``p_event`` is the probability that BV cuts in in a test, ``p_event_se``
    its standard error, and ``p_event_at_crash`` (D,) the mean P(event | path) of the events on which each surrogate
    crashes, three standard errors on top. Cells divide shells by which references crash: ``cell_shell``,
    ``cell_references`` (C,) are the shell of each and one bit per reference, ``cell_p`` (C,) its probability.
    ``reference_rate``, ``reference_square`` (R,) are crash rates of the references, and mean squares of a path's
    probability that they crash. ``p_after_failure`` is the probability, at most, of events after a baseline run has
    failed: nothing is known about them.
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
    p_event_at_crash: FloatArray
    cell_shell: IntArray
    cell_references: IntArray
    cell_p: FloatArray
    reference_rate: FloatArray
    reference_square: FloatArray
    events: KeptEvents
    p_after_failure: float = 0.0

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
        drivers = self.library.surrogates.items()
        delays = {name: delay for name, each in drivers if (delay := each.delay_after_event_s) is not None}
        return {
            "pool": self.key,
            "n_paths": self.n_paths,
            "p_event": self.p_event,
            "p_event_std_error": self.p_event_se,
            "boundary": self.library.boundary,
            "envelope": self.library.envelope,
            "delays_after_event_s": {} if self.events.lead.any() else delays,
            "surrogates": [dict(zip(keys, row, strict=True)) for row in surrogates],
            "no_surrogate_crashes": p[-1],
            "references": [dict(zip(keys[:-1], row, strict=True)) for row in references],
        }


def pool_content(pool: Pool) -> bytes:
    """A pool as the content of a file."""
    return parquet(_table(pool))


def _table(pool: Pool) -> pa.Table:
    c = pool.events
    probability = pool.shell_p / np.maximum(np.bincount(pool.shell, minlength=pool.shell_p.size), 1)
    columns: dict[str, tuple[pa.Array, str]] = {
        "path": (pa.array(c.path), "index of the path in the pool"),
        "event": (pa.array(c.step.astype(np.int16)), "which of the path's events"),
        "event_step": (pa.array(c.at.astype(np.int16)), "step (0.1 s) in which it is"),
        "probability": (pa.array(probability[pool.shell]), "P under the NDE that it stands for"),
        "shell": (pa.array(pool.shell.astype(np.int8)), "first surrogate that crashes; the last shell: none does"),
        "cell": (pa.array(c.cell.astype(np.int16)), "shell and references that crash, as the metadata lists cells"),
        "crashes": (rows(c.crashes), "which surrogates crash, as the metadata orders names, and which references"),
        "path_mass": (rows(c.path_mass), "P of an event of each cell on the path, times the path's weight"),
        "lead_steps": (pa.array(c.lead.astype(np.int16)), "steps from the onset of lateral motion to overlap"),
    }
    own = family_named(pool.family).columns
    known_of = fact_columns(c.facts, own)
    columns |= {each.name: (known_of[each.name], each.doc) for each in own}
    schema = pa.schema(
        [pa.field(name, array.type, nullable=False, metadata={"doc": doc}) for name, (array, doc) in columns.items()]
    )
    known = {each.name: getattr(pool, each.name) for each in fields(pool) if each.name not in ("library", "events")}
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in known.items()}
    table = pa.table([array for array, _ in columns.values()], schema=schema)
    facts = json.dumps({"library": pool.library.model_dump(), **plain}).encode()
    return table.replace_schema_metadata({_METADATA: facts})


def pool_from(content: bytes) -> Pool:
    """The pool that `pool_content` has written."""
    with pq.ParquetFile(pa.BufferReader(content)) as file:  # read_table would import, for 0.3 s, what reads folders
        table = file.read()
    facts: dict[str, Any] = json.loads(table.schema.metadata[_METADATA])

    def whole(name: str) -> IntArray:
        return np.asarray(table.column(name)).astype(np.int64)

    def matrix(name: str) -> np.ndarray:
        values = table.column(name).combine_chunks().flatten().to_numpy(zero_copy_only=False)
        return np.asarray(values).reshape(table.num_rows, -1)

    path, step, cell, at, lead = map(whole, ("path", "event", "cell", "event_step", "lead_steps"))
    sample = facts_from(table, family_named(facts["family"]).columns), at, lead, matrix("crashes"), matrix("path_mass")
    events = KeptEvents(path, step, cell, *sample)
    known: dict[str, Any] = {
        name: np.array(value) if isinstance(value, list) else value for name, value in facts.items()
    }
    known |= {"library": Library.model_validate(facts["library"]), "names": tuple(facts["names"]), "events": events}
    return Pool(**{field.name: known[field.name] for field in fields(Pool)})
