"""What few paths say of other traffic: how probable the strata are there, and how often reference drivers crash.

The same paths, by their random numbers, are walked in every traffic, so that ratios are known far better than what they
are of: a rate of cut-ins moves by the same some 0.2 % with 4,096 paths, of which it is known to 3 %. Paths of
lead braking and cut-outs take 2 to 8 times as long: with a quarter as many a rate moves by the same to 4 % or better.
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
"""Raise it when the meaning of what is kept changes."""
MARGIN = 0.05
"""Of the range of a sample of events, by which another may lie beyond it [assumed]."""


class OnPaths(NamedTuple):
    """Of some traffic: probability per test of events of each stratum ``p`` (S,), and rates of reference drivers (R,).

    ``beyond`` (S,) is the part of ``p`` in events whose initial state is beyond all those of the same shell in the
    tested pool; ``untested`` () the probability of shells that the tested pool does not have.
    """

    p: FloatArray
    references: FloatArray
    beyond: FloatArray
    untested: FloatArray


class FewPaths:
    """Walks the same few paths, aimed by the traffic ``resolved``, in one traffic after the other.

    Strata are those of a ``design`` that was made of the ``pool``. What was found is kept in the cache.
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
        about = FORMAT, pool.key, resolved.family.digest(resolved.environment), design.strata, settings.seed, n
        key = hashlib.sha256(json.dumps(about).encode()).hexdigest()[:24]
        self._name = f"moved/{key}"
        kept: dict[str, list[Any]] = json.loads(cache.read(self._name) or "{}")
        self._seen = {key: OnPaths(*map(np.array, row)) for key, row in kept.items()}

    def of(self, environments: Sequence[Environment]) -> Iterator[OnPaths]:
        """What is found in each."""
        n_kept = len(self._seen)
        try:
            for environment in environments:
                if (key := self._resolved.family.digest(environment)) not in self._seen:
                    self._seen[key] = self._walk(environment)
                yield self._seen[key]
                self._progress.advance(1)
        finally:
            if len(self._seen) > n_kept:
                content = {key: [of.tolist() for of in each] for key, each in self._seen.items()}
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
        for name in {*self._range} & {*(paths.start.dtype.names or ())}:  # a fact may be of the event alone
            (low, high), state = self._range[name], paths.start[name][:, None]
            outside |= (state < low) | (state > high)
        rate = [np.where((paths.crashes >> bit) & 1 == 1, mass, 0.0).sum() for bit in self._references]
        in_stratum = self._stratum[:, None] == np.arange(self._n_strata)
        of_shell, unknown = by_path.sum(0), self._stratum < 0
        unknown[-1] = False  # no vehicle within the envelope crashes there
        beyond = (by_path * outside).sum(0) @ in_stratum
        return OnPaths(of_shell @ in_stratum, np.array(rate), beyond, of_shell[unknown].sum())


def ranges(pool: Pool) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Where the numbers of the initial states of the pool's events lie, by shell (D + 1,), with a margin.

    An event a little beyond the outermost of a sample is not unlike those in it.
    """
    shell, n = pool.shell, len(pool.names) + 1
    found = {}
    numbers = [each.name for each in family_named(pool.family).columns if pa.types.is_floating(each.kind)]
    for name in numbers:
        low, high = np.full(n, -np.inf), np.full(n, np.inf)  # of a shell without events nothing is known
        for s in np.unique(shell):
            values = pool.events.facts[name][shell == s]
            low[s], high[s] = values.min(), values.max()
            margin = MARGIN * (high[s] - low[s])
            low[s], high[s] = low[s] - margin, high[s] + margin
        found[name] = low, high
    return found


def environment_with(there: Resolved, values: Mapping[str, float]) -> Environment | None:
    """The traffic ``there`` with other numbers; None where they give no laws."""
    return there.family.traffic_with(there.campaign.environment, there.parameters, values)


def assumed(
    traffic: Resolved, pool: Pool | None, design: ShellDesign | None, progress: Progress
) -> dict[str, Any] | None:
    """Fields of `Assumed`: by what the strata's probabilities move over what data leave open; None without that.

    That is the range that is stated for who does not look, or shares of lane changes at times to collision where none
    was seen, which are anything up to what that many vehicles without one refuse. Without strata of this traffic there
    are no factors.
    """
    if pool is None or design is None:
        return asdict(Assumed(traffic.parameters.unseen)) if traffic.parameters.unseen else None
    if (left := traffic.parameters.left_open()) is None:
        return None
    ends = [environment_with(traffic, each) for each in left.ends]
    if None in ends:
        return None
    paths = FewPaths(traffic, pool, design, tested_limit(traffic.campaign), progress)
    base, *moved = paths.of([traffic.environment, *filter(None, ends)])
    low, high = (tuple(ratio_of(each.p, base.p).tolist()) for each in moved)
    return asdict(Assumed(left.where, left.highest, (low, high), left.share))


def ratio_of(a: FloatArray, b: FloatArray) -> FloatArray:
    """1 where there is nothing to compare with."""
    return np.divide(a, b, out=np.ones_like(b), where=b > 0.0)
