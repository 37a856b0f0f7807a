"""The parameter file: every number reaches the kernels, a wrong one is named; how long cut-ins show themselves."""

import math
from itertools import product

import numba
import numpy as np
import pytest
import yaml

from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError
from harness.families.cut_in import lateral as of_lateral
from harness.families.cut_in.lateral import constant_lead, log_normal_speed
from harness.families.cut_in.loading import load_environment, load_parameters
from harness.families.cut_in.parameters import EnvironmentParameters
from harness.vehicles.sideways import lateral_position, perceived_in
from tests.golden.campaigns import LATERAL_FILE
from tests.kernels import cut_in_terms
from tests.traffic.tables import DATA, SHIPPED, of, tabled

PAPER, LATERAL = "ndd-overtaking-1", LATERAL_FILE
TEXT = SHIPPED.read_text(encoding="utf-8")
NUMBERS = [(section, name) for section, numbers in DATA.items() if isinstance(numbers, dict) for name in numbers]
NOT_NUMBERS = [".nan", "'1'", "null", "1" + "0" * 400]
DF = "  df: {value: 16.0, source: ndd}"


@pytest.fixture
def mine(tmp_path):
    """An environment of the user's own, from the text of its file, or its content."""

    def environment(content):
        path = tmp_path / "mine.yaml"
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content), encoding="utf-8")
        return EnvironmentSettings(parameters=str(path))

    return environment


def changed(*changes):
    """The shipped file in which each (section, name, value) is changed."""
    text = TEXT
    for section, name, value in changes:
        begin = text.index(f"\n  {name}: ", text.index(f"\n{section}:")) + 1
        text = text[:begin] + f"  {name}: {{value: {value}, source: user}}" + text[text.index("\n", begin) :]
    return text


def refusal(section):
    try:
        load_parameters(section)
    except CampaignError as error:
        return str(error)
    return None


def test_every_number_reaches_the_kernels():
    record = load_environment(
        EnvironmentSettings(parameters=PAPER, lane_change_level=350.0, acceleration_hold_s=0.1)
    ).numbers
    assert len(NUMBERS) > 70
    for section, name in NUMBERS:
        assert record[f"{section}__{name}"] == DATA[section][name]["value"]
    assert record[["level", "hold_steps", "max_steps"]].item() == (350.0, 1, 200)


def test_the_hash_is_that_of_the_numbers_alone(mine):
    shipped = load_parameters(EnvironmentSettings(parameters=PAPER))
    assert shipped.content_hash() == "838b5235175d4be5"  # as of the first version
    noted = load_parameters(mine(TEXT.replace(DF, "  df: {value: 16.0, source: user, note: checked}")))
    assert noted.content_hash() == "838b5235175d4be5"
    assert DF in TEXT
    other = load_parameters(mine(TEXT.replace(DF, "  df: {value: 16.000000001, source: ndd}")))
    assert other.content_hash() != "838b5235175d4be5"


def lateral(**numbers):
    lines = [f"  {name}: {{value: {value}, source: user}}\n" for name, value in numbers.items()]
    return TEXT + "lateral:\n" + "".join(lines)


