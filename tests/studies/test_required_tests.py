"""RNoT as published: known answers, rules at the edges, that nothing but seed and records decides; the command."""

import json
from dataclasses import replace

import numpy as np
import pytest

from harness.estimators.block import joined
from harness.estimators.scv import Scv
from harness.runner.stored import stored_blocks
from studies import rnot
from studies.__main__ import main
from studies.chains.chain import overtaking
from studies.chains.sampler import blocks
from tests.chains.seed import SEED
from tests.estimators.small_blocks import fed

CHAIN = overtaking("two surrogates", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=6)
GRID = np.array([10, 20, 30, 40, 50])
QUICK = rnot.Procedure(rhw=0.6, n_shuffles=5, ratio=1.3, seed=3)


def read(*rhw: float) -> rnot.RequiredTests:
    return rnot.required_tests(np.array([rhw]), GRID, 0.3)


@pytest.mark.parametrize(
    ("rhw", "n", "never_reached", "never_above"),
    [
        ((0.9, 0.2, 0.5, 0.3, 0.1), 40, False, False),  # a dip below the threshold does not count
        ((0.1, 0.15, 0.25, 0.2, 0.1), 30, False, True),  # nothing above it: the n of the largest
        ((0.2, 0.2, 0.1, 0.2, 0.1), 10, False, True),
        ((0.9, 0.9, 0.9, 0.9, 0.3), 50, False, False),
        ((0.1, 0.1, 0.1, 0.1, 0.31), 50, True, False),
        ((0.1, 0.1, 0.1, 0.1, np.inf), 50, True, False),
        ((0.1, 0.1, 0.1, 0.1, np.nan), 50, True, False),
    ],
)
def test_the_required_number_is_the_first_look_from_which_on_the_width_stays_below(rhw, n, never_reached, never_above):
    found = read(*rhw)
    assert (found.n, found.never_reached, found.never_above) == (n, never_reached, never_above)
    assert found.is_lower_limit == never_reached


def test_the_acceleration_says_on_which_side_of_the_truth_it_is():
    slow, fast = read(0.9, 0.9, 0.9, 0.1, 0.1), read(0.9, 0.1, 0.1, 0.1, 0.1)
    never = read(0.9, 0.9, 0.9, 0.9, 0.9)
    assert rnot.acceleration(slow, fast) == (2.0, "equal")
    assert rnot.acceleration(never, fast) == (2.5, "at least")
    assert rnot.acceleration(fast, never) == (0.4, "at most")
    assert rnot.acceleration(never, never)[1] == "unknown"


def test_the_grid_rises_to_the_total():
    assert rnot.Procedure(first=10, ratio=2.0).grid(100).tolist() == [10, 20, 40, 80, 100]
    assert rnot.Procedure(first=10, ratio=1.01, total=13).grid(100).tolist() == [10, 11, 12, 13]
    assert rnot.Procedure(first=10).grid(4).tolist() == [4]


def test_the_width_on_a_prefix_is_that_of_its_mean_and_sample_variance():
    tests = next(iter(blocks(CHAIN, "step_mixture", [800], SEED)))
    procedure = replace(QUICK, first=2)
    grid = procedure.grid(800)
    rhw = rnot.plain_rhw(tests.weighted_crashes()[tests.crash], 800, procedure)
    for shuffle in range(procedure.n_shuffles):
        y = tests.weighted_crashes()[rnot.shuffled(procedure.seed, shuffle, tests.crash)]
        for at, n in enumerate(grid):
            mean, error = np.mean(y[:n]), np.std(y[:n], ddof=1) / np.sqrt(n)
            expected = procedure.z * error / mean if mean else np.inf
            assert rhw[shuffle, at] == pytest.approx(expected, rel=1e-9)
        assert sorted(rnot.shuffled(procedure.seed, shuffle, tests.crash)) == list(range(800))


def test_algorithm_1_grown_look_by_look_is_algorithm_1_on_each_prefix():
    (tests,) = blocks(CHAIN, "step_mixture", [3_000], SEED)
    procedure = replace(QUICK, ratio=3.0, n_shuffles=2)
    grown = rnot.scv_rhw(tests, procedure)
    for shuffle in range(2):
        order = rnot.shuffled(procedure.seed, shuffle, tests.crash)
        for at, n in enumerate(procedure.grid(3_000)):
            anew = fed(Scv(), [tests.chosen(order[:n])])
            assert grown[shuffle, at] == anew.result(procedure.confidence).rhw


def test_a_stored_run_gives_what_its_blocks_give(stored_run, capsys):
    folder = stored_run("step-recursive-twin")
    options = ["--rhw", "0.6", "--shuffles", "5", "--seed", "3", "--ratio", "1.3", "-e", "nade", "-e", "scv", "--json"]
    assert main(["rnot", str(folder), *options]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    tests = joined(list(stored_blocks(folder, moments=True)))
    grid = QUICK.grid(240)
    nade = rnot.required_tests(rnot.plain_rhw(tests.weighted_crashes()[tests.crash], 240, QUICK), grid, QUICK.rhw)
    scv = rnot.required_tests(rnot.scv_rhw(tests, QUICK), grid, QUICK.rhw)
    assert [row["mean"] for row in rows] == [nade.mean, scv.mean]
    assert (rnot.SCV_REMARK in rows[1]["remarks"], rnot.SCV_REMARK in rows[0]["remarks"]) == (True, False)
    assert rows[0]["grid"] == f"10 to 240 by 0.3 n ({len(grid)} looks)"


def test_the_command_refuses_shells_in_plain_words(stored_run, capsys):
    assert main(["rnot", str(stored_run("shells-twin"))]) == 2
    assert "drawn from shells" in capsys.readouterr().err
