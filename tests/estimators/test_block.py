"""A block refuses what would quietly give a wrong rate."""

import numpy as np
import pytest

from .small_blocks import block


def test_weighted_crashes_and_ratios():
    some = block([True, False], [-1.0, -2.0], log_q=np.array([[1.0, -np.inf], [2.0, 0.0]]))
    np.testing.assert_allclose(some.weighted_crashes(), [np.exp(-1.0), 0.0])
    np.testing.assert_allclose(some.mixture_ratios(), [[1.0, 0.0], [1.0, np.exp(-2.0)]])


def test_take_keeps_indices_right():
    some = block([True, False, True], first_episode=40, first_ratios=np.ones((3, 9, 2)))
    part = some.take(slice(1, 3))
    assert (part.first_episode, len(part), part.first_ratios.shape) == (41, 2, (2, 9, 2))
    np.testing.assert_array_equal(part.crash, [False, True])
    assert part.drawn is some.drawn
    with pytest.raises(ValueError, match="step 1"):
        some.take(slice(None, None, 2))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"log_weight": [0.0] * 3}, "log_weight has shape"),
        ({"log_q": np.zeros((2, 5))}, "log_q has shape"),
        ({"first_ratios": np.ones((2, 4, 2))}, "first_ratios has shape"),
        ({"log_weight": [0.0, np.nan]}, "NaN"),
    ],
)
def test_contradictions_are_refused(change, text):
    with pytest.raises(ValueError, match=text):
        block([True, False], **change)
