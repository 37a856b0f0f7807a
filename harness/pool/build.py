"""Build a pool: pilot run, aimed paths until crash rates are known well enough, shells, and cut-ins to keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.campaign.sections import PoolSettings
from harness.pool.cut_ins import FAR_OFF, CutIns, Pool, environment_hash, shells_of
from harness.pool.library import Library
from harness.pool.walk import PILOT_PATHS, EnumeratedPaths, Enumerator, joined, write_script
from harness.progress import Progress
from harness.random_stream import DIAGNOSTIC, uniforms
from harness.traffic.laws import Environment
from harness.vocabulary import BoolArray, FloatArray, Int8Array, IntArray

ROUND_PATHS = 1024
MOST_PATHS = 1 << 20
CARELESS_SHARE = 0.2
"""How much the surrogates beyond the boundary count in aiming, and those far off: less has to be known there."""
CARELESS_ERROR = 4.0
"""Their relative error may be this many times the target."""
POOL_SEED = 0x706F6F6C
"""Keeps a pool's random numbers apart from those of a campaign with the same seed."""
KEEP_DRAW = 1
"""Draw of a shell within the diagnostic stream."""


def build_pool(
    environment: Environment, library: Library, settings: PoolSettings, key: str, progress: Progress | None = None
) -> Pool:
    """Build a pool in the twin, which will carry the content hash ``key``."""
    progress = progress or Progress()
    aim = take_aim(environment, library, settings, progress)
    paths = _until_known(aim, settings, progress)
    order = careful_first(paths.rates(len(library.surrogates)))
    return pool_of(paths, settings.seed ^ POOL_SEED, order, environment, library, settings, key)


@dataclass(frozen=True, eq=False)
class Aim:
    """Paths aimed at crashes, what the pilot run said (n, D + 1), and which of its columns are to be known well."""

    enumerator: Enumerator
    pilot: FloatArray
    careful: BoolArray

    @property
    def share(self) -> FloatArray:
        """How much each column counts in aiming, shape (D + 1,)."""
        return np.where(self.careful, 1.0, CARELESS_SHARE)


def take_aim(environment: Environment, library: Library, settings: PoolSettings, progress: Progress) -> Aim:
    """Find out by a pilot run of naturalistic paths where surrogates crash."""
    names = list(library.surrogates)
    pilot = Enumerator(environment, library.followers_in(environment), settings.seed ^ POOL_SEED)
    progress.stage("pool: pilot", PILOT_PATHS)
    rates = pilot.run(0, PILOT_PATHS, progress).rates(len(names))
    aim = Aim(pilot, rates, _careful(rates, names.index(library.boundary)))
    return Aim(pilot.aimed(rates, aim.share), rates, aim.careful)


def careful_first(rates: FloatArray) -> IntArray:
    """Surrogates from careful to careless by the rates (n, D + 1) of paths, as places in the library, shape (D,)."""
    order: IntArray = np.argsort(rates[:, :-1].mean(0), kind="stable")
    return order


def _careful(rates: FloatArray, boundary: int) -> BoolArray:
    """Which columns (surrogates, and the cut-in) are to be known well, shape (D + 1,) bool.

    Those that are no more careless than the boundary, and crash in the traffic that it crashes in.
    """
    mean = rates.mean(0)
    seen = mean > 0.0  # one that no path has met yet is met by few
    relvar = np.where(seen, rates.var(0) / np.where(seen, mean, 1.0) ** 2, np.inf)
    careful: BoolArray = (mean <= mean[boundary]) & (relvar <= FAR_OFF * relvar[boundary])
    return careful


def _until_known(aim: Aim, settings: PoolSettings, progress: Progress) -> EnumeratedPaths:
    """Enumerate paths until the relative errors are small enough; what is left of them is part of every interval."""
    pilot, careful = aim.pilot, aim.careful
    wanted = settings.relative_error * np.where(careful, 1.0, CARELESS_ERROR)
    progress.stage("pool of cut-ins", _paths_needed(pilot, wanted))
    rounds: list[EnumeratedPaths] = []
    rates = np.zeros((0, pilot.shape[1]))
    while len(rates) < MOST_PATHS:
        rounds.append(aim.enumerator.run(PILOT_PATHS + len(rates), ROUND_PATHS, progress))
        rates = np.concatenate([rates, rounds[-1].rates(pilot.shape[1] - 1)])
        mean = rates.mean(0)
        known = mean > 0.0
        error = rates.std(0)[known] / np.sqrt(len(rates)) / mean[known]
        progress.status(error=f"{error[careful[known]].max(initial=0.0):.2%}")
        if np.all(error <= wanted[known]):
            break
    return joined(rounds)


