"""Grid cells that are skipped must be those, and only those, in which interpolation could find no challenge."""

import numpy as np
import pytest

from harness.criticality.grid import interpolate, interpolate_maneuvers
from harness.importance.build import harmless_cells
from harness.importance.functions import as_challenge
from harness.vehicles.kinematics import CONTACT_M

SHAPE = (1, 3, 4, 5, 31)


def tables(recursive):
    """Many harmless values, and here and there one that just is not."""
    rng = np.random.default_rng(20261121)
    rare = rng.random(SHAPE) < 1.0 / 400.0
    if recursive:
        return np.where(rare, np.nextafter(0, 1, dtype=np.float32), 0.0).astype(np.float32)
    near = (CONTACT_M + rng.exponential(1.0, SHAPE)).astype(np.float32)
    return np.where(rare, np.float32(CONTACT_M - 1e-6), np.maximum(near, np.float32(CONTACT_M + 1e-6)))


@pytest.mark.parametrize("recursive", [True, False])
def test_harmless_cells_have_no_challenge_wherever_they_are_read(recursive):
    table = tables(recursive)
    harmless = harmless_cells(table, recursive=recursive)
    rng = np.random.default_rng(1)
    out = np.empty(31)
    found = np.argwhere(harmless[0])
    assert 5 < len(found) < harmless.size
    for i, g, k in found:
        for a, b, c in [*rng.random((20, 3)), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]:
            interpolate_maneuvers(table[0], (i, a, g, b, k, c), out)
            assert [as_challenge(value, recursive) for value in out] == [0.0] * 31


@pytest.mark.parametrize("recursive", [True, False])
def test_a_cell_with_one_challenging_corner_is_not_harmless(recursive):
    table = tables(recursive)
    harmless = harmless_cells(table, recursive=recursive)[0]
    challenging = np.any(table[0] > 0.0 if recursive else table[0] < CONTACT_M, axis=-1)
    for i, g, k in np.ndindex(harmless.shape):
        assert harmless[i, g, k] == (not challenging[i : i + 2, g : g + 2, k : k + 2].any())


def test_all_maneuvers_at_once_are_interpolated_as_each_alone():
    table = np.random.default_rng(2).normal(size=SHAPE).astype(np.float32)[0]
    where = (1, 0.3, 2, 0.9, 0, 0.123)
    together = np.empty(31)
    interpolate_maneuvers(table, where, together)
    alone = [interpolate(np.ascontiguousarray(table[..., m]), where) for m in range(31)]
    assert together.tolist() == alone
