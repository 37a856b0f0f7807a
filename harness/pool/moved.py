"""What few paths say of other traffic: how probable the strata are there, and how often reference drivers crash.

The same paths, by their random numbers, are walked in every traffic, so that ratios are known far better than what they
are of: a rate moves by the same some 0.2 % with 4,096 paths, of which it is known to 3 %.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from harness import cache
from harness.families import family_named
from harness.families.protocol import Environment
from harness.pool.aim import PILOT_PATHS, Enumerator
from harness.pool.build import take_aim
from harness.pool.cut_ins import Pool
from harness.pool.shells import shells_in_strata, shells_of
from harness.progress import Progress
from harness.resolved import Resolved
from harness.strata import ShellDesign
from harness.vocabulary import FloatArray

N_PATHS = 4096
FORMAT = 2
"""Raise it when the meaning of what is kept changes."""
MARGIN = 0.05
"""Of the range of a sample of cut-ins, by which another may lie beyond it [assumed]."""


@dataclass(frozen=True, eq=False)
class Moved:
    """Of some traffic: probability per test of cut-ins of each stratum ``p`` (S,), and of crashes of drivers.

    ``rate`` (D + R,) are rates of the surrogates, in the tested pool's order, and of the reference drivers. ``beyond``
    (S,) is the part of ``p`` in cut-ins whose initial state is beyond all those of the same shell in the tested pool;
    ``untested`` the probability of shells that the tested pool does not have.
    """

    p: FloatArray
    rate: FloatArray
    beyond: FloatArray
    untested: float

    @property
    def numbers(self) -> FloatArray:
        """All of it in one row."""
        return np.concatenate([self.p, self.rate, self.beyond, [self.untested]])

    @classmethod
    def of(cls, numbers: FloatArray, n_strata: int) -> Moved:
        """From such a row."""
        return cls(numbers[:n_strata], numbers[n_strata : -1 - n_strata], numbers[-1 - n_strata : -1], numbers[-1])


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
        self._drivers = np.append(self._order, len(pool.names) + np.arange(len(library.references)))
        self._stratum = np.full(len(pool.names) + 1, -1)
        for stratum, group in enumerate(shells_in_strata(pool, limit_mps2)):
            self._stratum[group] = stratum
        self._n_strata = len(design.strata)
        self._reaches_last = self._stratum[-1] >= 0
        self._range = ranges(pool)
        self._aimed: Enumerator | None = None
        about = FORMAT, pool.key, resolved.family.digest(resolved.environment), design.strata, settings.seed, N_PATHS
        key = hashlib.sha256(json.dumps(about).encode()).hexdigest()[:24]
        self._name = f"moved/{key}"
        kept: dict[str, list[float]] = json.loads(cache.read(self._name) or "{}")
        self._seen = {key: Moved.of(np.array(row), self._n_strata) for key, row in kept.items()}

    def of(self, environments: Sequence[Environment]) -> Iterator[Moved]:
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
                content = {key: each.numbers.tolist() for key, each in self._seen.items()}
                cache.keep(self._name, json.dumps(content).encode())

    def _walk(self, environment: Environment) -> Moved:
        if self._aimed is None:
            resolved, nobody = self._resolved, Progress()
            asked = resolved.family, resolved.environment, resolved.library, resolved.campaign.pool
            self._aimed = take_aim(*asked, nobody).enumerator
        paths = replace(self._aimed, environment=environment).run(PILOT_PATHS, N_PATHS, Progress())
        shell, mass, n_shells = shells_of(paths.crashes, self._order), paths.mass / N_PATHS, self._stratum.size
        flat = np.arange(N_PATHS)[:, None] * n_shells + shell
        by_path = np.bincount(flat.ravel(), mass.ravel(), N_PATHS * n_shells).reshape(N_PATHS, n_shells)
        outside = np.zeros((N_PATHS, n_shells), np.bool_)
        for name, (low, high) in self._range.items():
            state = paths.start[name][:, None]
            outside |= (state < low) | (state > high)
        rate = [np.where((paths.crashes >> bit) & 1 == 1, mass, 0.0).sum() for bit in self._drivers]
        in_stratum = self._stratum[:, None] == np.arange(self._n_strata)
        of_shell, unknown = by_path.sum(0), self._stratum < 0
        unknown[-1] = False  # no vehicle within the envelope crashes there
        beyond = (by_path * outside).sum(0) @ in_stratum
        return Moved(of_shell @ in_stratum, np.array(rate), beyond, float(of_shell[unknown].sum()))


def ranges(pool: Pool) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Where the numbers of the initial states of the pool's cut-ins lie, by shell (D + 1,), with a margin.

    A cut-in a little beyond the outermost of a sample is not unlike those in it.
    """
    shell, n = pool.shell, len(pool.names) + 1
    found = {}
    numbers = [each.name for each in family_named(pool.family).columns if pa.types.is_floating(each.kind)]
    for name in numbers:
        low, high = np.full(n, -np.inf), np.full(n, np.inf)  # of a shell without cut-ins nothing is known
        for s in np.unique(shell):
            values = pool.cut_ins.facts[name][shell == s]
            low[s], high[s] = values.min(), values.max()
            margin = MARGIN * (high[s] - low[s])
            low[s], high[s] = low[s] - margin, high[s] + margin
        found[name] = low, high
    return found
