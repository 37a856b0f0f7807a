"""A small super-population: its truths, and pools drawn from it with equals left out and the boundary replaced."""

from __future__ import annotations

import numpy as np
import pytest

from harness.campaign.sections import EnvironmentSettings, PoolSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.pool.build import build_pool
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.traffic.loading import load_environment
from harness.vehicles.library import load_library
from studies.replication.experiment import Adversary
from studies.replication.populations import RATE, Drivers, Truths, enumerate_paths
from studies.replication.shells import Division, campaign_block, equals

PATHS = 1024
ENVIRONMENT = load_environment(EnvironmentSettings())
LIBRARY = load_library("ladder-1")
AVS = {
    name: AutomatedVehicle.model_validate(av)
    for name, av in {
        "own": {"model": "idm"},
        "equal": {"model": "idm", "parameters": {"min_acceleration_mps2": -3.0}},
        "late": {"model": "idm", "reaction": {"inattention_probability": 0.25, "inattention_delay_s": 1.5}},
        "attentive-late": {"model": "idm", "reaction": {"delay_s": 1.5}},
        "wild": {"model": "constant", "parameters": {"acceleration_mps2": 0.0}},
        "faster": {"model": "constant", "parameters": {"acceleration_mps2": 3.0}},
    }.items()
}


def drivers_of(*names) -> Drivers:
    return Drivers.of(LIBRARY, {name: AVS[name] for name in names})


@pytest.fixture(scope="module")
def drivers():
    return drivers_of("own", "equal", "late", "attentive-late")


def enumerated(drivers, paths=PATHS):
    return enumerate_paths(ENVIRONMENT, drivers, 3, paths, Progress())


@pytest.fixture(scope="module")
def population(drivers):
    return enumerated(drivers)


def shells_of(drivers, population, name="own", paths=256):
    """Cut-ins without the equals of a vehicle, and its pools."""
    crashing = population.crash_mass(drivers.vehicles[name])
    division = Division(LIBRARY, population, [crashing], paths, limit_mps2=acceleration_limit(AVS[name]))
    return division, division.of_vehicle(crashing)


def test_imprecise_truths_are_enumerated_again_and_agree():
    truths = Truths(ENVIRONMENT, drivers_of("own", "wild"), 3, PATHS, Progress())
    own, wild = (truths.vehicle(name)[RATE] for name in ("own", "wild"))
    assert own.value == pytest.approx(1.343e-7, abs=4.0 * own.std_error)
    assert own.relative_error < 0.02  # once would leave some 2 %
    assert wild.value == pytest.approx(2.43e-5, abs=4.0 * wild.std_error)


def test_equals_are_found_and_left_out(drivers, population):
    vehicle = population.crash_mass(drivers.vehicles["equal"])
    assert equals(LIBRARY, population, vehicle) == {"brakes-3"}
    _, source = shells_of(drivers, population, "equal")
    assert source.left_out == ("brakes-3",)
    assert "brakes-3" not in source.template.names
    assert equals(LIBRARY, population, population.crash_mass(drivers.vehicles["own"])) == set()
    assert equals(LIBRARY, population, np.zeros_like(vehicle)) == set()  # one that never crashes is nobody's equal


def test_drawn_pools_scatter_around_the_population(drivers, population):
    _, source = shells_of(drivers, population)
    assert source.mass.sum() == pytest.approx(population.cut_in.sum(), rel=1e-12)
    assert source.crashing[0].sum() == pytest.approx(population.crash_mass(drivers.vehicles["own"]).sum(), rel=1e-12)
    drawn = [source.draw(np.random.default_rng([1, k]))[0] for k in range(300)]
    rates = np.array([each.design.p @ each.share for each in drawn])
    exact = source.crashing[0].sum() / population.cut_in.size
    assert abs(rates.mean() - exact) < 4.0 * rates.std() / np.sqrt(len(rates))
    assert all(each.design.strata[-1] == "outside" for each in drawn)
    assert all(each.design.statements[-1].boundary == LIBRARY.boundary for each in drawn)


@pytest.mark.slow
def test_real_pools_have_the_shells_of_drawn_ones(drivers):
    """A pool as a campaign builds it, from other paths: shell probabilities and their errors agree."""
    paths = 16_384
    population = enumerated(drivers, paths)
    _, source = shells_of(drivers, population, paths=paths)
    real = build_pool(ENVIRONMENT, LIBRARY, PoolSettings(relative_error=0.01, seed=7), "real")
    template = source.template
    assert real.names == template.names
    kept = [real.cut_ins.path_mass[real.shell == s, s].mean(dtype=float) for s in range(real.shell_p.size)]
    # A kept cut-in is a draw in proportion to its path's mass.
    squares = (source.mass**2).mean(0), real.shell_p * kept
    errors = [
        np.sqrt(np.maximum(square - pool.shell_p**2, 0.0) / n)
        for square, pool, n in zip(squares, (template, real), (paths, real.n_paths), strict=True)
    ]
    assert np.all(np.abs(real.shell_p - template.shell_p) < 4.5 * np.hypot(*errors))
    ratio = errors[1] * np.sqrt(real.n_paths) / (errors[0] * np.sqrt(paths))
    assert np.all((ratio[:5] > 0.6) & (ratio[:5] < 1.6))  # inside; outside the aims differ


