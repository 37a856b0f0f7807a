"""IDM and FVDM against plain Python, how drivers lag behind their model, drivers that remember a danger, and libraries.

Those with a memory: by hand, against plain step-wise definitions, and against published outcomes.
"""

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
    Reaction,
    Reflexes,
)
from harness.errors import CampaignError
from harness.vehicles.library import SHIPPED_FOLDER, load_library
from tests.chains import SEED
from tests.kernels import accelerations, follow, fuzzy_metrics, smallest_gaps, steps_late

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


drives = st.lists(situations, min_size=2, max_size=60)
any_braking = st.floats(-20.0, 0.0)
drivers = st.one_of(
    st.builds(IDMParameters, min_acceleration_mps2=st.floats(-20.0, 0.0), time_headway_s=st.floats(0.0, 3.0)),
    st.builds(FVDMParameters, min_acceleration_mps2=st.floats(-20.0, 0.0)),
    st.builds(ConstantParameters, acceleration_mps2=st.floats(-5.0, 2.0)),
)
with_memory = st.one_of(
    st.builds(CarefulCompetentParameters, lateral_speed_mps=st.floats(0.3, 3.0), min_acceleration_mps2=any_braking),
    st.builds(FuzzySafetyParameters, lateral_speed_mps=st.floats(0.3, 3.0), min_acceleration_mps2=any_braking),
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


ALONE = {"following_min_acceleration_mps2": -0.0, "max_acceleration_mps2": 1e-9}
"""Without the braking and speeding up of the IDM."""
JERK = 12.65 * 0.1
CAP = 0.774 * 9.81


def driven(parameters, *phases):
    """Accelerations from the first step after the cut-in on, in phases of (steps, (speed, leader's speed, gap))."""
    situations = [phases[0][1]] + [situation for steps, situation in phases for _ in range(steps)]
    return follow(parameters, Reflexes(), situations)[1:]


@pytest.mark.parametrize("section", [CarefulCompetentParameters, FuzzySafetyParameters])
@given(st.floats(0.2, 5.0))
def test_the_delay_stated_is_the_one_kept(section, lateral_speed):
    driver = section(lateral_speed_mps=lateral_speed)
    found = driven(driver, (20, (30.0, 20.0, 5.0)))
    idle = -0.4 if section is CarefulCompetentParameters else 0.0
    assert driver.delay_after_event_s == pytest.approx(max(0.75 - 0.505 / lateral_speed, 0.0), abs=1e-12)
    whole, part = divmod(10.0 * driver.delay_after_event_s, 1.0)
    assert found[: int(whole)] == pytest.approx(idle)
    assert found[int(whole)] == pytest.approx(idle - (1.0 - part) * JERK)
    assert found[int(whole) + 1] == pytest.approx(found[int(whole)] - JERK)


@pytest.mark.parametrize(
    ("situation", "pfs", "cfs"),
    [
        # PFS: safe 22.5 + 900/8 - 400/14 + 2 = 108.43, unsafe 22.5 + 900/12 - 400/14 = 68.93, of the gap less 2
        ((30.0, 20.0, 2.0 + 108.43 - 39.5 / 4.0, 0.0), 0.25, 0.0),
        # CFS: safe 7.5 + 100/8 = 20, unsafe 7.5 + 100/12 = 15.83
        ((30.0, 20.0, (20.0 + 15.0 + 5.0 / 6.0) / 2.0, 0.0), 1.0, 0.5),
        # while it brakes with 2: (10 - 0.75) 0.75 = 6.9375, 8.5^2/8 = 9.03125, 8.5^2/12 = 6.02083
        ((30.0, 20.0, (15.96875 + 12.95833) / 2.0, -2.0), 1.0, 0.5),
        # with 6 it counts on no more than 4: (10 - 1.5) 0.75 = 6.375, 7^2/12 = 4.08333, 7^2/8 = 6.125
        ((30.0, 20.0, 6.375 + (6.125 + 4.08333) / 2.0, -6.0), 1.0, 0.5),
        # in 0.75 s it will be slower than the vehicle ahead: 1^2/(2 2) = 0.25 m are enough
        ((21.0, 20.0, 0.2, -2.0), 1.0, 1.0),
        ((21.0, 20.0, 0.3, -2.0), 1.0, 0.0),
        ((20.0, 20.0, 0.1, 0.0), 1.0, 0.0),  # not closing in
    ],
)
def test_the_metrics_by_hand(situation, pfs, cfs):
    assert fuzzy_metrics(FuzzySafetyParameters(), situation)[0] == pytest.approx([pfs, cfs], abs=1e-3)


# -- against a plain definition, step by step, for delays of whole steps --


def following(p, v, v_lead, gap):
    return accelerations(IDMParameters(min_acceleration_mps2=p.following_min_acceleration_mps2), (v, v_lead, gap))[0]


def careful_competent(p, drive, left):
    """The reaction time counts down while there is a danger; ``left`` steps of it are left at the cut-in."""
    a, waits, out = 0.0, None, []
    for step, (v, v_lead, gap) in enumerate(drive):
        if v <= v_lead:
            waits = None
        elif waits is None and gap < 2.0 * (v - v_lead):
            waits = left if step == 0 else 8
        foot_off = 0.0 if waits is None else -0.4
        wanted = foot_off if step < left else following(p, v, v_lead, gap)
        if waits is not None:
            wanted = min(wanted, -CAP if waits == 0 else -0.4)
            waits = max(waits - 1, 0)
        a = max(wanted, min(a, foot_off) - JERK)
        out.append(a)
    return out


def fuzzy(p, drive, left):
    a, waits, out = 0.0, None, []
    for step, (v, v_lead, gap) in enumerate(drive):
        pfs, cfs = fuzzy_metrics(p, (v, v_lead, gap, a))[0]
        asked = 4.0 + 2.0 * cfs if cfs > 0.0 else 4.0 * pfs
        if asked > 0.0 and waits is None:
            waits = left if step == 0 else 8
        wanted = 0.0 if step < left else following(p, v, v_lead, gap)
        if asked > 0.0:
            wanted = min(wanted, -asked if waits <= 0 else 0.0)
        waits = waits if waits is None else waits - 1
        a = max(wanted, min(a, 0.0) - JERK)
        out.append(a)
    return out


@pytest.mark.parametrize(
    ("section", "plain"), [(CarefulCompetentParameters, careful_competent), (FuzzySafetyParameters, fuzzy)]
)
@given(drives, st.integers(0, 8))
def test_with_a_delay_of_whole_steps_it_is_the_plain_definition(section, plain, drive, left):
    driver = section(reaction_time_s=0.8, lateral_speed_mps=1.0, evaluated_at_m=0.8 - left / 10.0)
    expected = plain(driver, drive, left)
    assert follow(driver, Reflexes(), [drive[0], *drive])[1:] == pytest.approx(expected, abs=1e-9)


# -- against the authors' own code --

PUBLISHED = {
    # Smallest gap (m) at the overlap without a crash, bisected with the cut-in of JRC-FSM (commit 01b05c2) at 100
    # steps a second, for speeds (km/h) of the vehicle and of the one that cuts in; 120: none up to there.
    ("cc", 0.0, 1.8): {(50, 20): 12.42, (60, 40): 7.15, (90, 40): 25.90, (110, 70): 18.63, (130, 70): 120.0},
    ("cc", 0.505, 1.8): {(50, 20): 10.08, (60, 40): 5.62, (90, 40): 22.03, (110, 70): 15.53, (130, 70): 120.0},
    ("fsm", 1.6, 2.2): {(50, 20): 8.20, (60, 40): 4.28, (90, 40): 19.92, (110, 70): 13.48, (130, 70): 27.66},
    ("fsm", 1.6, 3.2): {(50, 20): 10.08, (60, 40): 5.57, (90, 40): 23.09, (110, 70): 16.00, (130, 70): 31.58},
}
LATEST_S = 0.08
"""Half a step of 0.1 s, by which brakes of whole steps are ahead of brakes that are applied steadily, and the published
code's steps of its delays, 0.03 s."""


def smallest_safe_gap(kind, evaluated_at, lateral_speed, v, v_lead, **more):
    section = CarefulCompetentParameters if kind == "cc" else FuzzySafetyParameters
    driver = section(evaluated_at_m=evaluated_at, lateral_speed_mps=lateral_speed, **more, **ALONE)
    tried = np.arange(0.0, 120.0, 0.01)
    unsafe = np.flatnonzero(smallest_gaps(driver, v, v_lead, tried) < 0.0)
    return tried[unsafe[-1]] if unsafe[-1] + 1 < tried.size else 120.0


def agrees(published, **more):
    def late_s(kind, evaluated_at, lateral_speed, v, v_lead, gap):
        own = smallest_safe_gap(kind, evaluated_at, lateral_speed, v / 3.6, v_lead / 3.6, **more)
        return (gap - own) / ((v - v_lead) / 3.6)

    cases = ((*driver, *pair, gap) for driver, gaps_of in published.items() for pair, gap in gaps_of.items())
    return all(-0.01 <= late_s(*case) <= LATEST_S for case in cases)


def test_outcomes_of_cut_ins_are_those_of_the_published_code():
    assert agrees(PUBLISHED)
    assert not agrees(PUBLISHED, reaction_time_s=0.85)  # the test has teeth
    assert not agrees(PUBLISHED, reaction_time_s=0.65)
    assert not agrees(PUBLISHED, braking_jerk_mps3=20.0)


SHIPPED = (SHIPPED_FOLDER / "ladder-2.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("boundary: brakes-2-late-1s", "boundary: brakes-2-late", "Did you mean 'brakes-2-late-1s'"),
        ("envelope: full-throttle-2", "envelope: brakes-3", "expected constant"),
        ("envelope: full-throttle-2", "envelope: never-brakes", "less than"),
        ("delay_s: 0.7", "delay_s: 0.75", "multiple of the 0.1 s step"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, complaint: str):
    assert old in SHIPPED
    file = tmp_path / "mine.yaml"
    file.write_text(SHIPPED.replace(old, new), encoding="utf-8")
    with pytest.raises(CampaignError, match=complaint):
        load_library(str(file))