def _paths_needed(pilot: FloatArray, wanted: FloatArray) -> int:
    """Rough number of paths, for the progress bar: aiming about halves the squared error of the pilot's."""
    mean = pilot.mean(0)
    known = mean > 0.0
    relvar = pilot.var(0)[known] / mean[known] ** 2
    needed = 0.5 * float((relvar / wanted[known] ** 2).max(initial=1.0))
    return min(MOST_PATHS, -(-int(needed) // ROUND_PATHS) * ROUND_PATHS)


def pool_of(
    paths: EnumeratedPaths,
    seed: int,
    order: IntArray,
    environment: Environment,
    library: Library,
    settings: PoolSettings,
    key: str,
) -> Pool:
    """Sort the cut-ins of paths into shells, by surrogates in this order, and cells; keep a sample of each shell.

    ``seed`` is that of the paths.
    """
    n_surrogates, n_references = len(library.surrogates), len(library.references)
    rates, mass = paths.rates(n_surrogates), paths.mass
    n = len(rates)
    ordered = rates[:, order]
    shell, references = shells_of(paths.crashes, order), paths.crashes >> n_surrogates
    kinds, by_path, cell = _cells(mass, (shell.astype(np.int64) << n_references) | references)
    cell_references = kinds & ((1 << n_references) - 1)
    by_reference = by_path @ ((cell_references[:, None] >> np.arange(n_references)) & 1)
    path, step = _keep(mass, shell, n_surrogates + 1, settings)
    script = write_script(seed, paths.index[path], step, paths.state[path], environment)
    asked = np.concatenate([order, n_surrogates + np.arange(n_references)])
    crashes = ((paths.crashes[path, step][:, None] >> asked[None, :]) & 1).astype(np.bool_)
    sample = CutIns(
        PILOT_PATHS + path,
        step,
        cell[path, step],
        paths.state[path],
        *script[:-1],
        crashes,
        by_path[path].astype(np.float32),
        script.lead,
    )
    return Pool(
        key=key,
        environment=environment_hash(environment),
        library=library,
        names=tuple(np.array(list(library.surrogates))[order].tolist()),
        n_paths=n,
        p_cut_in=float(rates[:, -1].mean()),
        p_cut_in_se=float(rates[:, -1].std() / np.sqrt(n)),
        mu=ordered.mean(0),
        mu_covariance=np.atleast_2d(np.cov(ordered.T, bias=True)) / n,
        p_cut_in_at_crash=_p_cut_in_at_crash(ordered, rates[:, -1] / paths.weight),
        cell_shell=kinds >> n_references,
        cell_references=cell_references,
        cell_p=by_path.mean(0),
        reference_rate=by_reference.mean(0),
        reference_square=(by_reference * by_reference).mean(0),
        cut_ins=sample,
    )


def _p_cut_in_at_crash(rates: FloatArray, p_cut_in: FloatArray) -> FloatArray:
    """Mean P(cut-in | path), shape (D,), where surrogates crash: of weighted ``rates`` (n, D) and ``p_cut_in`` (n,)."""
    both, mean = rates * p_cut_in[:, None], rates.mean(0)
    at_most = both.mean(0) + 3.0 * both.std(0) / np.sqrt(len(rates))
    found: FloatArray = np.divide(at_most, mean, out=np.ones_like(mean), where=mean > 0.0)
    return found


def _cells(mass: FloatArray, kind: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Cells of cut-ins with ``mass`` (n, steps) of some ``kind`` (n, steps).

    Returns the kind of each cell (C,), the mass of each path in it (n, C), and the cell of each cut-in (n, steps).
    """
    kinds = np.unique(kind[mass > 0.0])
    cell = np.minimum(np.searchsorted(kinds, kind), kinds.size - 1)  # without mass it may be of no kind
    flat = np.arange(len(mass))[:, None] * kinds.size + cell
    by_path: FloatArray = np.bincount(flat.ravel(), mass.ravel(), minlength=len(mass) * kinds.size).astype(np.float64)
    return kinds, by_path.reshape(len(mass), kinds.size), cell


def _keep(mass: FloatArray, shell: Int8Array, n_shells: int, settings: PoolSettings) -> tuple[IntArray, IntArray]:
    """Systematic sample of cut-ins of every shell, with probability proportional to mass.

    Path and step (row and column in ``mass``), each (n,), sorted by shell and path.
    """
    kept = []
    for s in range(n_shells):
        places = np.flatnonzero((shell == s) & (mass > 0.0))
        if places.size == 0:
            continue
        cumulative = np.cumsum(mass.ravel()[places])
        offset = uniforms(settings.seed, s, 1, DIAGNOSTIC, KEEP_DRAW + 1)[0, KEEP_DRAW]
        wanted = (offset + np.arange(settings.cut_ins_per_shell)) * (cumulative[-1] / settings.cut_ins_per_shell)
        chosen = places[np.minimum(np.searchsorted(cumulative, wanted, side="right"), places.size - 1)]
        kept.append((chosen // mass.shape[1], chosen % mass.shape[1]))
    path, step = (np.concatenate(column) for column in zip(*kept, strict=True))
    return path, step
