"""IDM and FVDM against plain Python, how drivers lag behind their model, and libraries of drivers that are wrong."""

from __future__ import annotations

import math
from pathlib import Path

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
from harness.errors import CampaignError
from harness.vehicles.library import SHIPPED_FOLDER, load_library
from tests.chains.seed import SEED
from tests.vehicles.kernels import accelerations, follow, steps_late

speeds = st.floats(0.0, 60.0)
gaps = st.floats(-5.0, 200.0)
situations = st.tuples(speeds, speeds, gaps)
braking = st.sampled_from([0.0, -0.0, -1.0, -3.0, -4.0, -6.0, -8.0, -20.0])
idm_parameters = st.builds(
    IDMParameters,
    acceleration_mps2=st.sampled_from([0.5 * i for i in range(1, 13)]),
    comfortable_deceleration_mps2=st.floats(0.5, 8.0),
    time_headway_s=st.floats(0.0, 3.0),
    minimum_gap_m=st.floats(0.0, 5.0),
    desired_speed_mps=st.floats(15.0, 60.0),
    min_acceleration_mps2=braking,
)
fvdm_parameters = st.builds(
    FVDMParameters,
    kappa_per_s=st.floats(0.01, 2.0),
    lambda_per_s=st.floats(0.0, 2.0),
    max_speed_mps=st.floats(15.0, 60.0),
    min_acceleration_mps2=braking,
)


def clipped(a, p):
    return min(max(a, p.min_acceleration_mps2), p.max_acceleration_mps2)


def idm(p, v, v_lead, gap):
    """Every operation in the order of the kernels: with doubles, that is part of the formula."""
    s = max(gap, 0.1)
    wanted = v * p.time_headway_s + (v * (v - v_lead)) / (
        2.0 * math.sqrt(p.acceleration_mps2 * p.comfortable_deceleration_mps2)
    )
    s_star = p.minimum_gap_m + max(0.0, wanted)
    r = (v / p.desired_speed_mps) * (v / p.desired_speed_mps)
    return clipped(p.acceleration_mps2 * (1.0 - r * r - (s_star / s) * (s_star / s)), p)


def fvdm(p, v, v_lead, gap):
    s = max(gap, 0.1)
    optimal = p.max_speed_mps * (p.v1 + p.v2 * math.tanh(p.c1_per_m * s - p.c2)) / (p.v1 + p.v2)
    return clipped(p.kappa_per_s * (optimal - v) + p.lambda_per_s * (v_lead - v), p)


@given(idm_parameters, situations)
def test_idm_in_every_bit(parameters, situation):
    assert accelerations(parameters, situation)[0] == idm(parameters, *situation)


@given(fvdm_parameters, situations)
def test_fvdm(parameters, situation):
    assert accelerations(parameters, situation)[0] == pytest.approx(fvdm(parameters, *situation), rel=1e-12, abs=1e-12)


# -- how drivers lag behind their model, and how often an inattentive one is late --


situation = st.tuples(speeds, speeds, st.floats(-5.0, 200.0))
drives = st.lists(situation, min_size=1, max_size=60)
any_braking = st.floats(-20.0, 0.0)
drivers = st.one_of(
    st.builds(IDMParameters, min_acceleration_mps2=st.floats(-20.0, 0.0), time_headway_s=st.floats(0.0, 3.0)),
    st.builds(FVDMParameters, min_acceleration_mps2=st.floats(-20.0, 0.0)),
    st.builds(ConstantParameters, acceleration_mps2=st.floats(-5.0, 2.0)),
)
with_memory = st.one_of(
    st.builds(CarefulCompetentParameters, lateral_speed_mps=st.floats(0.3, 3.0), min_acceleration_mps2=any_braking),
    st.builds(FuzzySafetyParameters, lateral_speed_mps=st.floats(0.3, 3.0), min_acceleration_mps2=any_braking),
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


# -- a library says what is wrong with it --


SHIPPED = (SHIPPED_FOLDER / "ladder-1.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("boundary: brakes-2-late-1s", "boundary: brakes-2-late", "Did you mean 'brakes-2-late-1s'"),
        ("boundary: brakes-2-late-1s", "boundary: full-throttle-2", "which is the envelope"),
        ("envelope: full-throttle-2", "envelope: brakes-3", "expected constant"),
        ("envelope: full-throttle-2", "envelope: never-brakes", "less than"),
        ("delay_s: 0.7", "delay_s: 0.75", "multiple of the 0.1 s step"),
        ("delay_s: 0.7", "inattention_probability: 0.7", "unknown key"),
        ("model: constant, parameters: {acceleration_mps2: 0.0}", "model: constnt", "Did you mean .constant."),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, complaint: str):
    assert old in SHIPPED
    file = tmp_path / "mine.yaml"
    file.write_text(SHIPPED.replace(old, new), encoding="utf-8")
    with pytest.raises(CampaignError, match=complaint):
        load_library(str(file))
