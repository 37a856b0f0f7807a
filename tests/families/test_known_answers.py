"""Lead braking and cut-outs: ends that follow from v²/2b, exact in whole steps; grids that are laws."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import lognorm

from harness.campaign.drivers import CarefulCompetentParameters
from harness.campaign.files import load_campaign
from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError
from harness.families import family_named
from harness.families.cut_out.family import CUT_OUT, CutOutParameters
from harness.records.schemas import chosen_from, episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vehicles.drivers import driver_records
from harness.vehicles.library import load_library
from harness.vocabulary import CRASH
from harness.worlds.twin import TwinWorld
from tests.families.roads import QUIET, SETTINGS, SHORT, brakers, crashes_of, paths_at, traffic_of
from tests.families.test_same_bits import LADDERS, resolved_of, run

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


# -- laws --


SHIPPED = {name: family_named(name).parameters(SETTINGS) for name in LADDERS}


@st.composite
def moved(draw, name):
    """Parameters with any of the numbers moved that have a range, within it."""
    ranges = {key: number.range for key, number in SHIPPED[name].numbers().items() if number.range is not None}
    keys = draw(st.sets(st.sampled_from(sorted(ranges))))
    return SHIPPED[name].with_values({key: draw(st.floats(*ranges[key])) for key in sorted(keys)})


@pytest.mark.parametrize("name", LADDERS)
@given(data=st.data())
@settings(max_examples=40)
def test_probabilities_sum_to_one_wherever_numbers_may_lie(name, data):
    """C2; and every event is one that can be driven: in SUMO's road, without a contact of the others."""
    parameters = data.draw(moved(name))
    grid, share = parameters.grid()
    assert abs(share.sum() - 1.0) < 1e-12
    assert (share >= 0.0).all()
    assert grid.size == share.size == {"lead_brakes": 840, "cut_out": 1729}[name]
    traffic = family_named(name).traffic(SETTINGS, parameters)
    assert family_named(name).traffic_with(SETTINGS, SHIPPED[name], parameters.values()) is not None
    exposure = family_named(name).exposure(traffic, parameters)
    counted = parameters.counted().per_hour
    assert 0.0 < exposure.per_hour <= counted * (1.0 + 1e-12)
    assert name == "cut_out" or exposure.per_hour == pytest.approx(counted, rel=1e-12)


@given(scale=st.floats(0.5, 1.0), stop=st.floats(0.0, 0.2))
def test_peaks_have_exponential_tails_and_stops_their_share(scale, stop):
    """C2: P(d > x) = exp(-(x - 3)/θ) at every bin's edge, what lies beyond the grid in the last bin."""
    values = {"braking__peak_scale_mps2": scale, "braking__stop_share": stop}
    grid, share = SHIPPED["lead_brakes"].with_values(values).grid()
    for x in np.arange(3.0, 9.9, 0.2):
        assert share[grid["peak_mps2"] > x].sum() == pytest.approx(np.exp(-(x - 3.0) / scale), abs=1e-14)
    assert share[np.isinf(grid["held_s"])].sum() == pytest.approx(stop, abs=1e-14)
    held = np.unique(grid["held_s"][np.isfinite(grid["held_s"])])
    assert lognorm(0.6, scale=1.5).cdf(held) == pytest.approx((np.arange(11) + 0.5) / 11, abs=1e-12)


def test_cut_outs_have_the_tails_of_their_laws():
    """C2: at the edges of bins; the careless are uniform, and what lies beyond the grid is in its outermost bins."""
    grid, share = SHIPPED["cut_out"].grid()
    standing = grid["ratio"] == 0.0
    assert share[standing].sum() == pytest.approx(1e-3, rel=1e-12)
    for x in np.arange(1, 12) / 12:
        slower = share[(1.0 - grid["ratio"] > x) & ~standing].sum() / 0.999
        assert slower == pytest.approx((np.exp(-x / 0.12) - np.exp(-1 / 0.12)) / -np.expm1(-1 / 0.12), rel=1e-9)
    for x in (0.75, 1.0, 2.0, 2.5, 3.0, 5.0, 10.0):
        law = 0.99 * lognorm(0.45, scale=5.0).cdf(x) + 0.01 * min((x - 0.5) / 2.0, 1.0)
        assert share[grid["ttc_s"] < x].sum() == pytest.approx(law, rel=1e-9)
    assert np.unique(grid["lateral_mps"])[3] == pytest.approx(0.867)


