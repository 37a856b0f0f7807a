"""The chain: tables, crash rate by backward induction, importance functions of its surrogates, all of its episodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from harness.vocabulary import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Chain:
    """Finite chain over `horizon` steps: G states before the cut-in, D after it, then safe (index D) and crash (D + 1).

    Attributes
    ----------
    start, approach : (G,), (G, G)
        Distribution of the first state; transition when staying.
    hazard, entry : (G,), (G, D + 2)
        p(cut_in | state); state after a cut-in.
    exposure : (D, A)
        p(a | state) after the cut-in.
    response, surrogate_responses : (D, A, D + 2), (J, D, A, D + 2)
        What the vehicle under test does, and what its stand-ins do.
    noise : {"own", "shared", "opposite"}
        How the noise of a surrogate that is replayed goes with that of the vehicle, see `joint_outcomes`.
    """

    name: str
    horizon: int
    start: FloatArray
    approach: FloatArray
    hazard: FloatArray
    entry: FloatArray
    exposure: FloatArray
    response: FloatArray
    surrogate_responses: FloatArray
    challenge: Literal["immediate", "recursive"] = "recursive"
    epsilon: float = 0.1
    noise: Literal["own", "shared", "opposite"] = "own"

    @property
    def n_surrogates(self) -> int:
        """J."""
        return len(self.surrogate_responses)

    @property
    def crashed(self) -> int:
        """Number of the state that is a crash."""
        return int(self.entry.shape[1]) - 1

    @cached_property
    def crash_rate(self) -> float:
        """μ, by backward induction."""
        return float(self.start @ self.values(self.response)[0][0])

    @cached_property
    def surrogate_rates(self) -> FloatArray:
        """Crash rates that the surrogates would have as vehicles under test, shape (J,)."""
        return np.array([self.start @ self.values(response)[0][0] for response in self.surrogate_responses])

    @cached_property
    def cut_in_rate(self) -> float:
        """P(cut-in within the horizon)."""
        none = np.ones(len(self.start))
        for _ in range(self.horizon):
            none = (1.0 - self.hazard) * (self.approach @ none)
        return 1.0 - float(self.start @ none)

    @cached_property
    def cut_in_cap(self) -> float:
        """Bound on P(cut-in | path) over all paths."""
        return -float(np.expm1(self.horizon * np.log1p(-self.hazard.max())))

    @cached_property
    def step_mixture_variance(self) -> float:
        """Var(Y) of one episode under the step mixture with equal weights, by backward induction of E[Y² | state]."""
        proposals, before = self.proposals, np.zeros(len(self.start))
        after = np.zeros(self.crashed + 1)
        after[self.crashed] = 1.0
        for t in range(self.horizon - 1, -1, -1):
            cut = np.where(proposals.critical_before[t], proposals.cut[:, t].mean(axis=0), self.hazard)
            staying = (1.0 - self.hazard) ** 2 / (1.0 - cut) * (self.approach @ before)
            cutting = np.divide(self.hazard**2, cut, out=np.zeros_like(cut), where=cut > 0.0) * (self.entry @ after)
            mixed = np.where(proposals.critical_after[t][:, None], proposals.maneuver[:, t].mean(axis=0), self.exposure)
            after[:-2] = np.einsum("da,dae,e->d", self.exposure**2 / mixed, self.response, after)
            before = staying + cutting
        return float(self.start @ before) - self.crash_rate**2

    def values(self, response: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Crash probability by time and state: before (T + 1, G) and after the cut-in (T + 1, D + 2)."""
        before = np.zeros((self.horizon + 1, len(self.start)))
        after = np.zeros((self.horizon + 1, self.crashed + 1))
        after[:, self.crashed] = 1.0
        for t in range(self.horizon - 1, -1, -1):
            after[t, :-2] = np.einsum("da,dae,e->d", self.exposure, response, after[t + 1])
            cut, stay = self.entry @ after[t + 1], self.approach @ before[t + 1]
            before[t] = self.hazard * cut + (1.0 - self.hazard) * stay
        return before, after

    @cached_property
    def proposals(self) -> Proposals:
        """q_j at every time and state."""
        shape = self.n_surrogates, self.horizon
        cut, maneuver = np.empty((*shape, len(self.start))), np.empty((*shape, *self.exposure.shape))
        critical_before = np.zeros(cut.shape[1:], dtype=bool)
        critical_after = np.zeros(maneuver.shape[1:3], dtype=bool)
        p = np.stack([1.0 - self.hazard, self.hazard], axis=1)
        for j, response in enumerate(self.surrogate_responses):
            before, after = self.values(response)
            for t in range(self.horizon):
                stay = self.approach @ before[t + 1] * (self.challenge == "recursive")
                challenge = np.stack([stay, self.entry @ after[t + 1]], axis=1)
                q, v = importance_function(p, challenge, self.epsilon)
                cut[j, t] = q[:, 1]
                critical_before[t] |= v > 0.0
                maneuver[j, t], v = importance_function(self.exposure, response @ after[t + 1], self.epsilon)
                critical_after[t] |= v > 0.0
        return Proposals(cut, maneuver, critical_before, critical_after)


