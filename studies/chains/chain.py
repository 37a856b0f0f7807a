"""The chain: tables, crash rate by backward induction, importance functions of its surrogates, all of its episodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Literal

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
        p, found = np.stack([1.0 - self.hazard, self.hazard], axis=1), list[tuple[FloatArray, ...]]()
        for response in self.surrogate_responses:
            before, after = (each[1:] for each in self.values(response))
            stay = before @ self.approach.T * (self.challenge == "recursive")
            challenges = np.stack([stay, after @ self.entry.T], axis=-1), np.einsum("dae,te->tda", response, after)
            q, v = importance_function(p, challenges[0], self.epsilon)
            found.append((q[..., 1], v, *importance_function(self.exposure, challenges[1], self.epsilon), *challenges))
        cut, before, maneuver, after, *challenge = (np.stack(each) for each in zip(*found, strict=True))
        return Proposals(cut, maneuver, np.any(before > 0.0, axis=0), np.any(after > 0.0, axis=0), *challenge)


@dataclass(frozen=True, eq=False)
class Proposals:
    """q_j(cut_in | t, state) of shape (J, T, G), q_j(a | t, state) of shape (J, T, D, A), and where they act.

    ``challenge_before`` (J, T, G, 2), of staying and cutting in, and ``challenge_after`` (J, T, D, A) are C_j.
    """

    cut: FloatArray
    maneuver: FloatArray
    critical_before: BoolArray
    critical_after: BoolArray
    challenge_before: FloatArray
    challenge_after: FloatArray


def importance_function(p: FloatArray, challenge: FloatArray, epsilon: float) -> tuple[FloatArray, FloatArray]:
    """Q = ε p + (1 - ε) p C/V along the last axis, and V; q = p where V = 0 (statistics.md section 1)."""
    value = (p * challenge).sum(axis=-1)
    safe = np.where(value > 0.0, value, 1.0)[..., None]
    q = epsilon * p + (1.0 - epsilon) * p * challenge / safe
    return np.where(value[..., None] > 0.0, q, p), value


@dataclass(frozen=True, eq=False)
class Episodes:
    """Every episode that p can draw from a small chain.

    Probability under p (k,), q_j/p of each control step (k, T, J), 1 beyond the last one, C_j and V_j, 0 beyond it, how
    many there are (k,), that of forced cut-ins over p (k,), and whether it crashes (k,).
    """

    p: FloatArray
    ratios: FloatArray
    challenge: FloatArray
    value: FloatArray
    n_control_steps: IntArray
    forced: FloatArray
    crash: BoolArray

    @property
    def mixture(self) -> FloatArray:
        """q_alpha/p under the step mixture with equal weights."""
        return np.asarray(self.ratios.mean(axis=2).prod(axis=1))


_Row = tuple[float, list[FloatArray], bool]
"""Probability, q_j/p with C_j and V_j of each control step (3, J), whether it crashes."""


def enumerate_episodes(chain: Chain) -> Episodes:
    """All episodes of the chain."""
    p, controlled, crash, forced = zip(*_episodes(chain), strict=True)
    n_control_steps = np.array([len(steps) for steps in controlled])
    found = np.zeros((len(p), n_control_steps.max(), 3, chain.n_surrogates))
    found[:, :, 0] = 1.0
    found[np.arange(found.shape[1]) < n_control_steps[:, None]] = [step for steps in controlled for step in steps]
    ratios, challenge, value = (found[:, :, k] for k in range(3))
    return Episodes(np.array(p), ratios, challenge, value, n_control_steps, np.array(forced), np.array(crash))


def _episodes(chain: Chain) -> Iterator[tuple[float, list[FloatArray], bool, float]]:
    """On each staying path no cut-in, or a cut-in at each step with everything that can follow; with forced over p."""
    for path in product(*[range(len(chain.start))] * chain.horizon):
        p = float(chain.start[path[0]] * np.prod(chain.approach[path[:-1], path[1:]]))
        if p == 0.0:
            continue
        p_cut, before = 1.0 - float(np.prod(1.0 - chain.hazard[[*path]])), list[FloatArray]()
        for t, g in enumerate(path):
            hazard, q = float(chain.hazard[g]), chain.proposals.cut[:, t, g]
            critical, challenge = bool(chain.proposals.critical_before[t, g]), chain.proposals.challenge_before[:, t, g]
            value = challenge @ [1.0 - hazard, hazard]
            if hazard > 0.0:
                here = [*before, np.stack([q / hazard, challenge[:, 1], value])] if critical else before
                for d in np.flatnonzero(chain.entry[g]).tolist():
                    for row in _after(chain, t + 1, p * hazard * float(chain.entry[g, d]), here, d):
                        yield *row, 1.0 / p_cut
            p *= 1.0 - hazard
            stayed = np.stack([(1.0 - q) / (1.0 - hazard), challenge[:, 0], value])
            before = [*before, stayed] if critical else before
        yield p, before, False, 0.0


def _after(chain: Chain, t: int, p: float, before: list[FloatArray], d: int) -> Iterator[_Row]:
    if t == chain.horizon or d >= chain.crashed - 1:
        yield p, before, d == chain.crashed
        return
    critical, challenge = bool(chain.proposals.critical_after[t, d]), chain.proposals.challenge_after[:, t, d]
    value = challenge @ chain.exposure[d]
    for a, exposure in enumerate(chain.exposure[d]):
        ratio = chain.proposals.maneuver[:, t, d, a] / exposure
        here = [*before, np.stack([ratio, challenge[:, a], value])] if critical else before
        for following in np.flatnonzero(chain.response[d, a]).tolist():
            weight = p * float(exposure) * float(chain.response[d, a, following])
            yield from _after(chain, t + 1, weight, here, following)


N_APPROACH = 6
N_DANGER = 4
P_BRAKE = 0.05
NOISE = 0.02


def overtaking(
    name: str, *, level: float, skill: float, surrogates: list[float], brake: float = P_BRAKE, **settings: Any
) -> Chain:
    """Chain of a vehicle with a ``skill`` in (0, 1), tested with ``surrogates`` of other skills.

    A skilled vehicle leaves danger fast. ``level`` is the probability of a cut-in per step at the closest approach.
    """
    tables: dict[str, Any] = {
        "start": np.array([0.0, 0.0, 0.0, 0.2, 0.3, 0.5]),
        "hazard": level * np.array([0.0, 1.0, 0.9, 0.7, 0.4, 0.2]),
        "approach": _approach(closer=0.5, wait=0.35, back=0.15),
        "exposure": np.tile([1.0 - brake, brake], (N_DANGER, 1)),
        "response": _skilled(skill),
        "surrogate_responses": np.stack(list(map(_skilled, surrogates))),
    }
    return Chain(name=name, entry=_entry(), **tables | settings)


def decisive(name: str, *, level: float, skill: float, surrogates: list[float], **settings: Any) -> Chain:
    """Chain in which maneuvers decide nearly everything: little noise, hard braking after a certain approach."""
    tables: dict[str, Any] = {
        "start": np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
        "hazard": level * np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
        "approach": _approach(closer=0.9, wait=0.1, back=0.0),
        "response": _decisive(skill),
        "surrogate_responses": np.stack(list(map(_decisive, surrogates))),
    }
    return overtaking(name, level=level, skill=skill, surrogates=surrogates, **tables | settings)


def _approach(closer: float, wait: float, back: float) -> FloatArray:
    """State 0 is passed; the others come closer, wait, or fall back."""
    table = closer * np.eye(N_APPROACH, k=-1) + wait * np.eye(N_APPROACH) + back * np.eye(N_APPROACH, k=1)
    table[0], table[-1, -1] = np.eye(N_APPROACH)[0], wait + back
    return table


def _entry() -> FloatArray:
    """The closer the cut-in, the more danger; cutting in at the largest distance is safe."""
    table = np.zeros((N_APPROACH, N_DANGER + 2))
    table[[0, 5], N_DANGER] = table[4, 0] = 1.0
    for g, states in ((1, [3, 2]), (2, [2, 1]), (3, [1, 0])):
        table[g, states] = 0.6, 0.4
    return table


def _skilled(skill: float) -> FloatArray:
    """Danger goes down with skill, up without it, faster while the BV brakes."""
    moves = (skill, (1.0 - skill) * 0.2), (skill * 0.4, (1.0 - skill) * 0.8)
    return _response(*((down, 1.0 - down - up, up) for down, up in moves))


def _decisive(skill: float) -> FloatArray:
    """Little noise: danger falls by skill while the BV keeps on, and rises while it brakes."""
    down = skill * (1.0 - NOISE)
    return _response((down, 1.0 - down, 0.0), (0.0, NOISE, 1.0 - NOISE))


def _response(*moves: tuple[float, float, float]) -> FloatArray:
    """Probabilities that danger falls, stays or rises, while the BV keeps on (maneuver 0) and while it brakes (1)."""
    table = np.zeros((N_DANGER, 2, N_DANGER + 2))
    ladder = [N_DANGER, *range(N_DANGER), N_DANGER + 1]  # safe, danger from low to high, crashed
    for d in range(N_DANGER):
        for maneuver, probabilities in enumerate(moves):
            table[d, maneuver, ladder[d : d + 3]] = probabilities
    return table


PANEL = [
    overtaking("frequent", skill=0.5, surrogates=[0.5, 0.3, 0.8], level=0.02, horizon=8),
    overtaking("one surrogate right", skill=0.7, surrogates=[0.7, 0.2], level=1e-3, horizon=10),
    overtaking("all surrogates wrong", skill=0.7, surrogates=[0.3, 0.55], level=3e-5, horizon=10),
    overtaking("rare", skill=0.9, surrogates=[0.9, 0.5, 0.7], level=1e-5, horizon=12),
    overtaking("very rare", skill=0.97, surrogates=[0.95, 0.7], level=1e-6, horizon=12),
]
"""Chains that every estimator must get right."""
REPLAYED = [
    overtaking("good surrogates", skill=0.7, surrogates=[0.8, 0.65, 0.5], level=0.02, horizon=8, noise="shared"),
    overtaking("partly wrong", skill=0.55, surrogates=[0.9, 0.75], level=0.02, horizon=8, noise="shared"),
    overtaking("wholly wrong", skill=0.6, surrogates=[0.8, 0.6], level=0.02, horizon=8, noise="opposite"),
    overtaking("strong noise", skill=0.6, surrogates=[0.75, 0.6, 0.45], level=0.02, horizon=8, noise="own"),
]
"""Chains whose surrogates can be replayed on the vehicle's paths."""
DECISIVE = [
    decisive("decisive", skill=0.3, surrogates=[0.9, 0.3, 0.0], level=0.05, horizon=5, brake=0.2),
    decisive("rare decisive", skill=1.0, surrogates=[0.9, 0.6, 0.3], level=1e-3, horizon=5, brake=0.01),
]
"""Crash probabilities 1.2e-2 and 6e-6; their step mixture's Y is well explained by products of ratios."""
CHAINS = {chain.name: chain for chain in [*PANEL, *REPLAYED, *DECISIVE]}
"""Chains that an experiment can name."""
