"""Named chains: crash probabilities from about 1e-3 to 1e-9, surrogates that are right, partly and wholly wrong."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.arrays import FloatArray
from harness.studies.chains.chain import Chain

N_APPROACH = 6
N_DANGER = 4
P_BRAKE = 0.05


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
        approach=_approach(),
        hazard=level * np.array([0.0, 1.0, 0.9, 0.7, 0.4, 0.2]),
        entry=_entry(),
        exposure=np.tile([1.0 - P_BRAKE, P_BRAKE], (N_DANGER, 1)),
        response=response(skill),
        surrogate_responses=np.stack([response(s) for s in surrogates]),
        **settings,
    )


def _approach() -> FloatArray:
    """State 0 is passed; the others come closer, wait, or fall back."""
    table = np.zeros((N_APPROACH, N_APPROACH))
    table[0, 0] = 1.0
    for g in range(1, N_APPROACH):
        table[g, g - 1] += 0.5
        table[g, g] += 0.35
        table[g, min(g + 1, N_APPROACH - 1)] += 0.15
    return table


def _entry() -> FloatArray:
    """The closer the cut-in, the more danger; cutting in at the largest distance is safe."""
    table = np.zeros((N_APPROACH, N_DANGER + 2))
    table[0, N_DANGER] = 1.0
    table[1, [3, 2]] = 0.6, 0.4
    table[2, [2, 1]] = 0.6, 0.4
    table[3, [1, 0]] = 0.6, 0.4
    table[4, 0] = 1.0
    table[5, N_DANGER] = 1.0
    return table


def response(skill: float) -> FloatArray:
    """Danger goes down with skill, up without it, faster while the BV brakes (maneuver 1)."""
    table = np.zeros((N_DANGER, 2, N_DANGER + 2))
    for d in range(N_DANGER):
        for braking, (escape, worsen) in enumerate(((1.0, 0.2), (0.4, 0.8))):
            down, up = skill * escape, (1.0 - skill) * worsen
            table[d, braking, d - 1 if d > 0 else N_DANGER] += down
            table[d, braking, d + 1 if d < N_DANGER - 1 else N_DANGER + 1] += up
            table[d, braking, d] += 1.0 - down - up
    return table


def decisive_response(skill: float, noise: float) -> FloatArray:
    """A vehicle with little noise: danger falls by skill while the BV keeps on, and rises while it brakes."""
    table = np.zeros((N_DANGER, 2, N_DANGER + 2))
    for d in range(N_DANGER):
        table[d, 0, d - 1 if d > 0 else N_DANGER] += skill * (1.0 - noise)
        table[d, 0, d] += 1.0 - skill * (1.0 - noise)
        table[d, 1, d + 1 if d < N_DANGER - 1 else N_DANGER + 1] += 1.0 - noise
        table[d, 1, d] += noise
    return table


def decisive(name: str, *, skill: float, surrogates: list[float], level: float, horizon: int, brake: float) -> Chain:
    """Chain in which maneuvers decide nearly everything: little noise, hard braking after a certain approach."""
    approach = np.zeros((N_APPROACH, N_APPROACH))
    approach[0, 0] = 1.0
    for g in range(1, N_APPROACH):
        approach[g, g - 1], approach[g, g] = 0.9, 0.1
    return Chain(
        name=name,
        horizon=horizon,
        start=np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
        approach=approach,
        hazard=level * np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
        entry=_entry(),
        exposure=np.tile([1.0 - brake, brake], (N_DANGER, 1)),
        response=decisive_response(skill, 0.02),
        surrogate_responses=np.stack([decisive_response(s, 0.02) for s in surrogates]),
    )


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
