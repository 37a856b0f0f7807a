"""How drivers lag behind their model: identities over arbitrary traffic, and how often an inattentive one is late."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from harness.campaign.drivers import (
    CarefulCompetentParameters,
    ConstantParameters,
    FuzzySafetyParameters,
    FVDMParameters,
    IDMParameters,
    NeedBasedParameters,
    Reaction,
    Reflexes,
)
from tests.chains.seed import SEED
from tests.vehicles.kernels import accelerations, follow, steps_late

speeds = st.floats(0.0, 60.0)
situation = st.tuples(speeds, speeds, st.floats(-5.0, 200.0))
drives = st.lists(situation, min_size=1, max_size=60)
braking = st.floats(-20.0, 0.0)
drivers = st.one_of(
    st.builds(IDMParameters, min_acceleration_mps2=st.floats(-20.0, 0.0), time_headway_s=st.floats(0.0, 3.0)),
    st.builds(FVDMParameters, min_acceleration_mps2=st.floats(-20.0, 0.0)),
    st.builds(ConstantParameters, acceleration_mps2=st.floats(-5.0, 2.0)),
)
with_memory = st.one_of(
    st.builds(CarefulCompetentParameters, lateral_speed_mps=st.floats(0.3, 3.0), min_acceleration_mps2=braking),
    st.builds(FuzzySafetyParameters, lateral_speed_mps=st.floats(0.3, 3.0), min_acceleration_mps2=braking),
    st.builds(NeedBasedParameters, deceleration_mps2=st.floats(0.5, 9.0), reaction_time_s=st.floats(0.0, 2.0)),
)
any_driver = drivers | with_memory
delays = st.integers(0, 100).map(lambda steps: steps / 10.0)
jerks = st.none() | st.floats(0.1, 1000.0)


@given(any_driver, delays, jerks, drives)
def test_delay_jerk_limit_and_the_limits_of_the_model_hold(driver, delay_s, jerk, drive):
    found = follow(driver, Reflexes(delay_s=delay_s, max_jerk_mps3=jerk), drive)
    assert (found[: round(delay_s * 10.0) + 1] == 0.0).all()
    assert jerk is None or np.abs(np.diff(found, prepend=0.0)).max() <= jerk * 0.1 * (1.0 + 1e-12) + 1e-12
    assert found.min() >= min(driver.min_acceleration_mps2, 0.0)
    assert found.max() <= max(driver.max_acceleration_mps2, 0.0)


@given(drivers, delays, drives)
def test_without_a_jerk_limit_a_driver_that_has_reacted_is_its_model(driver, delay_s, drive):
    found, late = follow(driver, Reflexes(delay_s=delay_s), drive), round(delay_s * 10.0)
    assert (found[late + 1 :] == accelerations(driver, drive)[late + 1 :]).all()


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_the_share_of_inattentive_episodes_is_the_one_asked_for(share):
    reaction = Reaction(delay_s=0.3, inattention_probability=share, inattention_delay_s=1.5)
    steps = steps_late(reaction, 40_000, seed=SEED)
    assert set(steps.tolist()) == {3, 18}
    late = int((steps == 18).sum())
    assert binomtest(late, steps.size, share).pvalue > 1e-6  # how often it fails although the share is right
    assert binomtest(late, steps.size, 0.85 * share).pvalue < 1e-6  # the test would notice another share
