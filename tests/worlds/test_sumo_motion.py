"""One step of SUMO, for any two speeds, is `next_position` to the last bit: standstill included."""

from __future__ import annotations

import libsumo
import numpy as np
import pytest

from harness.vehicles.kinematics import STEP_S, next_position
from harness.vocabulary import AV, BV, LV, VEHICLES

CELLS, ROUNDS, SEED = 64, 40, 20_261_121


def log_uniform(random: np.random.Generator, low: float, high: float, shape: int | tuple[int, int]) -> np.ndarray:
    return np.exp(random.uniform(np.log(low), np.log(high), shape))


def random_positions(random: np.random.Generator) -> np.ndarray:
    """Positions (CELLS, 3) at which nobody touches anybody; near the road's start floats are fine enough to differ."""
    x = np.empty((CELLS, 3))
    x[:, AV] = log_uniform(random, 0.1, 3000.0, CELLS)
    x[:, BV] = log_uniform(random, 0.1, 2000.0, CELLS)
    x[:, LV] = x[:, BV] + random.uniform(100.0, 1500.0, CELLS)
    return x


def driven(random: np.random.Generator, before: np.ndarray) -> np.ndarray:
    return np.maximum(before + random.integers(-100, 51, before.shape) / 5.0 * STEP_S, 0.0)


SHAPE = CELLS, 3
SPEEDS = {
    "any change": lambda random: (random.uniform(0.0, 45.0, SHAPE), random.uniform(0.0, 45.0, SHAPE)),
    "driving": lambda random: (before := random.uniform(0.0, 45.0, SHAPE), driven(random, before)),
    "braking to a stop": lambda random: (random.uniform(0.0, 2.0, SHAPE), np.zeros(SHAPE)),
    "stopping from any speed": lambda random: (log_uniform(random, 1e-12, 45.0, SHAPE), np.zeros(SHAPE)),
    "driving off": lambda random: (np.zeros(SHAPE), random.uniform(0.0, 2.0, SHAPE)),
}
"""Speeds before and after a step."""


@pytest.mark.parametrize("vanilla", [False, True])
@pytest.mark.parametrize("speeds", SPEEDS)
def test_a_step_of_sumo_is_the_formula_in_every_bit(speeds, vanilla, open_world):
    random = np.random.default_rng(SEED)
    world = open_world(CELLS, vanilla=vanilla)
    everywhere, nobody = np.arange(CELLS), np.zeros(CELLS, np.int8)
    for _ in range(ROUNDS):
        x, (before, after) = random_positions(random), SPEEDS[speeds](random)
        world.place(everywhere, x, before)
        world.step(after, nobody)
        for k in range(CELLS):
            for vehicle, name in enumerate(VEHICLES):
                expected = next_position(x[k, vehicle], before[k, vehicle], after[k, vehicle])
                assert libsumo.vehicle.getLanePosition(f"{name}{k}").hex() == expected.hex()
                assert libsumo.vehicle.getSpeed(f"{name}{k}").hex() == float(after[k, vehicle]).hex()


def test_these_samples_tell_sumos_formula_from_the_textbooks():
    random = np.random.default_rng(SEED)
    x = np.concatenate([random_positions(random)[:, BV] for _ in range(ROUNDS)])
    speed = random.uniform(0.0, 2.0, x.size)
    textbook = x + 0.5 * (speed + 0.0) * STEP_S
    exact = np.array([next_position(*pair, 0.0) for pair in zip(x, speed, strict=True)])
    assert (textbook != exact).sum() >= 5
    np.testing.assert_allclose(textbook, exact, rtol=1e-14)
