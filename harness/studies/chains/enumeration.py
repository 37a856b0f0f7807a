"""All episodes of a small chain with their exact probabilities under p, and their ratios under either mixture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from harness.arrays import BoolArray, FloatArray, IntArray
from harness.studies.chains.chain import Chain
from harness.studies.chains.sampler import mixture_weights


@dataclass(frozen=True, eq=False)
class Episodes:
    """Every episode that p can draw: probability (k,), q_j/p for all M components (k, M), whether it crashes (k,)."""

    p: FloatArray
    ratios: FloatArray
    crash: BoolArray
    alpha: FloatArray

    @property
    def mixture(self) -> FloatArray:
        """q_alpha/p."""
        return self.ratios @ self.alpha

    def expect(self, values: FloatArray) -> FloatArray:
        """Expectation under q_alpha of values, one row per episode."""
        return (self.p * self.mixture) @ values


def enumerate_episodes(chain: Chain) -> Episodes:
    """Episodes of the chain under the episode mixture, with the forced cut-in as component 0."""
    rows = [row for path, p in _paths(chain) for row in _episodes(chain, path, p)]
    p, ratios, crash = zip(*rows, strict=True)
    return Episodes(np.array(p), np.array(ratios), np.array(crash), mixture_weights(chain, "episode_mixture"))


def _paths(chain: Chain) -> Iterator[tuple[list[int], float]]:
    """Staying paths with their probabilities."""
    paths = [([g], float(p)) for g, p in enumerate(chain.start) if p > 0.0]
    for _ in range(chain.horizon - 1):
        paths = [
            ([*path, g], p * float(step))
            for path, p in paths
            for g, step in enumerate(chain.approach[path[-1]])
            if step > 0.0
        ]
    return iter(paths)


def _episodes(chain: Chain, path: list[int], p_path: float) -> Iterator[tuple[float, FloatArray, bool]]:
    """Episodes on one staying path: no cut-in, or a cut-in at each step with everything that can follow."""
    hazard = chain.hazard[path]
    p_cut = 1.0 - float(np.prod(1.0 - hazard))
    p, ratios = p_path, np.ones(chain.n_surrogates)
    for t, g in enumerate(path):
        q = chain.proposals.cut[:, t, g]
        if hazard[t] > 0.0:
            for d in np.flatnonzero(chain.entry[g]):
                start = p * hazard[t] * chain.entry[g, d], ratios * q / hazard[t], int(d)
                for weight, ratio, crash in _after(chain, t + 1, *start):
                    yield weight, np.concatenate([[1.0 / p_cut], ratio]), crash
        p, ratios = p * (1.0 - hazard[t]), ratios * (1.0 - q) / (1.0 - hazard[t])
    yield p, np.concatenate([[0.0], ratios]), False


def _after(chain: Chain, t: int, p: float, ratios: FloatArray, d: int) -> Iterator[tuple[float, FloatArray, bool]]:
    if t == chain.horizon or d >= chain.crashed - 1:
        yield p, ratios, d == chain.crashed
        return
    for a, exposure in enumerate(chain.exposure[d]):
        q = chain.proposals.maneuver[:, t, d, a]
        for following in np.flatnonzero(chain.response[d, a]):
            weight = p * exposure * chain.response[d, a, following]
            yield from _after(chain, t + 1, weight, ratios * q / exposure, int(following))


@dataclass(frozen=True, eq=False)
class StepEpisodes:
    """Every episode under the step mixture with equal weights.

    Probability under p (k,), q_j/p of each control step (k, T, J), 1 beyond the last one, how many there are (k,), and
    whether it crashes (k,).
    """

    p: FloatArray
    ratios: FloatArray
    n_control_steps: IntArray
    crash: BoolArray

    @property
    def mixture(self) -> FloatArray:
        """q_alpha/p."""
        return np.asarray(self.ratios.mean(axis=2).prod(axis=1))


def enumerate_step_mixture(chain: Chain) -> StepEpisodes:
    """Episodes of the chain, with the ratios of every control step."""
    rows = [row for path, p in _paths(chain) for row in _controlled(chain, path, p)]
    p, controlled, crash = zip(*rows, strict=True)
    ratios = np.ones((len(p), max(map(len, controlled)), chain.n_surrogates))
    for row, steps in enumerate(controlled):
        for t, step in enumerate(steps):
            ratios[row, t] = step
    return StepEpisodes(np.array(p), ratios, np.array([len(steps) for steps in controlled]), np.array(crash))


_Controlled = tuple[float, list[FloatArray], bool]


def _controlled(chain: Chain, path: list[int], p: float) -> Iterator[_Controlled]:
    """As `_episodes`, step by step."""
    before: list[FloatArray] = []
    for t, g in enumerate(path):
        hazard, q = float(chain.hazard[g]), chain.proposals.cut[:, t, g]
        critical = bool(chain.proposals.critical_before[t, g])
        if hazard > 0.0:
            here = [*before, q / hazard] if critical else before
            for d in np.flatnonzero(chain.entry[g]):
                yield from _controlled_after(chain, t + 1, p * hazard * float(chain.entry[g, d]), here, int(d))
        p *= 1.0 - hazard
        before = [*before, (1.0 - q) / (1.0 - hazard)] if critical else before
    yield p, before, False


def _controlled_after(chain: Chain, t: int, p: float, before: list[FloatArray], d: int) -> Iterator[_Controlled]:
    if t == chain.horizon or d >= chain.crashed - 1:
        yield p, before, d == chain.crashed
        return
    critical = bool(chain.proposals.critical_after[t, d])
    for a, exposure in enumerate(chain.exposure[d]):
        here = [*before, chain.proposals.maneuver[:, t, d, a] / exposure] if critical else before
        for following in np.flatnonzero(chain.response[d, a]):
            weight = p * float(exposure) * float(chain.response[d, a, following])
            yield from _controlled_after(chain, t + 1, weight, here, int(following))
