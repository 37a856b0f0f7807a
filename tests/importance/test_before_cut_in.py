"""G, what not cutting in now is worth: limits, order in time, and the crash rates that the tables predict."""

import numpy as np
import pytest

from harness.importance.grid import BEFORE, points_of
from tests.episode.twin_runs import Mean, prepared, run
from tests.importance import simulation
from tests.traffic.kernels import cut_in_terms

each_surrogate = pytest.mark.parametrize("j", range(3), ids=simulation.SURROGATES)


@pytest.fixture(scope="module")
def tables():
    return prepared("step_mixture").tables


@each_surrogate
def test_limits(tables, j):
    before = tables.before[j]
    assert before.shape[0] == 21
    assert before.min() >= 0.0
    assert (before[-1] == 0.0).all()  # the episode is over
    assert (before[:, :, 0] == 0.0).all()  # the AV has passed
    assert (np.diff(before, axis=0) <= 1e-6).all()  # time can only be lost


@each_surrogate
def test_less_than_if_every_cut_in_crashed(tables, j):
    """C ≤ 1, so G is at most the accepted time left, Σ Δt accept, along the path of a BV that keeps its speed (30 m/s).

    Accelerations average out to within a few per cent; a tenth is left for them.
    """
    _, gaps, rates = points_of(BEFORE)
    for k, rate in ((10, -8.0), (13, -5.0)):
        assert rates[k] == rate
        for g in (40, 70, 99):
            times = np.arange(0.0, min(20.0, gaps[g] / -rate), 0.1)
            accepted = cut_in_terms([(30.0, 50.0, 0.0, gaps[g] + rate * t, rate) for t in times])[:, 1]
            assert tables.before[j, 0, 2, g, k] <= 1.1 * (0.1 * accepted).sum() + 0.01


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
