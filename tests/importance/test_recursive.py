"""U, the surrogates' crash probability after a cut-in, against direct simulation, and what must be monotone.

U falls from 1 to 0 within a metre or two of gap, so a table misses by tenths *on* such an edge; what is asked for is a
small error on average over states near the edge, and no bias.
"""

import numpy as np
import pytest

from tests.chains.seed import SEED
from tests.episode.twin_runs import Mean, prepared, run
from tests.importance import simulation
from tests.importance.kernels import tabulated

each_surrogate = pytest.mark.parametrize("j", range(3), ids=simulation.SURROGATES)


@pytest.fixture(scope="module")
def tables():
    return prepared("step_mixture").tables


def simulated(name, states, level, n, rng):
    return np.array([simulation.crash_shares(name, state, 12, n, rng)[level - 1] for state in states])


@each_surrogate
@pytest.mark.parametrize("level", [2, 12])
def test_between_grid_points(tables, j, level):
    rng = np.random.default_rng(SEED)
    states = simulation.states_near_the_edge(200, rng)
    found = simulated(simulation.SURROGATES[j], states, level, 250, rng)
    error = tabulated(tables.value[j, level], states) - found
    assert abs(error.mean()) < 0.015
    assert np.abs(error).mean() < 0.03
    assert (np.abs(error) > 0.1).mean() < 0.1


def test_another_surrogates_table_would_be_noticed(tables):
    """The check has teeth: against SM-I's simulation, SM-III's table errs ten times as much."""
    rng = np.random.default_rng(SEED)
    states = simulation.states_near_the_edge(200, rng)
    found = simulated("SM-I", states, 12, 250, rng)
    assert np.abs(tabulated(tables.value[2, -1], states) - found).mean() > 0.1


@each_surrogate
def test_a_probability_that_grows_with_the_time_left(tables, j):
    value = tables.value[j]
    assert (value[0] == 0.0).all()
    assert value.min() >= 0.0
    assert value.max() <= 1.0 + 1e-6
    assert (np.diff(value, axis=0) >= -1e-6).all()
    assert value[-1].max() == pytest.approx(1.0)
    if j == 0:  # more gap and less closing never hurt SM-I; FVDM accelerates into large gaps
        assert (np.diff(value, axis=2) <= 1e-5).all()
        assert (np.diff(value, axis=3) <= 1e-5).all()


# -- before the cut-in: G, what not cutting in now is worth --


@each_surrogate
def test_limits(tables, j):
    before = tables.before[j]
    assert before.shape[0] == 21
    assert before.min() >= 0.0
    assert (before[-1] == 0.0).all()  # the episode is over
    assert (before[:, :, 0] == 0.0).all()  # the AV has passed
    assert (np.diff(before, axis=0) <= 1e-6).all()  # time can only be lost


@pytest.mark.parametrize(
    ("j", "av", "low", "high"),
    [(0, "idm", 0.95, 1.1), (1, "SM-II", 0.95, 1.4), (2, "SM-III", 0.95, 2.5)],
    ids=simulation.SURROGATES,
)
def test_predicted_crash_rates(j, av, low, high):
    """With a surrogate as the AV, the mean of V_j(s_0) predicts its crash rate, as the forced cut-in finds it.

    Measured: 1.03, 1.21 and 1.9 times the rate. Where crashes are rare (far cut-ins, tails of U) each interpolation of
    the induction smears probability outwards, so tables predict too much, never too little: it costs efficiency alone.
    """
    sampled = run("episode_mixture", av=av, n=10_000, moments="first_9")
    start = sampled.moment["step"] == 0
    predicted = np.zeros(len(sampled.episode))
    predicted[sampled.moment["row"][start]] = sampled.moment_v[start, j]
    prediction, rate = Mean.of(predicted), run("forced", av=av, n=60_000).rate
    margin = 4.0 * np.hypot(prediction.std_error, high * rate.std_error)
    assert low * rate.value - margin < prediction.value < high * rate.value + margin