@dataclass(frozen=True, eq=False)
class Proposals:
    """q_j(cut_in | t, state) of shape (J, T, G), q_j(a | t, state) of shape (J, T, D, A), and where they act."""

    cut: FloatArray
    maneuver: FloatArray
    critical_before: BoolArray
    critical_after: BoolArray


def importance_function(p: FloatArray, challenge: FloatArray, epsilon: float) -> tuple[FloatArray, FloatArray]:
    """Q = ε p + (1 - ε) p C/V along the last axis, and V; q = p where V = 0 (statistics.md section 1)."""
    value = (p * challenge).sum(axis=-1)
    safe = np.where(value > 0.0, value, 1.0)[..., None]
    q = epsilon * p + (1.0 - epsilon) * p * challenge / safe
    return np.where(value[..., None] > 0.0, q, p), value


@dataclass(frozen=True, eq=False)
class Episodes:
    """Every episode that p can draw from a small chain.

    Probability under p (k,), q_j/p of each control step (k, T, J), 1 beyond the last one, how many there are (k,), that
    of forced cut-ins over p (k,), and whether it crashes (k,).
    """

    p: FloatArray
    ratios: FloatArray
    n_control_steps: IntArray
    forced: FloatArray
    crash: BoolArray

    @property
    def mixture(self) -> FloatArray:
        """q_alpha/p under the step mixture with equal weights."""
        return np.asarray(self.ratios.mean(axis=2).prod(axis=1))


_Row = tuple[float, list[FloatArray], bool]
"""Probability, q_j/p of each control step, whether it crashes."""


def enumerate_episodes(chain: Chain) -> Episodes:
    """All episodes of the chain."""
    rows = [row for path, p in _paths(chain) for row in _episodes(chain, path, p)]
    (p, controlled, crash), forced = zip(*(row for row, _ in rows), strict=True), [forced for _, forced in rows]
    ratios = np.ones((len(p), max(map(len, controlled)), chain.n_surrogates))
    for row, steps in enumerate(controlled):
        for t, step in enumerate(steps):
            ratios[row, t] = step
    n_control_steps = np.array([len(steps) for steps in controlled])
    return Episodes(np.array(p), ratios, n_control_steps, np.array(forced), np.array(crash))


def _paths(chain: Chain) -> list[tuple[list[int], float]]:
    """Staying paths with their probabilities."""
    paths = [([g], float(p)) for g, p in enumerate(chain.start) if p > 0.0]
    for _ in range(chain.horizon - 1):
        paths = [
            ([*path, g], p * float(step))
            for path, p in paths
            for g, step in enumerate(chain.approach[path[-1]])
            if step > 0.0
        ]
    return paths


def _episodes(chain: Chain, path: list[int], p: float) -> Iterator[tuple[_Row, float]]:
    """On one staying path: no cut-in, or a cut-in at each step with everything that can follow."""
    p_cut = 1.0 - float(np.prod(1.0 - chain.hazard[path]))
    before: list[FloatArray] = []
    for t, g in enumerate(path):
        hazard, q = float(chain.hazard[g]), chain.proposals.cut[:, t, g]
        critical = bool(chain.proposals.critical_before[t, g])
        if hazard > 0.0:
            here = [*before, q / hazard] if critical else before
            for d in np.flatnonzero(chain.entry[g]):
                for row in _after(chain, t + 1, p * hazard * float(chain.entry[g, d]), here, int(d)):
                    yield row, 1.0 / p_cut
        p *= 1.0 - hazard
        before = [*before, (1.0 - q) / (1.0 - hazard)] if critical else before
    yield (p, before, False), 0.0


def _after(chain: Chain, t: int, p: float, before: list[FloatArray], d: int) -> Iterator[_Row]:
    if t == chain.horizon or d >= chain.crashed - 1:
        yield p, before, d == chain.crashed
        return
    critical = bool(chain.proposals.critical_after[t, d])
    for a, exposure in enumerate(chain.exposure[d]):
        here = [*before, chain.proposals.maneuver[:, t, d, a] / exposure] if critical else before
        for following in np.flatnonzero(chain.response[d, a]):
            weight = p * float(exposure) * float(chain.response[d, a, following])
            yield from _after(chain, t + 1, weight, here, int(following))
