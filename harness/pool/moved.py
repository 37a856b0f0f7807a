"""Other traffic by few paths: how probable the strata are there, and how often reference drivers crash.

Paths with the same random numbers are walked in every traffic, so that ratios between traffic are known far better than
the rates: with 4,096 paths, to some 0.2 % where a rate of cut-ins is known to 3 %. Paths of lead braking and cut-outs
take 2 to 8 times as long: with a quarter as many, ratios are known to 4 % or better.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from harness import cache
from harness.families import family_named
from harness.families.protocol import Environment
from harness.pool.aim import PILOT_PATHS, Enumerator
from harness.pool.build import take_aim
from harness.pool.shells import Pool, shells_in_strata, shells_of, strata_of_shells, tested_limit
from harness.progress import Progress
from harness.resolved import Resolved
from harness.strata import Assumed, ShellDesign
from harness.vocabulary import FloatArray

N_PATHS, N_PATHS_OF_FOLLOWERS = 4096, 1024
FORMAT = 3
"""Raise it when the meaning of the cached files changes."""
MARGIN = 0.05
"""Share of the range of a sample of events, by which an event beyond it is still like these [assumed]."""


class OnPaths(NamedTuple):
    """Some traffic: probability per test of events of each stratum ``p`` (S,), and rates of reference drivers (R,).

    ``beyond`` (S,) is the part of ``p`` in events whose initial state lies beyond all of the same shell in the tested
    pool; ``untested`` () is the probability of shells that the tested pool does not have.
    """

    p: FloatArray
    references: FloatArray
    beyond: FloatArray
    untested: FloatArray


class FewPaths:
    """Walks the same few paths, aimed by the traffic ``resolved``, in one traffic after the other.

    Strata are those of a ``design`` that was made of the ``pool``. Results are kept in the cache.
    """

    def __init__(
        self, resolved: Resolved, pool: Pool, design: ShellDesign, limit_mps2: float, progress: Progress
    ) -> None:
        library, settings = resolved.library, resolved.campaign.pool
        self._resolved, self._progress = resolved, progress
        self._order = np.array([list(library.surrogates).index(name) for name in pool.names])
        self._references = len(library.surrogates) + np.arange(len(library.references))
        self._stratum = strata_of_shells(pool, shells_in_strata(pool, limit_mps2))
        self._n_strata = len(design.strata)
        self._range = ranges(pool)
        self._aimed: Enumerator | None = None
        self._n = n = N_PATHS_OF_FOLLOWERS if resolved.family.follows else N_PATHS
        inputs = FORMAT, pool.key, resolved.family.digest(resolved.environment), design.strata, settings.seed, n
        key = hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]
        self._name = f"moved/{key}"
        cached: dict[str, list[Any]] = json.loads(cache.read(self._name) or "{}")
        self._walked = {digest: OnPaths(*map(np.array, columns)) for digest, columns in cached.items()}

    def of(self, environments: Sequence[Environment]) -> Iterator[OnPaths]:
        """Each environment's probabilities and rates, from the cache or walked."""
        n_cached = len(self._walked)
        try:
            for environment in environments:
                if (digest := self._resolved.family.digest(environment)) not in self._walked:
                    self._walked[digest] = self._walk(environment)
                yield self._walked[digest]
                self._progress.advance(1)
        finally:
            if len(self._walked) > n_cached:
                content = {digest: [column.tolist() for column in each] for digest, each in self._walked.items()}
                cache.keep(self._name, json.dumps(content).encode())

    def _walk(self, environment: Environment) -> OnPaths:
        if self._aimed is None:
            self._aimed = take_aim(self._resolved, Progress()).enumerator
        n, n_shells = self._n, self._stratum.size
        paths = replace(self._aimed, environment=environment).run(PILOT_PATHS, n, Progress())
        shell, mass = shells_of(paths.crashes, self._order), paths.mass / n
        flat = np.arange(n)[:, None] * n_shells + shell
        by_path = np.bincount(flat.ravel(), mass.ravel(), n * n_shells).reshape(n, n_shells)
        outside = np.zeros((n, n_shells), np.bool_)
        for name in {*self._range} & {*(paths.start.dtype.names or ())}:  # other facts are of the event, not the start
            (low, high), state = self._range[name], paths.start[name][:, None]
            outside |= (state < low) | (state > high)
        rate = [np.where((paths.crashes >> bit) & 1 == 1, mass, 0.0).sum() for bit in self._references]
        in_stratum = self._stratum[:, None] == np.arange(self._n_strata)
        of_shell, unknown = by_path.sum(0), self._stratum < 0
        unknown[-1] = False  # no vehicle within the envelope crashes there
        beyond = (by_path * outside).sum(0) @ in_stratum
        return OnPaths(of_shell @ in_stratum, np.array(rate), beyond, of_shell[unknown].sum())


def ranges(pool: Pool) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Lowest and highest value of each numerical fact of the pool's events, by shell (D + 1,), with a margin.

    An event a little beyond the outermost of a sample is not unlike those in it.
    """
    shell, n_shells = pool.shell, len(pool.names) + 1
    limits = {}
    for name in [column.name for column in family_named(pool.family).columns if pa.types.is_floating(column.kind)]:
        low, high = np.full(n_shells, -np.inf), np.full(n_shells, np.inf)  # unlimited for a shell without events
        for s in np.unique(shell):
            values = pool.events.facts[name][shell == s]
            low[s], high[s] = values.min(), values.max()
            margin = MARGIN * (high[s] - low[s])
            low[s], high[s] = low[s] - margin, high[s] + margin
        limits[name] = low, high
    return limits


def environment_with(there: Resolved, values: Mapping[str, float]) -> Environment | None:
    """The traffic ``there`` with other numbers; None where they give no laws."""
    return there.family.traffic_with(there.campaign.environment, there.parameters, values)


def assumed(
    traffic: Resolved, pool: Pool | None, design: ShellDesign | None, progress: Progress
) -> dict[str, Any] | None:
    """Fields of `Assumed`: factors of the strata's probabilities over what data leave open; None without that.

    Left open is the range that is stated for drivers who do not look, or the shares of lane changes at times to
    collision at which none was seen: from none to the most that so many vehicles without one allow. Without strata of
    this traffic there are no factors.
    """
    if pool is None or design is None:
        return asdict(Assumed(traffic.parameters.unseen)) if traffic.parameters.unseen else None
    if (left_open := traffic.parameters.left_open()) is None:
        return None
    ends = [environment_with(traffic, numbers) for numbers in left_open.ends]
    if None in ends:
        return None
    paths = FewPaths(traffic, pool, design, tested_limit(traffic.campaign), progress)
    base, *at_ends = paths.of([traffic.environment, *filter(None, ends)])
    low, high = (tuple(ratio_of(end.p, base.p).tolist()) for end in at_ends)
    crashes = np.flatnonzero(base.references)[:1]  # the first that does
    lower, upper = (float(ratio_of(end.references, base.references)[crashes].sum()) or 1.0 for end in at_ends)
    return asdict(Assumed(left_open.where, left_open.highest, (low, high), left_open.share, (lower, upper)))


def ratio_of(a: FloatArray, b: FloatArray, *, of_nothing: float = 1.0) -> FloatArray:
    """Elementwise a / b; ``of_nothing`` where b is 0."""
    return np.divide(a, b, out=np.full_like(b, of_nothing), where=b > 0.0)
