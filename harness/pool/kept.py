"""What a pool is: cells with their probabilities, surrogates with their crash rates, and events to test with."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from io import BytesIO
from typing import Any

import numpy as np

from harness.pool.aim import PILOT_PATHS
from harness.vehicles.library import Library
from harness.vocabulary import BoolArray, Float32Array, FloatArray, IntArray, RecordArray, UInt64Array

FORMAT = 9
"""Raise it when the meaning of a pool changes."""


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


def pool_content(pool: Pool) -> memoryview:
    """A pool as the content of a file, without its library, of which the key holds what matters."""
    known = {each.name: getattr(pool, each.name) for each in fields(pool) if each.name not in ("library", "events")}
    np.savez(file := BytesIO(), **known, **vars(pool.events))
    return file.getbuffer()


def pool_from(content: bytes, library: Library) -> Pool:
    """The pool that `pool_content` has written, of a library."""
    with np.load(BytesIO(content)) as stored:
        arrays = {name: stored[name] for name in stored.files}
    events = KeptEvents(**{each.name: arrays.pop(each.name) for each in fields(KeptEvents)})
    names = tuple(arrays.pop("names").tolist())
    known: dict[str, Any] = {name: array if array.ndim else array.item() for name, array in arrays.items()}
    return Pool(**known, names=names, library=library, events=events)
