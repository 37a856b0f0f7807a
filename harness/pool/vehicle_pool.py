"""The pool of one vehicle that acts before the cut-in: its own motion on the paths, and surrogates that take over.

Along each path the vehicle has been driven once without a cut-in, its *shadow run*. Where it was says how probable a
cut-in was in each step. Surrogates take over from it after the step of the cut-in, in which it still does what it did.
So shells, their probabilities and their moments are those of this vehicle; allocation and estimates stay what they are.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray, RecordArray
from harness.environment.driving import Environment
from harness.episode.motion import motion_hashes
from harness.episode.trajectory import empty_trajectory
from harness.errors import HarnessError
from harness.pool.aimed_paths import EnumeratedPaths, Enumerator
from harness.pool.build import pool_of
from harness.pool.cut_ins import Pool, environment_hash
from harness.pool.enumeration import STRIDE, enumerate_recorded
from harness.pool.shadow_paths import ShadowPaths
from harness.resolved import Resolved


@dataclass(frozen=True, eq=False)
class ShadowRuns:
    """What vehicles did without a cut-in, on paths (n,).

    ``n_steps``, ``failed`` (n,): steps that are on record, and whether the vehicle failed then. ``x_m``, ``v_mps``
    (n, steps + 1) are its positions and speeds, undefined beyond.
    """

    n_steps: IntArray
    failed: BoolArray
    x_m: FloatArray
    v_mps: FloatArray

    def mean_distance_m(self, weight: FloatArray) -> float:
        """Mean distance that the vehicle drives where nobody cuts in; paths have the ``weight`` (n,)."""
        whole, rows = ~self.failed, np.arange(len(self.n_steps))
        distance = self.x_m[rows, self.n_steps] - self.x_m[:, 0]
        return float((weight * distance)[whole].sum() / weight[whole].sum())

    def digest(self) -> str:
        """Hash of what is on record."""
        digest = hashlib.sha256(self.n_steps.tobytes() + self.failed.tobytes())
        known = np.arange(self.x_m.shape[1]) <= self.n_steps[:, None]
        for values in (self.x_m, self.v_mps):
            digest.update(values[known].tobytes())
        return digest.hexdigest()


def recorded_cut_ins(
    runs: ShadowRuns,
    seed: int,
    index: IntArray,
    state: RecordArray,
    environment: Environment,
    drivers: RecordArray,
    envelope: int,
    offset: IntArray | None = None,
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Probability of a cut-in in each step (n, steps) and who crashes then; and the most that failures hide (n,).

    With an ``offset`` (n,) only every `STRIDE`-th step is asked, from that one on; see `enumerate_cut_ins`.
    """
    shape = len(index), int(environment.numbers["max_steps"])
    probability, crashes, unknown = np.zeros(shape), np.zeros(shape, np.int64), np.zeros(len(index))
    room = empty_trajectory(environment)
    motion = runs.n_steps, runs.x_m, runs.v_mps
    asked = (1, np.zeros(len(index), np.int64)) if offset is None else (STRIDE, offset)
    where = environment, drivers, envelope
    enumerate_recorded(seed, index, state, *motion, *where, *asked, room, probability, unknown, crashes)
    return probability, crashes, np.where(runs.failed, unknown, 0.0)


def vehicle_pool(resolved: Resolved, paths: ShadowPaths, runs: ShadowRuns) -> Pool:
    """Pool of the vehicle that was driven along the paths.

    Raises
    ------
    HarnessError
        No cut-in was found on which even the envelope crashes.
    """
    environment, library = resolved.environment, resolved.library
    envelope = list(library.surrogates).index(library.envelope)
    drivers = library.drivers_in(environment)
    given = paths.seed, paths.index, paths.state, environment, drivers, envelope
    probability, crashes, unknown = recorded_cut_ins(runs, *given)
    if not crashes.any():
        raise _no_crash(len(paths), int(runs.failed.sum()))
    enumerated = EnumeratedPaths(paths.index, paths.state, paths.weight, probability * paths.weight[:, None], crashes)
    enumerator = Enumerator(environment, drivers, envelope, paths.seed)
    key, settings = vehicle_pool_key(resolved, paths, runs), resolved.campaign.pool
    pool = pool_of(enumerated, enumerator, paths.order, library, settings, key, environment_hash(environment))
    hashes = motion_hashes(runs.x_m, runs.v_mps)
    cut_ins = replace(pool.cut_ins, motion=hashes[pool.cut_ins.row, pool.cut_ins.onset])
    return replace(pool, cut_ins=cut_ins, p_unknown=float((unknown * paths.weight).mean()))


def vehicle_pool_key(resolved: Resolved, paths: ShadowPaths, runs: ShadowRuns) -> str:
    """Hash of all that the pool follows from: paths, campaign, and what its vehicle did, whatever the code."""
    content = paths.key, resolved.content_hash, runs.digest()
    return hashlib.sha256(" ".join(content).encode()).hexdigest()[:24]


def _no_crash(n: int, n_failed: int) -> HarnessError:
    failed = f" ({n_failed:,} of them failed)" if n_failed else ""
    return HarnessError(
        "shadow runs",
        found=f"no cut-in on {n:,} paths{failed} after which even the most careless surrogate would crash",
        expected="some: the crash rate is estimated from them",
        mend="Raise pool.shadow_paths, or use testing.method forced; look at whether the vehicle moves at all "
        "(`harness av-check`).",
    )
