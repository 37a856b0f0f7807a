"""Named chains: crash probabilities from about 1e-3 to 1e-9, surrogates that are right, partly and wholly wrong."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.vocabulary import FloatArray
from studies.chains.chain import Chain

N_APPROACH = 6
N_DANGER = 4
P_BRAKE = 0.05
NOISE = 0.02


def overtaking(
    name: str, *, skill: float, surrogates: list[float], level: float, horizon: int, **settings: Any
) -> Chain:
    """Chain of a vehicle with a skill in (0, 1), tested with surrogates of other skills.

    A skilled vehicle leaves danger fast. `level` is the probability of a cut-in per step at the closest approach.
    """
    return Chain(
        name=name,
        horizon=horizon,
        start=np.array([0.0, 0.0, 0.0, 0.2, 0.3, 0.5]),
        approach=_approach(closer=0.5, wait=0.35, back=0.15),
        hazard=level * np.array([0.0, 1.0, 0.9, 0.7, 0.4, 0.2]),
        entry=_entry(),
        exposure=np.tile([1.0 - P_BRAKE, P_BRAKE], (N_DANGER, 1)),
        response=_skilled(skill),
        surrogate_responses=np.stack([_skilled(s) for s in surrogates]),
        **settings,
    )


def decisive(name: str, *, skill: float, surrogates: list[float], level: float, horizon: int, brake: float) -> Chain:
    """Chain in which maneuvers decide nearly everything: little noise, hard braking after a certain approach."""
    return Chain(
        name=name,
        horizon=horizon,
        start=np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
        approach=_approach(closer=0.9, wait=0.1, back=0.0),
        hazard=level * np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
        entry=_entry(),
        exposure=np.tile([1.0 - brake, brake], (N_DANGER, 1)),
        response=_decisive(skill),
        surrogate_responses=np.stack([_decisive(s) for s in surrogates]),
    )


def _approach(closer: float, wait: float, back: float) -> FloatArray:
    """State 0 is passed; the others come closer, wait, or fall back."""
    table = np.zeros((N_APPROACH, N_APPROACH))
    table[0, 0] = 1.0
    for g in range(1, N_APPROACH):
        table[g, g - 1] += closer
        table[g, g] += wait
        table[g, min(g + 1, N_APPROACH - 1)] += back
    return table


def _entry() -> FloatArray:
    """The closer the cut-in, the more danger; cutting in at the largest distance is safe."""
    table = np.zeros((N_APPROACH, N_DANGER + 2))
    table[[0, 5], N_DANGER] = 1.0
    table[4, 0] = 1.0
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


def panel() -> list[Chain]:
    """Chains that every estimator must get right."""
    return [
        overtaking("frequent", skill=0.5, surrogates=[0.5, 0.3, 0.8], level=0.02, horizon=8),
        overtaking("one surrogate right", skill=0.7, surrogates=[0.7, 0.2], level=1e-3, horizon=10),
        overtaking("all surrogates wrong", skill=0.7, surrogates=[0.3, 0.55], level=3e-5, horizon=10),
        overtaking("rare", skill=0.9, surrogates=[0.9, 0.5, 0.7], level=1e-5, horizon=12),
        overtaking("very rare", skill=0.97, surrogates=[0.95, 0.7], level=1e-6, horizon=12),
    ]


def frequent_decisive() -> Chain:
    """Crash probability 1.2e-2; its step mixture's Y is well explained by products of ratios."""
    return decisive("decisive", skill=0.3, surrogates=[0.9, 0.3, 0.0], level=0.05, horizon=5, brake=0.2)


def rare_decisive() -> Chain:
    """Crash probability 6e-6, otherwise alike."""
    return decisive("rare decisive", skill=1.0, surrogates=[0.9, 0.6, 0.3], level=1e-3, horizon=5, brake=0.01)


def replayed() -> list[Chain]:
    """Chains whose surrogates can be replayed on the vehicle's paths: good, partly and wholly wrong, strong noise."""
    return [
        overtaking("good surrogates", skill=0.7, surrogates=[0.8, 0.65, 0.5], level=0.02, horizon=8, noise="shared"),
        overtaking("partly wrong", skill=0.55, surrogates=[0.9, 0.75], level=0.02, horizon=8, noise="shared"),
        overtaking("wholly wrong", skill=0.6, surrogates=[0.8, 0.6], level=0.02, horizon=8, noise="opposite"),
        overtaking("strong noise", skill=0.6, surrogates=[0.75, 0.6, 0.45], level=0.02, horizon=8, noise="own"),
    ]


CHAINS: dict[str, Chain] = {
    chain.name: chain for chain in [*panel(), *replayed(), frequent_decisive(), rare_decisive()]
}
"""Chains that an experiment can name."""
