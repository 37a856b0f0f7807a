"""Build a pool: pilot run, aimed paths until crash rates are known well enough, shells, and cut-ins to keep."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from harness.arrays import BoolArray, FloatArray, Int8Array, IntArray, RecordArray
from harness.campaign.models import PoolSettings
from harness.environment.driving import Environment
from harness.environment.initial_state import InitialStates
from harness.episode.trajectory import empty_trajectory
from harness.pool.cut_ins import FAR_OFF, CutIns, Pool, environment_hash, shells_of
from harness.pool.enumeration import STRIDE, enumerate_cut_ins, write_pairs
from harness.pool.library import Library
from harness.pool.proposal import Proposal, fit_proposal
from harness.progress import Progress, SilentProgress
from harness.random_stream import DIAGNOSTIC, INITIAL, uniforms
from harness.state import STATE_COLUMNS

PILOT_PATHS = 2048
ROUND_PATHS = 1024
BLOCK_PATHS = 256
MOST_PATHS = 1 << 20
CARELESS_SHARE = 0.2
"""How much the surrogates beyond the boundary count in aiming, and those far off: less has to be known there."""
CARELESS_ERROR = 4.0
"""Their relative error may be this many times the target."""
_APART = 0x706F6F6C
"""Keeps a pool's random numbers apart from those of a campaign with the same seed."""
AIMED_DRAW, OFFSET_DRAW = 0, 1
"""Draws of a path within the diagnostic stream."""
KEEP_DRAW = 1
"""The same, of a shell."""


@dataclass(frozen=True)
class Enumerated:
    """Cut-ins of some paths.

    ``weight`` (n,) is naturalistic over proposal density; ``state`` (n,); ``probability`` (n, steps) is that of the
    cut-ins that one in this step stands for; ``crashes`` (n, steps) one bit per surrogate, as the library orders them.
    """

    first: int
    weight: FloatArray
    state: RecordArray
    probability: FloatArray
    crashes: IntArray

    def rates(self, n_surrogates: int) -> FloatArray:
        """Per path: its weighted probability that each surrogate crashes, and of a cut-in; shape (n, D + 1)."""
        mass = self.probability * self.weight[:, None]
        columns = [(mass * ((self.crashes >> d) & 1)).sum(1) for d in range(n_surrogates)]
        return np.column_stack([*columns, mass.sum(1)])


class Enumerator:
    """Enumerates consecutive paths of one environment, on all cores; the number of cores changes no bit."""

    def __init__(
        self,
        environment: Environment,
        drivers: RecordArray,
        envelope: int,
        seed: int,
        proposal: Proposal | None = None,
        stride: int = STRIDE,
    ) -> None:
        self._environment, self._drivers, self._envelope = environment, drivers, envelope
        self._seed, self._proposal, self._stride = seed, proposal, stride
        self._states = InitialStates(environment.numbers)
        self._max_steps = int(environment.numbers["max_steps"])
        # Compiled here, by one thread: of two that want a new kernel at once, the second would have to wait for
        # whatever else is compiled meanwhile.
        self._block(0, 0)

    def aimed(self, proposal: Proposal) -> Enumerator:
        """The same, with initial states drawn from a proposal."""
        return Enumerator(self._environment, self._drivers, self._envelope, self._seed, proposal, self._stride)

    def uniforms(self, first: int, n: int) -> FloatArray:
        """Uniforms of the initial states of consecutive paths, shape (n, 5)."""
        return uniforms(self._seed, first, n, INITIAL, len(STATE_COLUMNS))

    def run(self, first: int, n: int, progress: Progress) -> list[Enumerated]:
        """Paths ``first … first + n - 1``, in blocks."""
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            blocks = []
            for block in threads.map(self._block, range(first, first + n, BLOCK_PATHS)):
                blocks.append(block)
                progress.advance(BLOCK_PATHS)
        return blocks

    def _block(self, first: int, n: int = BLOCK_PATHS) -> Enumerated:
        u = self.uniforms(first, n)
        weight = np.ones(n)
        drawn = uniforms(self._seed, first, n, DIAGNOSTIC, 2)
        offset = (drawn[:, OFFSET_DRAW] * self._stride).astype(np.int64)
        if self._proposal is not None:
            u, weight = self._proposal.map(u, drawn[:, AIMED_DRAW])
        state = self._states.from_uniforms(u)
        probability = np.zeros((n, self._max_steps))
        crashes = np.zeros((n, self._max_steps), np.int64)
        path = empty_trajectory(self._environment)
        where = self._environment, self._drivers, self._envelope
        enumerate_cut_ins(self._seed, first, state, *where, self._stride, offset, path, probability, crashes)
        return Enumerated(first, weight, state, probability, crashes)

    def pairs(
        self, path: IntArray, step: IntArray, state: RecordArray
    ) -> tuple[Int8Array, Int8Array, IntArray, IntArray]:
        """Maneuvers of chosen (path, cut-in step) pairs: LV's and BV's (n, draws), and how many of each (n,)."""
        room = empty_trajectory(self._environment)
        n, draws = len(path), room.lv.size
        lv, bv = np.zeros((n, draws), np.int8), np.zeros((n, draws), np.int8)
        n_lv, n_bv = np.zeros(n, np.int64), np.zeros(n, np.int64)
        write_pairs(self._seed, path, step, state, self._environment, room, lv, bv, n_lv, n_bv)
        return lv, bv, n_lv, n_bv


