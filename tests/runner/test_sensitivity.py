"""What an answer depends on: a rate that is in proportion to one number, and hardly moves with others."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from harness.campaign.sections import EnvironmentSettings
from harness.cli import main
from harness.families.cut_in.loading import load_parameters
from harness.families.cut_in.parameters import SHIPPED_FOLDER
from harness.progress import Progress
from harness.report.rows import bar_note
from harness.runner.sensitivity import Move, bar_of, bar_of_readings, moves, sensitivity
from harness.runner.stored_shells import Nearby, StoredShells
from harness.strata import Reference
from tests.stored_runs import copy_of, manifest
from tests.traffic.tables import TEXT, fitted

pytestmark = pytest.mark.usefixtures("few_paths")


@pytest.fixture
def folder(stored_run, tmp_path):
    """A run that may be changed."""
    return copy_of(stored_run("shells-twin"), tmp_path / "run")


def test_the_rate_is_in_proportion_to_who_does_not_look_and_the_ratio_is_not(folder):
    ranges = {"cut_in.accept_ttc_s": (7.0, 8.0), "cut_in.ignore_share": (0.005, 0.04)}
    content = sensitivity(folder, ranges=ranges)
    look, accept = content["bars"]  # the longest first
    assert (look["what"], look["known"], look["values"]) == ("cut_in.ignore_share", "assumed", [0.005, 0.04])
    assert look["rate"] == pytest.approx([0.5, 4.0], rel=0.01)
    assert look["ratio"] == pytest.approx([1.0, 1.0], rel=0.005)
    assert accept["rate"] == pytest.approx([1.0, 1.0], abs=0.03)
    assert content["campaign_hash"] == manifest(folder)["campaign_hash"]


@pytest.mark.slow
def test_of_traffic_in_which_nobody_crashes_nothing_is_said(folder, capsys):
    """Tests too short for a crash: the reference driver's rate is 0, to which there is no ratio."""
    assert main(["sensitivity", str(folder), "--range", "scenario.duration_s=1:2", "--json"]) == 0
    (bar,) = (each for each in json.loads(capsys.readouterr().out)["bars"] if each["what"] == "scenario.duration_s")
    assert (bar["rate"], bar["ratio"], bar_note(bar)) == ([None, None], [None, None], "unlike what was tested")


def test_other_readings_of_the_regulations_driver_move_the_ratio_alone(stored_run):
    design = StoredShells.of(stored_run("shells-twin"), Progress(), "").design
    named = [Reference("cc", ""), Reference("cc-letter", ""), Reference("cc-early", ""), Reference("fsm", "")]
    rates = np.array([2.0e-4, 2.0e-3, 0.5e-4, 1e-9])
    (bar,) = bar_of_readings(replace(design, references=tuple(named), reference_rate=rates, reference_square=rates))
    assert (bar.rate, bar.ratio) == ((1.0, 1.0), pytest.approx((0.1, 4.0)))
    assert not bar_of_readings(design)


def test_what_was_fitted_together_moves_together(tmp_path):
    """Replicates move a block at a time; a standard error moves a number where there are none."""
    columns = {
        "cut_in__intercept": [-8.0, -9.0],
        "cut_in__ignore_share": [0.01, 0.02],
        "free_driving__df": [15.0, 17.0],
    }
    text = TEXT.replace("df: {value: 16.0, source: ndd}", "df: {value: 16.0, source: fitted, se: 2.0}")
    (tmp_path / "one.yaml").write_text(text)
    found = {}
    for name, file in (("one", str(tmp_path / "one.yaml")), ("both", fitted(tmp_path, text, **columns))):
        parameters = load_parameters(EnvironmentSettings(parameters=file))
        found[name] = {move.what: move.settings for move in moves(file, parameters, SHIPPED_FOLDER, {})}
    assert found["one"] == {"free_driving.df": [{"free_driving__df": pytest.approx(16.0 + k * 3.29)} for k in (-1, 1)]}
    assert found["both"] == {
        "free driving": [{"free_driving__df": 15.0}, {"free_driving__df": 17.0}],
        "cut-in": [
            {"cut_in__intercept": -8.0, "cut_in__ignore_share": 0.01},
            {"cut_in__intercept": -9.0, "cut_in__ignore_share": 0.02},
        ],
    }


@pytest.mark.parametrize(
    ("option", "found"),
    [
        ("cut_in.look=0:1", "cut_in.look"),
        ("cut_in.ignore_share=0.1", "no two numbers"),
        ("cut_in.ignore_share=0.02:0.01", "the lower first"),
        (None, "no number has a standard error"),
    ],
)
def test_what_is_not_said_to_be_uncertain_is_refused(folder, capsys, option, found):
    assert main(["sensitivity", str(folder), *(["--range", option] if option else [])]) == 2
    assert found in capsys.readouterr().err
    assert not (folder / "sensitivity.json").exists()


@pytest.mark.parametrize(("n", "ends", "off"), [(1, [0.55, 1.45], [0.05, 0.15]), (3, [None, None], [None, None])])
def test_a_block_shows_what_is_answered_and_how_much_is_not(n, ends, off):
    """Of five replicates, n in which the reference driver comes out wrong by a factor of 3."""
    near = [Nearby(np.ones(1), rate, np.ones(1), rate / 10.0, 0.0) for rate in np.linspace(0.5, 1.5, 5 - n)]
    wrong = [Nearby(np.ones(1), 9.0, np.ones(1), 2.0, 0.0)] * n
    bar = bar_of(Move("cut-in", "fitted", None, []), [*near, *wrong])
    assert [None if math.isnan(end) else pytest.approx(end) for end in bar.rate] == ends
    assert [None if math.isnan(end) else pytest.approx(end) for end in bar.off] == off
    assert bar_note(asdict(bar)) == f"{n} of 5: unlike what was tested"


def test_each_end_of_a_number_is_off_by_its_own():
    near = [Nearby(np.ones(1), rate, np.ones(1), off, 0.0) for rate, off in ((0.5, 0.048), (1.5, 0.21))]
    bar = bar_of(Move("cut_in.ignore_share", "assumed", (0.0, 1.0), []), near)
    assert (bar.rate, bar.off) == ((0.5, 1.5), (0.048, 0.21))