def own_file(folder, name, content):
    """A file of one's own, as a campaign names it, that is like the shipped one but for what it says."""
    like = {"like": family_named(name).default_parameters}
    (folder / "own.yaml").write_text(yaml.safe_dump(like | content))
    return f"environment.parameters={folder / 'own.yaml'}"


def assumed(section, **values):
    """A section with some numbers."""
    return {section: {key: {"value": value, "source": "assumed"} for key, value in values.items()}}


@pytest.mark.parametrize(
    ("name", "changed", "value"),
    [("lead_brakes", "braking__peak_scale_mps2", 1.0), ("cut_out", "leaving__visible_from_m", 1.2)],
)
def test_a_file_of_ones_own_changes_one_number_which_drivers_heed(name, changed, value, tmp_path):
    """Loop and `drive` agree in such traffic, too, and more drivers crash in it."""
    section, key = changed.split("__")
    crashes = []
    for more in ((), (own_file(tmp_path, name, assumed(section, **{key: value})),)):
        resolved = resolved_of(name, "brakes-2-late-1s", "testing.method=forced", *more)
        shard = run(TwinWorld, resolved, prepare(resolved).tests(0, 400))
        crashes.append(crashed := shard.episode["outcome"] == CRASH)
        chosen, nowhere = chosen_from(episodes_table(shard, 1), resolved.family), np.full((400, 2), np.nan)
        end = resolved.family.drive(resolved.environment, chosen, nowhere, resolved.av).end[:, 0]
        assert np.array_equal(end, np.where(crashed, shard.episode["n_steps"], -1))
    shipped, own = SHIPPED[name].values(), resolved.parameters.values()
    assert {each for each in shipped if shipped[each] != own[each]} == {changed}
    assert resolved.parameters.content_hash() != SHIPPED[name].content_hash()
    assert crashes[1].sum() > crashes[0].sum() > 10


LEAD, OUT = LADDERS
WRONG = [
    (LEAD, assumed("braking", peak_scale_mps2=-1.0), r"braking\.peak_scale_mps2"),
    (LEAD, assumed("braking", lowest_peak_mps2=11.0), r"braking\.lowest_peak_mps2"),
    (LEAD, assumed("approach", duration_s=30.05), r"approach\.duration_s"),
    (LEAD, assumed("approach", duration_s=40.0), "approach.*the road is 4 km long"),
    (LEAD, assumed("exposure", per_hour=0.0), r"exposure\.per_hour"),
    (LEAD, assumed("free_driving", lowest_mps2=1.5), r"free_driving\.lowest_mps2"),
    (LEAD, assumed("fit_range", r1_max_m=11.5), r"initial_state\.r1_\*.*nan m.*at v = 35 m/s"),
    (LEAD, {"like": "cut-out-1"}, "like.*lead-brakes-1"),
    (OUT, assumed("leaving", careless_least_s=2.5), r"leaving\.careless_least_s"),
    (OUT, assumed("leaving", careless_least_s=12.0, careless_most_s=20.0), "leaving.*careless"),
    (OUT, assumed("leaving", lateral_median_mps=0.05), "leaving.*lateral"),
    (OUT, assumed("initial_state", v_location_mps=900.0), r"initial_state\.v_location_mps.*no speed"),
    (OUT, {"leaving": {"drop_mean": {"value": 0.1, "source": "assumed", "range": [0.2, 0.3]}}}, r"leaving\.drop_mean"),
]


@pytest.mark.parametrize(("name", "content", "words"), WRONG)
def test_a_wrong_number_gives_one_error_with_its_place(name, content, words, tmp_path):
    with pytest.raises(CampaignError, match=words) as caught:
        resolve(load_campaign("idm", [f"scenario={name}", own_file(tmp_path, name, content)]))
    assert str(caught.value).count("expected") == 1


def test_a_file_that_says_what_was_counted_gives_a_counted_exposure_of_the_events_in_scope():
    counted = {"per_hour": {"value": 2.0, "source": "fitted", "range": [1.1, 3.4]}, "events": 10, "hours": 5.0}
    parameters = CutOutParameters.model_validate({"like": "cut-out-1", "exposure": counted})
    told = CUT_OUT.exposure(CUT_OUT.traffic(EnvironmentSettings(), parameters), parameters)
    assert told.counted[0] == 10
    assert told.counted[1] > 100 * 5.0  # few of them ask for braking
    assert told.per_hour == pytest.approx(10 / told.counted[1])