SIDEWAYS = {"distance_m": 1.7, "speed_median_mps": 0.7, "speed_log_sd": 0.3}
RANGED = {"value": 1.0, "source": "user"}
REFUSED = [
    *((changed(("cut_in", "ignore_share", text)), "cut_in.ignore_share.value") for text in ["7", *NOT_NUMBERS]),
    (changed(("initial_state", "r2_min_m", "100"), ("initial_state", "r2_max_m", "20")), "initial_state.r2_min_m"),
    (changed(("initial_state", "r2dot_min_mps", "-5"), ("initial_state", "r2dot_max_mps", "-10")), "r2dot_min_mps"),
    (changed(("fit_range", "v_min_mps", "40"), ("fit_range", "v_max_mps", "20")), "fit_range.v_min_mps"),
    (changed(("fit_range", "v_max_mps", "55")), "speeds of the AV"),
    (changed(("scenario", "duration_s", "10.05")), "scenario.duration_s.value"),
    (changed(("cut_in", "intercept", "-999")), "cut_in"),
    (changed(("cut_in", "intercept", "999")), "a wish to change lanes of inf"),
    (changed(("cut_in", "ignore_share", "0"), ("cut_in", "accept_scale_s", "0.001")), "cut_in.accept_scale_s"),
    (changed(("initial_state", "v_location_mps", "900")), "initial_state.v_location_mps"),
    (changed(("initial_state", "r1_shift_m", "300")), "initial_state.r1_*"),
    (changed(("initial_state", "r1dot_log_scale", "5")), "initial_state.r1dot_*"),
    (changed(("free_driving", "log_scale", "-20")), "noise of scale"),
    (lateral(distance_m=1.7, speed_log_sd=0.3, longest_lead_s=4.0), "lateral.speed_median_mps"),
    (lateral(**SIDEWAYS, longest_lead_s=0.55), "lateral.longest_lead_s.value"),
    (lateral(**SIDEWAYS | {"distance_m": 0.0}, longest_lead_s=4.0), "lateral.distance_m.value"),
    (tabled(acceptance_steps__share=of([0.5] * 5)), "acceptance_steps.share"),
    (tabled(acceptance_steps__share=of([0.0] * 6)), "acceptance_steps.share.0.value"),
    (tabled(acceptance_steps__events=[1, 2]), "acceptance_steps.events"),
    (tabled(hazard_table__v_mps=of([20.0, 20.0, 30.0])), "hazard_table.v_mps"),
    (tabled(hazard_table__r1_log=of([0.0, 1.0])), "hazard_table.r1_log"),
    (tabled(cut_in__ignore_share={"value": 0.1, "source": "user"}), "ignore_share besides"),
    (tabled() | {"hazard_table": None}, "u, log_gap"),
    (tabled(guard__margin_m={**RANGED, "range": [2.0, 3.0]}), "guard.margin_m.range"),
    ("like: ndd-overtaking-3\n", "like ("),
    ("like: ndd-overtaking-1\nguard: {margn_m: {value: 2.0, source: user}}\n", "guard.margn_m"),
]


@pytest.mark.parametrize(("text", "named"), REFUSED, ids=[named for _, named in REFUSED])
def test_what_does_not_fit_together_names_the_place(mine, text, named):
    said = refusal(section := mine(text))
    assert named in said
    assert section.parameters in said


# -- tables in place of formulas, and what is known of numbers --


def test_a_table_reaches_the_kernels_linear_between_its_knots_and_constant_beyond(mine):
    given = load_environment(mine(tabled()))
    assert given.numbers.dtype == load_environment(EnvironmentSettings()).numbers.dtype  # kernels are compiled once
    states = [(30.0, 20.0, 0.0), (25.0, 10.0, 4.0), (50.0, 200.0, -20.0), (0.0, -1.0, 99.0)]
    approaches = [(9.9, -10.0), (10.0, -10.0), (24.9, -10.0), (1e3, -10.0), (5.0, 0.0), (5.0, 3.0), (0.0, -1.0)]
    numbers = cut_in_terms([(*state, *approach) for state, approach in product(states, approaches)], env=given)
    log_wish = [-9.0 - 2.0, -8.5 - 1.0 + 0.75, -8.0 - 3.5 + 1.0, -8.0 + 1.5]
    accepted = [0.01, 0.02, 0.03, 1.0, 1.0, 1.0, 0.0]
    np.testing.assert_allclose(numbers[:, :2], list(product(np.exp(log_wish), accepted)), rtol=1e-12)


