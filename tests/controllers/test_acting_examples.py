"""Examples that make room: what they do before the cut-in, how hard they may brake after it, and by how much late."""

import numpy as np
import pytest

from examples.acting import Careful, Yields
from harness.controllers.protocol import BatchObservation


def seen(speed, gap, *, ahead=np.inf):
    """Two AVs, the second far from everything; BV drives 30 m/s, its rear ``gap`` ahead, and ``ahead`` in the lane."""
    columns = dict.fromkeys(BatchObservation._fields, np.zeros(2)) | {
        "cell": np.arange(2),
        "speed_mps": np.array([speed, speed]),
        "gap_m": np.array([ahead, np.inf]),
        "lead_speed_mps": np.array([30.0, np.nan]),
        "bv_position_m": np.array([gap + 5.0, 500.0]),
        "bv_speed_mps": np.full(2, 30.0),
    }
    return BatchObservation(**columns)


@pytest.mark.parametrize(
    ("speed", "gap", "careful", "yields"),
    [(36.0, 10.0, -1.5, -1.0), (36.0, -5.0, -1.5, 0.0), (36.0, 45.0, 0.0, -1.0), (32.0, 10.0, 0.0, -1.0)],
)
def test_they_slow_down_while_bv_is_near(speed, gap, careful, yields):
    vehicle = Careful()
    vehicle.start_batch(np.arange(2), None, None)
    assert vehicle.step_batch(seen(speed, gap)).tolist() == [careful, 0.0]
    assert Yields().step_batch(seen(speed, gap))[0] == yields


def test_after_the_cut_in_one_brakes_hard_and_what_it_does_comes_late():
    late, other = Careful(dead_time_s=0.3), Careful()
    for each in (late, other):
        each.start_batch(np.arange(2), None, None)
    assert other.step_batch(seen(36.0, 3.0, ahead=3.0))[0] == -6.0
    assert Yields().step_batch(seen(36.0, 3.0, ahead=3.0))[0] == -4.0
    assert [late.step_batch(seen(36.0, 3.0, ahead=3.0))[0] for _ in range(4)] == [0.0, 0.0, 0.0, -6.0]
    late.start_batch(np.array([0]), None, None)
    assert late.step_batch(seen(36.0, 3.0, ahead=3.0)).tolist() == [0.0, 0.0]
