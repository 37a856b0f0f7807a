"""IDM and FVDM against plain Python: the IDM in every bit, FVDM (with its tanh) to 1e-12."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.campaign.drivers import FVDMParameters, IDMParameters
from tests.vehicles.kernels import accelerations

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