def test_other_values_make_another_environment_and_what_is_known_of_them_does_not():
    known = EnvironmentParameters.model_validate(tabled())
    values = known.values()
    assert values["acceptance_steps__share__4"] == 0.5
    assert {name for name in values if name.startswith("cut_in")} == {"cut_in__max_probability_1s"}
    moved = known.with_values({"acceptance_steps__share__4": 0.6, "free_driving__df": 9})
    changes = {name for name, value in moved.values().items() if value != values[name]}
    assert changes == {"acceptance_steps__share__4", "free_driving__df"}
    noted = {"acceptance_steps__events": None, "guard__margin_m": {**DATA["guard"]["margin_m"], "range": [0.5, 2.0]}}
    tied = {"replicates": {"file": "many.parquet", "sha256": "0"}}
    same = EnvironmentParameters.model_validate({**tabled(**noted), **tied})
    assert same.content_hash() == known.content_hash() != moved.content_hash()
    assert same.with_values({"guard__margin_m": 3.0}).values()["guard__margin_m"] == 3.0  # also beyond its range


def test_an_environment_is_like_another_but_for_what_it_says(mine):
    own = load_parameters(
        mine("like: ndd-overtaking-2\nlateral: null\nguard: {margin_m: {value: 2.0, source: user}}\n")
    )
    other = load_parameters(EnvironmentSettings(parameters="ndd-overtaking-2"))
    assert own.values() == {**of_all_but(other, "lateral"), "guard__margin_m": 2.0}


def of_all_but(parameters, section):
    return {name: value for name, value in parameters.values().items() if not name.startswith(section)}


# -- leads: by known answers, files by their rules, hashes that stay where nothing is said --


draw_lead = numba.njit(of_lateral.draw_lead, error_model="numpy")  # not cached: what kernels inline


def leads(law, n=20_000, seed=1):
    return np.array([draw_lead(57, seed, path, law) for path in range(n)])


@pytest.mark.parametrize("lead_s", [0.0, 0.1, 0.5, 2.0])
def test_a_constant_lead_is_always_that_also_in_place_of_the_files(lead_s):
    instead = load_environment(EnvironmentSettings(parameters=LATERAL, cut_in_lead_s=lead_s)).lateral
    assert instead.distance_m == 1.7
    for lateral in (constant_lead(lead_s), instead):
        assert set(leads(lateral, 500).tolist()) == {round(10 * lead_s)}


def test_leads_of_a_log_normal_speed_have_its_quantiles():
    """1.7 m at a median of 0.69 m/s: half of the leads are below 2.46 s; a speed of 1.39 m/s is two deviations up."""
    lateral = log_normal_speed(1.7, 0.69, 0.35, 4.0)
    assert lateral.cumulative.size == 41
    assert lateral.cumulative[24] == pytest.approx(0.5, abs=0.01)  # up to 2.45 s
    two = 1.7 / (0.69 * math.exp(2 * 0.35))
    assert np.interp(two, 0.1 * (np.arange(41) + 0.5), lateral.cumulative) == pytest.approx(0.0228, abs=0.002)
    found = leads(lateral)
    assert (found == 40).mean() == pytest.approx(1.0 - lateral.cumulative[39], abs=0.01)
    # Kolmogorov's bound: a right sampler fails once in a thousand seeds.
    share = np.array([(found <= k).mean() for k in range(41)])
    assert np.abs(share - lateral.cumulative).max() < 1.95 / math.sqrt(found.size)
    assert np.abs(share - log_normal_speed(1.7, 0.69, 0.5, 4.0).cumulative).max() > 1.95 / math.sqrt(found.size)


@pytest.mark.parametrize(
    ("perceives_m", "lead", "expected"),
    [(0.0, 10, 91), (0.375, 10, 94), (0.375, 15, 90), (0.85, 10, 96), (1.7, 10, 101), (9.0, 10, 101), (0.375, 0, 101)],
)
def test_who_perceives_so_much_may_act_from_that_step(perceives_m, lead, expected):
    """BV cuts in in step 100. 0.375 of 1.7 m take 2.2 of 10 steps, and 3.3 of 15: the next whole one counts."""
    first, earlier = perceived_in(perceives_m, 100, lead, 1.7)
    assert first == expected
    reached = lateral_position(first, 100, lead, 1.7)
    assert reached >= min(perceives_m, 1.7) - 1e-9
    assert lead == 0 or first == 91 or lateral_position(first - 1, 100, lead, 1.7) < perceives_m
    assert earlier == pytest.approx((reached - min(perceives_m, 1.7)) * lead / 1.7, abs=1e-8)
