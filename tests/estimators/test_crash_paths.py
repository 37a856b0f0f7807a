"""How many paths crashes lie on, from pairs of crashed tests."""

import math

import numpy as np
import pytest

from harness.estimators.tally import FEWEST_PATHS, CrashPaths


def counted(paths, strata, n_strata=2):
    """Crashed tests of paths that are known by one number each."""
    found = CrashPaths()
    found.add(np.asarray(paths, np.float64)[:, None], np.asarray(strata, np.int64), n_strata)
    return found


def test_pairs_of_one_path_are_counted_by_weight():
    """Paths 1, 1, 1 and 2 in stratum 0, 2 and 3 in stratum 1: by hand."""
    found = counted([1, 1, 1, 2, 2, 3], [0, 0, 0, 0, 1, 1])
    w = [1.0] * 4 + [0.5] * 2
    total = sum(w) ** 2 - sum(x * x for x in w)
    same = 2 * (3 * 1.0 * 1.0) + 2 * (1.0 * 0.5)
    assert found.number(np.array([1.0, 0.5])) == pytest.approx(total / same)
    assert found.number(np.array([1.0, 0.0])) == pytest.approx(12 / 6)


def test_one_or_two_pairs_say_nothing():
    assert counted([1, 1, 2, 2, 3], [0] * 5).number(np.ones(2)) == math.inf
    assert counted([1, 1, 1, 2], [0] * 4).number(np.ones(2)) == 2.0
    assert CrashPaths().number(np.ones(2)) == math.inf
    assert counted([1, 1, 1], [0] * 3).number(np.zeros(2)) == math.inf


@pytest.mark.parametrize("n_paths", [8, 25, 150, 500])
def test_it_is_the_number_of_equal_paths_and_the_guard_tells_few_from_many(n_paths):
    """Eighty crashes; the guard decides wrongly in 1,000 draws never."""
    rng = np.random.default_rng(n_paths)
    numbers = np.array([counted(rng.integers(n_paths, size=80), [0] * 80).number(np.ones(2)) for _ in range(1000)])
    assert np.mean(1.0 / numbers) == pytest.approx(1.0 / n_paths, rel=0.05)
    assert np.all((numbers < FEWEST_PATHS) == (n_paths < FEWEST_PATHS))


def test_unequal_paths_count_as_far_as_they_carry():
    """G = 4, 1, 1, 1, 1: (8)^2/20 = 3.2 paths."""
    rng = np.random.default_rng(5)
    share = np.array([4, 1, 1, 1, 1]) / 8
    pairs = [1.0 / counted(rng.choice(5, size=60, p=share), [0] * 60).number(np.ones(2)) for _ in range(400)]
    assert np.mean(pairs) == pytest.approx(20 / 64, rel=0.03)
