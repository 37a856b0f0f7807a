"""Motion within a step: constant acceleration, no reversing, standstill."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.vehicles.kernels import motions

positions = st.floats(0.0, 2_000.0)
speeds = st.floats(0.0, 60.0)
braking = st.floats(-20.0, 20.0)


@given(positions, speeds, braking)
def test_never_backwards(x, v, a):
    after, speed = motions((x, v, a))[0]
    assert speed >= 0.0
    assert after >= x
    assert speed == max(v + a * 0.1, 0.0)


@given(positions, speeds, braking)
def test_distance_is_mean_speed_times_the_step(x, v, a):
    """0.5 (v + v_after) dt, within the rounding of x; at a standstill SUMO's own form differs by less than that."""
    after, speed = motions((x, v, a))[0]
    assert after - x == pytest.approx(0.5 * (v + speed) * 0.1, abs=1e-12)


@given(positions, st.floats(0.0, 2.0))
def test_braking_to_a_standstill_and_staying_there(x, v):
    state = (x, v)
    for _ in range(10):
        state = motions((*state, -4.0))[0].tolist()
    assert state[1] == 0.0
    again = motions((*state, -4.0))[0].tolist()
    assert again == state