def adversary_of(drivers, population, **made):
    division, source = shells_of(drivers, population)
    adversary = Adversary(of="own", **made)
    crashing = population.crash_mass(drivers.vehicles["own"])
    return source, division.of_vehicle(division.as_adversary(adversary, crashing), adversary)


def test_an_adversary_on_the_heaviest_paths_has_a_share_of_the_crashes_on_few_of_them(drivers, population):
    source, heavy = adversary_of(drivers, population, crashes="on_heaviest_paths", share=0.3)
    _, light = adversary_of(drivers, population, crashes="on_lightest_paths", share=0.3)
    inside = source.template.boundary + 1
    for made in (heavy, light):
        assert 0.2 < made.crashing[0][:, :inside].sum() / source.crashing[0][:, :inside].sum() <= 0.3
    used = [int((made.crashing[0][:, :inside].sum(1) > 0.0).sum()) for made in (heavy, light)]
    assert used[0] < 0.2 * used[1]


def test_an_adversary_with_a_hole_crashes_outside_in_that_share(drivers, population):
    source, made = adversary_of(drivers, population, hole=0.01)
    outside, mass = slice(source.template.boundary + 1, -1), source.mass
    assert np.all(made.crashing[0][:, outside] >= (0.01 - 1e-12) * mass[:, outside])
    hole = 0.01 * mass[:, outside].sum()
    assert made.crashing[0].sum() == pytest.approx(source.crashing[0].sum() + hole, rel=0.05)
    before = source.crashes_outside(source.crashing[0])
    after = made.crashes_outside(made.crashing[0])
    assert all(after[name] > share for name, share in before.items())


def test_cells_divide_strata_by_what_references_do():
    """Pools with references: rates, moments and cells of the design are those of the drawn paths, test by test."""
    library = load_library("ladder-2")
    drivers = Drivers.of(library, {"own": AVS["own"]})
    population = enumerated(drivers)
    crashing = population.crash_mass(drivers.vehicles["own"])
    source = Division(library, population, [crashing], 512, limit_mps2=2.0).of_vehicle(crashing)
    (drawn,) = source.draw(np.random.default_rng(4))
    design = drawn.design
    np.testing.assert_allclose(drawn.mass.mean(0), design.cell_p, rtol=1e-12)
    crash_too = (np.array(design.cell_references) & 1).astype(bool)
    of_reference = drawn.mass[:, crash_too].sum(1)
    assert design.reference_rate[0] == pytest.approx(of_reference.mean(), rel=1e-9)
    assert design.reference_square[0] == pytest.approx((of_reference**2).mean(), rel=1e-9)
    rng, added = np.random.default_rng(5), np.full(design.p.size, 20_000)
    block = campaign_block(drawn, added, 0, rng)
    np.testing.assert_array_equal(np.bincount(block.stratum), added)
    tests, crashes = (np.bincount(block.cell[rows], minlength=crash_too.size) for rows in (..., block.crash))
    expected = 20_000 * design.cell_p / design.p[list(design.cell_stratum)]
    assert np.all(np.abs(tests - expected) < 5.0 * np.sqrt(expected + 1.0))
    mass = drawn.mass.sum(0)
    share = np.divide(drawn.crash_mass.sum(0), mass, out=np.zeros_like(mass), where=mass > 0.0)
    assert np.all(np.abs(crashes - tests * share) < 5.0 * np.sqrt(tests * share * (1.0 - share) + 1.0))


def test_pairs_are_divided_into_both_only_a_and_only_b(drivers, population):
    a, b = (population.crash_mass(drivers.vehicles[name]) for name in ("own", "equal"))
    division = Division(LIBRARY, population, [a, b], 256, limit_mps2=2.0)
    both, only_a, only_b = division.of_pair(a, b).crashing
    np.testing.assert_allclose(both + only_a, division.by_cell(a), atol=1e-22)
    np.testing.assert_allclose(both + only_b, division.by_cell(b), atol=1e-22)
    assert only_b.sum() > 0.05 * b.sum()  # brakes less hard
    assert only_a.sum() == pytest.approx(0.0, abs=1e-20)
    same = division.of_pair(a, a).crashing
    assert (same[1].sum(), same[2].sum()) == (0.0, 0.0)
    pools = division.of_pair(a, b).draw(np.random.default_rng(2))
    assert [pool.design is pools[0].design for pool in pools] == [True] * 3
    mass = sum(pool.crash_mass for pool in pools)
    assert np.all(mass <= pools[0].mass * (1.0 + 1e-9))