def build_pool(
    environment: Environment, library: Library, settings: PoolSettings, key: str, progress: Progress | None = None
) -> Pool:
    """Build a pool in the twin.

    Parameters
    ----------
    environment : Environment
    library : Library
    settings : PoolSettings
        Seed, relative error to reach, and how many cut-ins to keep of each shell.
    key : str
        Content hash that the pool will carry.
    """
    progress = progress or SilentProgress()
    names = list(library.surrogates)
    pilot = Enumerator(environment, library.drivers, names.index(library.envelope), settings.seed ^ _APART)
    progress.stage("pool: pilot", PILOT_PATHS)
    rates = _joined(pilot.run(0, PILOT_PATHS, progress), len(names))
    careful = _careful(rates, names.index(library.boundary))
    aimed = pilot.aimed(fit_proposal(pilot.uniforms(0, PILOT_PATHS), _importance(rates, careful)))
    blocks = _until_known(aimed, rates, careful, settings, progress)
    return _pool(blocks, aimed, library, settings, (key, environment_hash(environment)))


def _joined(blocks: list[Enumerated], n_surrogates: int) -> FloatArray:
    return np.concatenate([block.rates(n_surrogates) for block in blocks])


def _careful(rates: FloatArray, boundary: int) -> BoolArray:
    """Which columns (surrogates, and the cut-in) are to be known well, shape (D + 1,) bool.

    Those that are no more careless than the boundary, and crash in the traffic that it crashes in.
    """
    mean = rates.mean(0)
    relvar = rates.var(0) / np.maximum(mean, np.finfo(np.float64).tiny) ** 2
    careful: BoolArray = (mean <= mean[boundary]) & (relvar <= FAR_OFF * relvar[boundary])
    return careful


def _importance(rates: FloatArray, careful: BoolArray) -> FloatArray:
    """What a path contributes to all crash rates together, each relative to its mean, shape (n,)."""
    mean = rates.mean(0)
    relative = rates / np.where(mean > 0.0, mean, 1.0)
    share = np.where(careful, 1.0, CARELESS_SHARE)
    importance: FloatArray = np.sqrt((relative * relative * share).sum(1))
    return importance


def _until_known(
    aimed: Enumerator, pilot: FloatArray, careful: BoolArray, settings: PoolSettings, progress: Progress
) -> list[Enumerated]:
    """Enumerate paths until the relative errors are small enough; what is left of them is part of every interval."""
    wanted = settings.relative_error * np.where(careful, 1.0, CARELESS_ERROR)
    progress.stage("pool of cut-ins", _paths_needed(pilot, wanted))
    blocks: list[Enumerated] = []
    rates = np.zeros((0, pilot.shape[1]))
    while len(rates) < MOST_PATHS:
        done = aimed.run(PILOT_PATHS + len(rates), ROUND_PATHS, progress)
        blocks.extend(done)
        rates = np.concatenate([rates, _joined(done, pilot.shape[1] - 1)])
        mean = rates.mean(0)
        known = mean > 0.0
        error = rates.std(0)[known] / np.sqrt(len(rates)) / mean[known]
        progress.status(error=f"{error[careful[known]].max(initial=0.0):.2%}")
        if np.all(error <= wanted[known]):
            break
    return blocks


