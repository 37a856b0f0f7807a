"""Paths enumerated where crashes are: importance sampling in the five uniforms that an initial state is made from.

Each uniform gets a piecewise constant density of its own, fitted to a pilot run, as in Lepage's VEGAS (J. Comput.
Phys. 27, 1978, 192), mixed with a share of the naturalistic density that bounds every weight.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from harness.episode.path import Followers
from harness.pool.enumeration import STRIDE, enumerate_cut_ins
from harness.progress import Progress
from harness.random_stream import DIAGNOSTIC, INITIAL, uniforms
from harness.traffic.initial_state import InitialStates
from harness.traffic.laws import Environment
from harness.vocabulary import STATE_COLUMNS, FloatArray, IntArray, RecordArray

PILOT_PATHS = 2048
BLOCK_PATHS = 256
N_BINS = 16
NATURALISTIC_SHARE = 0.2
"""Weights are at most its inverse."""
AIMED_DRAW, OFFSET_DRAW = 0, 1
"""Draws of a path within the diagnostic stream."""


def aimed_points(density: FloatArray, u: FloatArray, choice: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, dimensions) drawn from a proposal, and their weights (n,): naturalistic density over the proposal's.

    The proposal is a product ``density`` (dimensions, N_BINS) on the unit cube, that within each bin with mean 1, mixed
    with the uniform one: ``choice`` (n,) are the uniforms that decide which points stay naturalistic. ``u``
    (n, dimensions) are those that become points.
    """
    edges = np.linspace(0.0, 1.0, N_BINS + 1)
    aimed = choice >= NATURALISTIC_SHARE
    points = u.copy()
    own = np.ones(len(u))
    for d, levels in enumerate(density):
        cumulative = np.concatenate([[0.0], np.cumsum(levels) / N_BINS])
        cumulative[-1] = 1.0
        points[aimed, d] = np.interp(u[aimed, d], cumulative, edges)
        own *= levels[_bin_of(points[:, d])]
    weights: FloatArray = 1.0 / (NATURALISTIC_SHARE + (1.0 - NATURALISTIC_SHARE) * own)
    return points, weights


def fit_proposal(u: FloatArray, contribution: FloatArray) -> FloatArray:
    """Density of a proposal from the uniforms (n, dimensions) of a naturalistic pilot run, and each one's part (n,).

    The best density of one variable is the root of the contribution's mean square within each bin.
    """
    density = np.ones((u.shape[1], N_BINS))
    for d in range(u.shape[1]):
        bins = _bin_of(u[:, d])
        counts = np.bincount(bins, minlength=N_BINS)
        squares = np.bincount(bins, contribution * contribution, minlength=N_BINS) / np.maximum(counts, 1)
        root = np.sqrt(squares)
        smooth = np.convolve(np.concatenate([root[:1], root, root[-1:]]), [0.25, 0.5, 0.25], "valid")
        if smooth.sum() > 0.0:
            density[d] = smooth * (N_BINS / smooth.sum())
    return density


def _bin_of(u: FloatArray) -> IntArray:
    return np.minimum((u * N_BINS).astype(np.int64), N_BINS - 1)


def contributions(rates: FloatArray, share: FloatArray | float = 1.0) -> FloatArray:
    """What each path adds to all rates together, each relative to its mean, shape (n,).

    ``rates`` (n, columns) are those of the paths; a column counts by its ``share``.
    """
    mean = rates.mean(0)
    relative = rates / np.where(mean > 0.0, mean, 1.0)
    found: FloatArray = np.sqrt((relative * relative * share).sum(1))
    return found


@dataclass(frozen=True, eq=False)
class EnumeratedPaths:
    """Initial states (n,) of some paths, and their cut-ins.

    ``index`` (n,) are their numbers, ``weight`` (n,) the naturalistic over the proposal's density. ``mass`` (n, steps)
    is the probability of the cut-ins that one in this step stands for, times the weight; ``crashes`` (n, steps) has one
    bit per surrogate, as the library orders them.
    """

    index: IntArray
    state: RecordArray
    weight: FloatArray
    mass: FloatArray
    crashes: IntArray

    def rates(self, n_surrogates: int) -> FloatArray:
        """Per path: its weighted probability that each surrogate crashes, and of a cut-in; shape (n, D + 1)."""
        columns = [(self.mass * ((self.crashes >> d) & 1)).sum(1) for d in range(n_surrogates)]
        return np.column_stack([*columns, self.mass.sum(1)])


def joined(parts: Iterable[EnumeratedPaths]) -> EnumeratedPaths:
    """Consecutive paths in one."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return EnumeratedPaths(*map(np.concatenate, columns))


class Enumerator:
    """Enumerates consecutive paths of one environment, on all cores; the number of cores changes no bit."""

    def __init__(
        self,
        environment: Environment,
        followers: Followers,
        seed: int,
        proposal: FloatArray | None = None,
        stride: int = STRIDE,
    ) -> None:
        self._environment, self._followers, self._seed = environment, followers, seed
        self._proposal, self._stride = proposal, stride
        self._states = InitialStates(environment.numbers)
        # Compiled here, by one thread: of two that want a new kernel at once, the second would have to wait for
        # whatever else is compiled meanwhile.
        self._block(0, 0)

    def aimed(self, rates: FloatArray, share: FloatArray | float = 1.0) -> Enumerator:
        """The same, aimed at what contributes to the rates (n, columns) of its first paths; see `contributions`."""
        proposal = fit_proposal(self.uniforms(0, len(rates)), contributions(rates, share))
        return Enumerator(self._environment, self._followers, self._seed, proposal, self._stride)

    def uniforms(self, first: int, n: int) -> FloatArray:
        """Uniforms of the initial states of consecutive paths, shape (n, 5)."""
        return uniforms(self._seed, first, n, INITIAL, len(STATE_COLUMNS))

    def run(self, first: int, n: int, progress: Progress) -> EnumeratedPaths:
        """Paths ``first … first + n - 1``; ``n`` is a multiple of `BLOCK_PATHS`."""
        blocks: list[EnumeratedPaths] = []
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            for block in threads.map(self._block, range(first, first + n, BLOCK_PATHS)):
                blocks.append(block)
                progress.advance(BLOCK_PATHS)
        return joined(blocks)

    def _block(self, first: int, n: int = BLOCK_PATHS) -> EnumeratedPaths:
        u, weight = self.uniforms(first, n), np.ones(n)
        drawn = uniforms(self._seed, first, n, DIAGNOSTIC, 2)
        offset = (drawn[:, OFFSET_DRAW] * self._stride).astype(np.int64)
        if self._proposal is not None:
            u, weight = aimed_points(self._proposal, u, drawn[:, AIMED_DRAW])
        index, state = first + np.arange(n), self._states.from_uniforms(u)
        asked = self._environment, self._followers
        found = enumerate_cut_ins(self._seed, index, state, *asked, stride=self._stride, offset=offset)
        return EnumeratedPaths(index, state, weight, found.probability * weight[:, None], found.crashes)
