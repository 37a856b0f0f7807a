import numpy as np
import pytest

from harness.estimators.scv import empty_factor, fold_rows


@pytest.mark.parametrize("k", [1, 5, 33, 100])
def test_rows_folded_in_blocks_have_the_factor_of_the_whole_matrix(k):
    matrix = np.random.default_rng(k).normal(size=(300, k)) * np.logspace(0, 6, k)
    factor = empty_factor(k)
    for block in np.split(matrix, [1, 40, 40, 170]):
        fold_rows(factor, np.array(block, order="F"))
    expected = np.linalg.qr(matrix, mode="r")
    np.testing.assert_allclose(np.abs(factor), np.abs(expected), rtol=0, atol=1e-12 * np.abs(expected).max())
    assert np.array_equal(factor, np.triu(factor))


def test_arrays_that_would_be_misread_are_refused():
    with pytest.raises(ValueError, match="Fortran"):
        fold_rows(empty_factor(3), np.ones((4, 3)))
    with pytest.raises(ValueError, match="Fortran"):
        fold_rows(empty_factor(4), np.ones((4, 3), order="F"))
