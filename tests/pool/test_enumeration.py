"""Enumerated cut-ins are what episodes would be: same motion, same crashes, probabilities that add up."""

from __future__ import annotations

import numpy as np
import pytest

from harness.pool.library import load_library
from harness.pool.shells import design_shells
from harness.pool.walk import STRIDE
from tests.pool.walked import enumerated

LIBRARY = load_library("ladder-1")
NAMES = list(LIBRARY.surrogates)
ENVELOPE = NAMES.index(LIBRARY.envelope)


def test_a_stride_asks_the_same_cut_ins_and_each_stands_for_as_many(environment):
    """Over all offsets every cut-in is asked once, with the same answer, so that any sum has the same mean."""
    probability, crashes = enumerated(LIBRARY, environment, 40)
    strided = [enumerated(LIBRARY, environment, 40, stride=STRIDE, offset=offset) for offset in range(STRIDE)]
    assert np.array_equal(np.sum([p for p, _ in strided], axis=0), STRIDE * probability)
    assert np.array_equal(np.sum([c for _, c in strided], axis=0), crashes)
    assert np.max([p > 0.0 for p, _ in strided], axis=0).sum() > 1000


def test_strata_of_a_vehicle_that_may_accelerate_harder_include_what_the_envelope_survives(pool):
    within = design_shells(pool, limit_mps2=2.0)
    beyond = design_shells(pool, limit_mps2=2.5)
    assert within.p_impossible == pytest.approx(pool.shell_p[-1])
    assert beyond.p_impossible == pytest.approx(0.0, abs=1e-17)
    assert beyond.p[-1] == pytest.approx(within.p[-1] + pool.shell_p[-1])
