"""Lead braking and cut-outs whose ends follow from v²/2b: exact wherever speeds end in whole steps."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from harness.campaign.drivers import CarefulCompetentParameters
from harness.families import family_named
from harness.vehicles.drivers import driver_records
from harness.vehicles.library import load_library
from tests.families.roads import QUIET, SETTINGS, SHORT, brakers, crashes_of, paths_at, traffic_of

SPEEDS = np.arange(20.0, 41.0, 4.0)
BRAKING = np.array([2.0, 2.5, 4.0, 5.0, 8.0, 10.0])
"""m/s², with which all of these speeds are used up in whole steps."""
CONTACT_M = 0.001
HEADWAYS_S = (0.5, 0.8, 1.1, 1.5, 2.0)


def test_behind_one_who_stops_a_driver_crashes_where_the_stopping_distances_say_so():
    """A1, A2: what is left is g + v²/2d - 0.1 k v - v²/2b, with b ≤ d; and the impact follows from what is missing.

    An impact is noted at the end of its step, in which the driver has braked on.
    """
    kinds, family, impacts = list(product(BRAKING, range(0, 20, 2))), family_named("lead_brakes"), 0
    stops = [{"peak_mps2": d, "held_s": np.inf} for d in BRAKING]
    drivers, (b, late) = brakers(kinds), np.array(kinds).T
    v, d, k = SPEEDS[:, None, None], BRAKING[None, :, None], late + 1.0  # seen one step after the onset
    for headway_s in HEADWAYS_S:
        traffic = traffic_of("lead_brakes", {**SHORT, "approach__headway_s": headway_s}, stops)
        crashes = crashes_of("lead_brakes", traffic, paths_at(SPEEDS), drivers)[0]
        left = headway_s * v + v * v / (2.0 * d) - 0.1 * k * v - v * v / (2.0 * b)
        exact = np.broadcast_to(b <= d, left.shape)
        assert np.array_equal(crashes[exact], (left < -CONTACT_M)[exact])
        assert 0 < crashes[exact].sum() < exact.sum()
        for row, event in product(range(SPEEDS.size), range(len(stops))):
            chosen = family.choose(traffic, 1, paths_at(SPEEDS[[row]]), np.array([event]))
            end, motion, ahead = family.drive(traffic, chosen, np.full((1, 2), np.nan), drivers, last=True)
            assert np.array_equal(end[0] >= 0, crashes[row, event])
            for who in np.flatnonzero((end[0] >= 0) & exact[row, event]):
                last = end[0, who]
                if ahead[last - 1, 1] > 0.0 or last - 1 < 10 + k[who]:
                    continue  # it has not stopped yet, or the driver has not begun
                at_contact = np.sqrt(2.0 * b[who] * (-left[row, event, who] - CONTACT_M))
                impact, impacts = motion[who, last, 1] - ahead[last, 1], impacts + 1
                assert at_contact - 0.1 * b[who] - 1e-6 < impact < at_contact + 1e-6
    assert impacts > 500


def test_the_rate_of_stops_is_the_tail_of_their_law():
    """A3: at 30 m/s, 45 m behind, a second late, braking with 4 m/s²: those above 900/195 m/s², in bins above 4.6."""
    law = {"stop_share": 1.0, "gentle_jerk_mps3": 1000.0, "abrupt_jerk_mps3": 1000.0}
    values = {**SHORT, "approach__headway_s": 1.5, **{f"braking__{name}": value for name, value in law.items()}}
    traffic, paths = traffic_of("lead_brakes", values), paths_at([30.0])
    crashes, p = crashes_of("lead_brakes", traffic, paths, brakers([(4.0, 9)]))
    per_hour = family_named("lead_brakes").parameters(SETTINGS).counted().per_hour
    rate = per_hour * p[crashes[..., 0]].sum()
    assert rate == pytest.approx(0.1 * np.exp(-1.6 / 0.7), rel=1e-12)
    assert rate == pytest.approx(0.010170139, abs=5e-10)


@pytest.mark.parametrize(("perceives_m", "visible_m"), [(0.375, 0.375), (0.375, 0.9), (1.0, 0.375), (10.0, 0.375)])
@pytest.mark.parametrize("headway_s", [0.5, 1.0, 1.5])
def test_who_is_revealed_is_hit_where_the_distances_say_so(perceives_m, visible_m, headway_s):
    """B1 to B3: D = H v + 5 + 0.1 n_L dv + τ dv, and the driver acts its delay after it has perceived.

    It perceives nobody before he can be seen.
    """
    kinds = list(product((1.0, 2.0, 2.5, 5.0, 10.0), (0, 3, 7, 10, 15)))
    ratios, times, lateral = (0.0, 0.2, 0.5, 0.75), (0.6, 1.1, 2.3, 4.0), (0.45, 0.867, 1.3, 2.0)
    events = [
        {"ratio": r, "ttc_s": ttc, "lateral_mps": w, "peak_mps2": 0.0} for r, ttc, w in product(ratios, times, lateral)
    ]
    values = {"approach__headway_s": headway_s, "leaving__scope_mps2": 0.0, "leaving__visible_from_m": visible_m}
    traffic = traffic_of("cut_out", {**SHORT, **values}, events)
    crashes = crashes_of("cut_out", traffic, paths_at(SPEEDS), brakers(kinds, perceives_m))[0]
    b, late = np.array(kinds).T
    r, ttc, w = (
        np.array([event[name] for event in events])[None, :, None] for name in ("ratio", "ttc_s", "lateral_mps")
    )
    v = SPEEDS[:, None, None]
    leaves, acts = (np.ceil(10.0 * way / w - 1e-9) for way in (1.9, max(perceives_m, visible_m)))
    acts, closing = np.minimum(acts, leaves) + late, (1.0 - r) * v
    room = headway_s * v + 5.0 + (0.1 * leaves + ttc) * closing
    left = room - 0.1 * acts * closing - closing * closing / (2.0 * b)
    steps = closing / (0.1 * b)
    exact = np.abs(steps - np.rint(steps)) < 1e-9
    assert np.array_equal(crashes[exact], (left < -CONTACT_M)[exact])
    assert 0.1 < crashes[exact].mean() < 0.9


def test_the_rate_of_those_who_stand_is_that_of_late_departures():
    """B4: blind, at 30 m/s and 1 s, half a second late, with 4 m/s²: τ below 3.083 s, however fast the lane is left."""
    values = {**SHORT, "approach__headway_s": 1.0, "leaving__scope_mps2": 0.0}
    traffic = traffic_of("cut_out", values)
    crashes, p = crashes_of("cut_out", traffic, paths_at([30.0]), brakers([(4.0, 5)], perceives_m=10.0))
    hit = crashes[0, :, 0] & (traffic.grid["ratio"] == 0.0)
    assert p[0, hit].sum() == pytest.approx(1.36870932e-4, rel=1e-8)
    assert set(traffic.grid["ttc_s"][hit]) == {ttc for ttc in traffic.grid["ttc_s"] if ttc < 3.0833}


@pytest.mark.parametrize("name", ["lead_brakes", "cut_out"])
def test_where_nothing_happens_nobody_crashes(name):
    """C4; those who keep their last acceleration for 20 s have come to rest behind the vehicle ahead by then."""
    values = {**QUIET, "approach__duration_s": 35.0, "approach__headway_s": 2.0}
    traffic = traffic_of(name, values, [{"peak_mps2": 0.0}])
    drivers = load_library(family_named(name).ladders[False]).followers(False).drivers
    crashes, p = crashes_of(name, traffic, paths_at(SPEEDS), drivers)
    assert (p == 1.0).all()
    assert not crashes.any()


COASTS, BUILT_UP = -0.4, 1.265
"""Acceleration (m/s²) of the competent driver off the pedal, and by what it brakes harder in each step."""


@pytest.mark.parametrize(
    ("reading", "danger", "ends"),
    [
        # It follows on 7.5 steps after the onset, with 4 m/s² at most; its brakes come 7.5 steps after the danger.
        ({}, 5, [-1.0325, -2.2975, -3.5625, -4.0, -4.0, -4.6325, -5.8975, -7.1625, -7.59294]),
        ({"perceives_braking_mps2": 5.0}, 5, [-1.0325, -2.2975, -3.5625, -4.0, -4.0, -4.6325, -5.8975]),
        ({"perceives_braking_mps2": 0.0, "risk_evaluation_s": 0.0}, 1, [-1.0325, -2.2975, -3.5625, -4.8275, -6.0925]),
    ],
)
def test_the_competent_driver_acts_when_its_times_are_over(reading, danger, ends):
    """Behind one who stops with 8 m/s²: seen after a step, evaluated after four, and a half step is half a step."""
    values, family = {**SHORT, "approach__headway_s": 1.5}, family_named("lead_brakes")
    traffic = traffic_of("lead_brakes", values, [{"peak_mps2": 8.0, "held_s": np.inf, "jerk_mps3": 1000.0}])
    onset, driver = 10, CarefulCompetentParameters(time_headway_s="natural", **reading)
    chosen = family.choose(traffic, 1, paths_at([30.0]), np.array([0]))
    motion = family.drive(traffic, chosen, np.full((1, 2), np.nan), driver_records([driver]), last=True).motion[0]
    done = np.diff(motion[onset : onset + 7 + len(ends) + 1, 1]) * 10.0
    assert done == pytest.approx([0.0] * danger + [COASTS] * (7 - danger) + ends, abs=1e-9)
    assert done[8] - done[7] == pytest.approx(-BUILT_UP)
