"""What families say of an event, and where a vehicle that leaves its lane is drawn."""

import math

import numpy as np
import pyarrow as pa
import pytest

from harness.families import families, family_named
from harness.report.player import LANE_M, share_over


@pytest.mark.parametrize(
    ("name", "facts", "said"),
    [
        ("lead_brakes", {"peak_mps2": 6.3, "held_s": 1.5}, "with 6.3 m/s² for 1.5 s"),
        ("lead_brakes", {"peak_mps2": 4.1, "held_s": math.inf}, "with 4.1 m/s² to a standstill"),
        (
            "cut_out",
            {"revealed_speed_mps": 0.0, "closing_mps": 30.0, "lateral_speed_mps": 0.9},
            "at 0.9 m/s sideways, and reveals one that stands",
        ),
    ],
)
def test_an_event_is_told_by_its_facts(name, facts, said):
    assert family_named(name).told(facts) == said


def test_the_headway_of_lead_braking_is_the_gap_over_the_speed_of_the_av():
    headway = family_named("lead_brakes").maps[0][0]
    rows = {"event_gap_m": np.array([42.0]), "lead_speed_mps": np.array([30.0]), "event_rate_mps": np.array([2.0])}
    assert headway.of(rows) == pytest.approx([42.0 / 28.0])


def test_every_family_but_cut_ins_speaks_of_no_cut_in():
    for name in ("lead_brakes", "cut_out"):
        words = families()[name].words
        texts = [*(each for each in words if isinstance(each, str)), words.tests(False), words.rests(None, "1")]
        assert not [text for text in texts if "cut-in" in text or "cuts in" in text or "BV" in text]


def test_a_vehicle_that_leaves_its_lane_goes_from_right_to_left():
    track = pa.table({"lane": [0, 0, 1], "lateral_m": [0.0, 0.9, 1.8]})
    assert share_over(track) == pytest.approx([1.0, 1.0 - 0.9 / LANE_M, 0.5])