def _paths_needed(pilot: FloatArray, wanted: FloatArray) -> int:
    """Rough number of paths, for the progress bar: aiming about halves the squared error of the pilot's."""
    mean = pilot.mean(0)
    known = mean > 0.0
    relvar = pilot.var(0)[known] / mean[known] ** 2
    needed = 0.5 * float((relvar / wanted[known] ** 2).max(initial=1.0))
    return min(MOST_PATHS, -(-int(needed) // ROUND_PATHS) * ROUND_PATHS)


def _pool(
    blocks: list[Enumerated], enumerator: Enumerator, library: Library, settings: PoolSettings, hashes: tuple[str, str]
) -> Pool:
    """Order the surrogates, sort the cut-ins into shells, and keep a sample of each."""
    n_surrogates = len(library.surrogates)
    rates = _joined(blocks, n_surrogates)
    n = len(rates)
    order = np.argsort(rates[:, :n_surrogates].mean(0), kind="stable")
    mass = np.concatenate([block.probability * block.weight[:, None] for block in blocks])
    crashes = np.concatenate([block.crashes for block in blocks])
    shell = shells_of(crashes, order)
    by_path = np.column_stack([np.where(shell == s, mass, 0.0).sum(1) for s in range(n_surrogates + 1)])
    ordered = rates[:, order]
    path, step, kept_shell = _keep(mass, shell, n_surrogates + 1, settings)
    state = np.concatenate([block.state for block in blocks])[path]
    index = blocks[0].first + path
    lv, bv, n_lv, n_bv = enumerator.pairs(index, step, state)
    bits = crashes[path, step]
    return Pool(
        key=hashes[0],
        environment=hashes[1],
        library=library,
        names=tuple(np.array(list(library.surrogates))[order].tolist()),
        n_paths=n,
        p_cut_in=float(rates[:, -1].mean()),
        p_cut_in_se=float(rates[:, -1].std() / np.sqrt(n)),
        mu=ordered.mean(0),
        mu_covariance=np.atleast_2d(np.cov(ordered.T, bias=True)) / n,
        shell_p=by_path.mean(0),
        shell_moments=by_path.T @ by_path / n,
        cut_ins=CutIns(
            index, step, kept_shell, state, lv, bv, n_lv, n_bv, ((bits[:, None] >> order[None, :]) & 1).astype(np.bool_)
        ),
    )


def _keep(
    mass: FloatArray, shell: Int8Array, n_shells: int, settings: PoolSettings
) -> tuple[IntArray, IntArray, IntArray]:
    """Systematic sample of cut-ins of every shell, with probability proportional to mass.

    Returns
    -------
    path, step, shell : ndarray, shape (n,)
        Row and column in ``mass``, and the shell, sorted by shell and path.
    """
    paths, steps, shells = [], [], []
    for s in range(n_shells):
        places = np.flatnonzero((shell == s) & (mass > 0.0))
        if places.size == 0:
            continue
        cumulative = np.cumsum(mass.ravel()[places])
        offset = uniforms(settings.seed, s, 1, DIAGNOSTIC, KEEP_DRAW + 1)[0, KEEP_DRAW]
        wanted = (offset + np.arange(settings.cut_ins_per_shell)) * (cumulative[-1] / settings.cut_ins_per_shell)
        chosen = places[np.minimum(np.searchsorted(cumulative, wanted, side="right"), places.size - 1)]
        paths.append(chosen // mass.shape[1])
        steps.append(chosen % mass.shape[1])
        shells.append(np.full(chosen.size, s, np.int64))
    return np.concatenate(paths), np.concatenate(steps), np.concatenate(shells)
