"""Grids of lead braking and cut-outs are laws: they sum to 1, have the right tails, and stay so where numbers move."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, lognorm

from harness.campaign.files import load_campaign
from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError
from harness.families import family_named
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_out.family import CUT_OUT, CutOutParameters
from harness.records.schemas import chosen_from, episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import CRASH
from harness.worlds.twin import TwinWorld
from tests.families.roads import SETTINGS
from tests.families.test_same_bits import LADDERS, resolved_of, run

SHIPPED = {name: family_named(name).parameters(SETTINGS) for name in LADDERS}


@st.composite
def moved(draw, name):
    """Parameters with any of the numbers moved that have a range, within it."""
    ranges = {key: number.range for key, number in SHIPPED[name].numbers().items() if number.range is not None}
    keys = draw(st.sets(st.sampled_from(sorted(ranges))))
    return SHIPPED[name].with_values({key: draw(st.floats(*ranges[key])) for key in sorted(keys)})


@pytest.mark.parametrize("name", LADDERS)
@given(data=st.data())
@settings(max_examples=60)
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


# -- how often there are events: what was counted, and its limits --


def test_a_counted_exposure_is_what_it_is_counted_from():
    """Exact Poisson limits at 90 %: half a quantile of χ² with 2 k and 2 k + 2 degrees of freedom."""
    told = CUT_IN.exposure(None, None)
    k, hours = told.counted
    low, high = 0.5 * chi2.ppf(0.05, 2 * k) / hours, 0.5 * chi2.ppf(0.95, 2 * k + 2) / hours
    assert (told.per_hour, told.low, told.high) == pytest.approx((k / hours, low, high), abs=5e-4)


def test_a_file_that_says_what_was_counted_gives_a_counted_exposure_of_the_events_in_scope():
    counted = {"per_hour": {"value": 2.0, "source": "fitted", "range": [1.1, 3.4]}, "events": 10, "hours": 5.0}
    parameters = CutOutParameters.model_validate({"like": "cut-out-1", "exposure": counted})
    told = CUT_OUT.exposure(CUT_OUT.traffic(EnvironmentSettings(), parameters), parameters)
    assert told.counted[0] == 10
    assert told.counted[1] > 100 * 5.0  # few of them ask for braking
    assert told.per_hour == pytest.approx(10 / told.counted[1])
