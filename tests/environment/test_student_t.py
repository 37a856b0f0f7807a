"""The tabulated distribution of Student's t against scipy's."""

import numpy as np
import pytest
from scipy import stats

from harness.environment.student_t import t_table
from tests.environment.kernels import environment, t_distribution

DEGREES = [1.5, 3.39, 4.98, 16.0, 200.0]


@pytest.mark.parametrize("df", DEGREES)
def test_within_1e_8_of_scipy(df):
    z = np.random.default_rng(0).uniform(-64.0, 64.0, 200_000)
    z = np.concatenate([z, np.linspace(-4.0, 4.0, 20_001)])
    assert np.abs(t_distribution(z, t_table(df)) - stats.t.cdf(z, df)).max() < 1e-8


@pytest.mark.parametrize("df", DEGREES)
def test_rises_from_0_to_1(df):
    z = np.sort(np.random.default_rng(1).uniform(-70.0, 70.0, 100_000))
    found = t_distribution(z, t_table(df))
    assert (np.diff(found) >= 0.0).all()
    assert t_distribution(np.array([-np.inf, -64.1, 64.1, np.inf]), t_table(df)).tolist() == [0.0, 0.0, 1.0, 1.0]


def test_the_environment_has_the_tables_of_its_noises():
    np.testing.assert_array_equal(environment().free_t, t_table(16.0))
    np.testing.assert_array_equal(environment().following_t, t_table(3.39))


def test_a_table_without_slopes_would_be_noticed():
    table = t_table(3.39)
    table[:, 1] = 0.0
    z = np.linspace(-4.0, 4.0, 20_001)
    assert np.abs(t_distribution(z, table) - stats.t.cdf(z, 3.39)).max() > 1e-4
