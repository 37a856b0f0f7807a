"""The immediate challenge against a direct roll-out.

Interpolated smallest gaps may differ in sign from the roll-out's only where it is a near miss or a near hit.
"""

import numpy as np
import pytest

from harness.vehicles.kinematics import CONTACT_M
from tests.chains.seed import SEED
from tests.episode.twin_runs import SURROGATES, prepared
from tests.importance import simulation
from tests.importance.kernels import tabulated

KEEP_SPEED = 20
ALLOWED_SHARE = {"SM-I": 0.001, "SM-III": 0.002}


@pytest.fixture(scope="module")
def tables():
    return prepared("step_mixture", "immediate", surrogates="two").tables


@pytest.fixture(scope="module")
def states():
    rng = np.random.default_rng(SEED)
    anywhere = rng.uniform([15.0, 0.1, -20.0], [45.0, 85.0, 6.0], (3_000, 3))
    return np.vstack([anywhere, simulation.states_near_the_edge(3_000, rng)])


def disagreement(name, states, maneuver, interpolated):
    """Share of states whose sign differs, near misses of less than 0.3 m aside."""
    smallest = simulation.smallest_gap(name, states, np.full(len(states), (maneuver - 20) / 5.0))
    crash = smallest < CONTACT_M
    assert 0.05 < crash.mean() < 0.95
    return ((crash != (interpolated < CONTACT_M)) & (np.abs(smallest) > 0.3)).mean()


@pytest.mark.parametrize("maneuver", [0, 10, KEEP_SPEED, 30])
def test_same_answer_as_a_roll_out(tables, states, maneuver):
    for j, name in enumerate(SURROGATES["two"]):
        found = tabulated(tables.maneuvers[j, ..., maneuver], states)
        assert disagreement(name, states, maneuver, found) <= ALLOWED_SHARE[name], name


def test_a_cut_in_is_judged_by_keeping_speed_and_gaps_shrink_with_the_time_left(tables):
    np.testing.assert_array_equal(tables.value[:, -1], tables.maneuvers[..., KEEP_SPEED])
    assert (tables.value[:, 0] > 0.0).all()
    assert (np.diff(tables.value, axis=1) <= 0.0).all()
    assert tables.before.shape[1] == 0  # staying is no challenge
