"""A small super-population: its truths, and pools drawn from it with equals left out and the boundary replaced."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.sections import EnvironmentSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.errors import HarnessError
from harness.estimators.block import Block, SamplingPlan
from harness.estimators.estimate import Estimate
from harness.estimators.likelihood import Level
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import RoundRule
from harness.estimators.tally import combined
from harness.families.cut_in.loading import load_environment
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.sampling.shells import ShellRounds
from harness.vehicles.library import load_library
from harness.vocabulary import CRASH, FAILED, TIMEOUT
from studies.replication.experiment import Adversary
from studies.replication.judgement import Subject, judge
from studies.replication.populations import (
    RATE,
    Drivers,
    choose_paths,
    enumerate_paths,
    of_vehicle,
    preventable_by,
    ratio_to,
    reference_drivers,
    walk_paths,
)
from studies.replication.shells import FREE, Division, ShellCampaign, equals, looks
from tests.golden.record import unlike
from tests.studies.here import Here, wrong_shell

pytestmark = pytest.mark.slow

PATHS = 1024
ENVIRONMENT = load_environment(EnvironmentSettings(parameters="ndd-overtaking-1"))
LIBRARY = load_library("ladder-2").model_copy(update={"references": {}})
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


def campaign_of(episodes) -> Campaign:
    content = {"testing": {"method": "shells"}, "stop": {"episodes": episodes, "rhw": None}}
    return Campaign.model_validate({"name": "x", "environment": {"parameters": "ndd-overtaking-1"}, **content})


def drivers_of(*names) -> Drivers:
    return Drivers.of(LIBRARY, {name: AVS[name] for name in names})


@pytest.fixture(scope="module")
def drivers():
    return drivers_of("own", "equal", "late", "attentive-late")


def enumerated(drivers, paths=PATHS):
    return enumerate_paths(ENVIRONMENT, Progress(), drivers, 3, paths)


@pytest.fixture(scope="module")
def population(drivers):
    return enumerated(drivers)


def shells_of(drivers, population, name="own", paths=256):
    """Cut-ins without the equals of a vehicle, and its pools."""
    crashing = population.crash_mass(drivers.vehicles[name])
    division = Division(LIBRARY, population, [crashing], paths, limit_mps2=acceleration_limit(AVS[name]))
    return division, division.of_vehicle(crashing)


def test_equals_are_found_and_left_out(drivers, population):
    vehicle = population.crash_mass(drivers.vehicles["equal"])
    assert equals(LIBRARY, population, vehicle) == {"brakes-3"}
    _, source = shells_of(drivers, population, "equal")
    assert "brakes-3" not in source.template.names
    assert equals(LIBRARY, population, population.crash_mass(drivers.vehicles["own"])) == set()
    assert equals(LIBRARY, population, np.zeros_like(vehicle)) == set()  # one that never crashes is nobody's equal


@pytest.mark.parametrize("made", [{"crashes": "on_heaviest_paths", "share": 0.3}, {"hole": 0.01}], ids=str)
def test_adversaries_crash_on_few_paths_inside_or_in_a_share_of_all_outside(made, drivers, population):
    division, source = shells_of(drivers, population)
    adversary, crashing = Adversary(of="own", **made), population.crash_mass(drivers.vehicles["own"])
    own, other = (
        source.crashing[0],
        division.of_vehicle(division.as_adversary(adversary, crashing), adversary).crashing[0],
    )
    n_inside = source.template.names.index(source.template.library.boundary) + 1
    inside, outside = slice(n_inside), slice(n_inside, -1)
    if "hole" in made:
        assert np.all(other[:, outside] >= (0.01 - 1e-12) * source.mass[:, outside])
        assert other.sum() == pytest.approx(own.sum() + 0.01 * source.mass[:, outside].sum(), rel=0.05)
    else:
        assert 0.2 < other[:, inside].sum() / own[:, inside].sum() <= 0.3
        assert (other[:, inside].sum(1) > 0.0).sum() < 0.2 * (own[:, inside].sum(1) > 0.0).sum()


@pytest.fixture(scope="module")
def with_references():
    """A pool with references, and the same as one of paths that the vehicle has walked."""
    library = load_library("ladder-2")
    drivers = Drivers.of(library, {"own": AVS["own"]})
    population = enumerated(drivers)
    crashing = population.crash_mass(drivers.vehicles["own"])
    sources = (
        Division(library, population, [crashing], 512, limit_mps2=2.0, shadow_runs=acts).of_vehicle(crashing)
        for acts in (False, True)
    )
    return [source.draw(np.random.default_rng(4))[0] for source in sources]


def test_cells_divide_strata_by_what_references_do(with_references):
    """Rates, moments and cells of the design are those of the drawn paths, test by test."""
    drawn, design = with_references[0], with_references[0].design
    np.testing.assert_allclose(drawn.mass.mean(0), design.cell_p, rtol=1e-12)
    crash_too = (np.array(design.cell_references) & 1).astype(bool)
    of_reference = drawn.mass[:, crash_too].sum(1)
    assert design.reference_rate[0] == pytest.approx(of_reference.mean(), rel=1e-9)
    assert design.reference_square[0] == pytest.approx((of_reference**2).mean(), rel=1e-9)
    rng, added = np.random.default_rng(5), np.full(design.p.size, 20_000)
    tests, crashed, _ = drawn.tests_of(added, rng)
    crashes = np.array([paths.size for paths in crashed])
    np.testing.assert_array_equal(tests @ design.joined, added)
    expected = 20_000 * design.cell_p / design.p[list(design.cell_stratum)]
    assert np.all(np.abs(tests - expected) < 5.0 * np.sqrt(expected + 1.0))
    mass = drawn.mass.sum(0)
    share = np.divide(drawn.crash_mass.sum(0), mass, out=np.zeros_like(mass), where=mass > 0.0)
    assert np.all(np.abs(crashes - tests * share) < 5.0 * np.sqrt(tests * share * (1.0 - share) + 1.0))


def as_block(drawn, tests, crashed, failed, first) -> Block:
    """The same tests as rows of records, those of a cell one after the other, in any order."""
    ends = zip(tests.tolist(), crashed, failed, strict=True)
    known = drawn.events
    rows = [
        (cell, outcome, path)
        for cell, (n, *bad) in enumerate(ends)
        for outcome, paths in zip((CRASH, FAILED, TIMEOUT), (*bad, [-1] * (n - sum(map(len, bad)))), strict=True)
        for path in paths
    ]
    cell, outcome, place = (np.array(column) for column in zip(*rows, strict=True))
    path = place if known is None else known.path[place]
    mass = np.where((place >= 0)[:, None], drawn.mass[path], 0.0)
    columns = {"stratum": np.array(drawn.design.cell_stratum)[cell], "cell": cell, "cell_mass": mass}
    if known is not None:
        columns |= {"shadow": path, "step": known.number[place], "event_mass": known.mass[place]}
    return Block(first, outcome, np.zeros(cell.size), columns, SamplingPlan("shells", shells=drawn.design))


@pytest.mark.parametrize("shadow_runs", [False, True])
def test_counted_tests_say_what_their_records_would(with_references, shadow_runs):
    """Whole campaigns: rounds, counts, limits and results, with failed tests and paths that the vehicle has walked."""
    drawn = replace(with_references[shadow_runs], failing=0.3, failing_tests=0.0 if shadow_runs else 0.02)
    design = drawn.design
    campaign, rng = campaign_of(2_000), np.random.default_rng(6)
    rounds = ShellRounds(campaign, design, drawn.available(campaign), RoundRule(campaign))
    by_row, level, n = SeenShells(design), Level.two_sided(0.9), 0
    for seen, _, enough in looks(campaign, drawn, np.random.default_rng(6)):
        (added,) = rounds.next_round(by_row)
        by_row.add(as_block(drawn, *drawn.tests_of(added, rng), n))
        assert rounds.rule.observe(by_row) == enough
        n += int(added.sum())
        numbers = ((*tally[:5], *(tally.runs or ())) for tally in (seen.tally, by_row.tally))
        for one, other in zip(*numbers, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12)
        limits = by_row.limits(level)
        assert seen.limits(level) == pytest.approx(limits, rel=1e-12)
    assert n == 2_000
    of_all = combined(design.p, by_row.tally, design.n_independent, level)
    assert limits == of_all  # not of an earlier look
    assert by_row.tally.totals[2] > 40
    found, expected = (as_tree(each.result(0.9)) for each in (seen, by_row))
    assert unlike(found, expected, digits=1e-12) == []


def as_tree(estimate: Estimate) -> dict[str, object]:
    """What it says, but for which tests refuted a statement: those have no numbers where they are counted alone."""
    found = asdict(estimate)
    del found["details"]["within"]["refuted_by"]
    for rows in ("references", "shells"):
        found["details"][rows] = dict(enumerate(found["details"][rows]))
    return found


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


# -- walked populations --


LADDER = load_library("ladder-2")
FEW = 60
VEHICLE = LADDER.n_drivers


def acting(controller: str, **parameters) -> Campaign:
    av = {
        "controller": controller,
        "parameters": parameters,
        "before_event": "controller",
        "limits": {"max_acceleration_mps2": 2.0},
    }
    content = {
        "name": "x",
        "environment": {"parameters": "ndd-overtaking-1"},
        "av": av,
        "world": {"engine": "twin"},
        "testing": {"method": "shells"},
    }
    stop = {"rhw": 0.5, "episodes": 20_000}
    return Campaign.model_validate({**content, "stop": stop, "pool": {"shadow_paths": 200}})


@pytest.fixture(scope="module")
def walk():
    paths = choose_paths(acting("examples.acting:Holds"), 5, PATHS, Progress(), 2048)

    def walked(of: Campaign, n_paths: int):
        columns = {name: getattr(paths, name)[:n_paths] for name in ("index", "start", "weight")}
        return walk_paths(of, replace(paths, **columns), Here(), Progress())

    return walked


@pytest.fixture(scope="module")
def speeds(walk):
    return walk(acting("examples.acting:Speeds"), PATHS)


@pytest.mark.parametrize("name", ["FreshNoise", "Breaks"])
def test_a_vehicle_without_a_known_truth_is_refused(walk, name):
    with pytest.raises(HarnessError, match="failed"):
        walk(acting(f"tests.controllers.early:{name}", **({"noise_mps2": 0.5} if name == "FreshNoise" else {})), 64)


def repeated(population, crashing, wrong=(0, 1.0), paths=200):
    division = Division(LADDER, population, [crashing], paths, limit_mps2=2.0, shadow_runs=True)
    source = division.of_vehicle(crashing)
    rows = ShellCampaign(acting("examples.acting:Speeds"), wrong_shell(source.draw, *wrong), 3).run(range(FEW))
    known = of_vehicle(population, crashing, reference_drivers(LADDER))
    subject = Subject("speeds", known[RATE], known)
    names = dict.fromkeys(row.result for row in rows)
    return source, {name: judge(subject, name, [row for row in rows if row.result == name], 0.9) for name in names}


def test_redrawn_pools_cover_and_wrong_ones_are_found(speeds):
    """A right interval fails with a probability of 1 % here, once and for all: with these seeds it does not."""
    crashing = speeds.mass * speeds.crashes(VEHICLE)
    source, right = repeated(speeds, crashing)
    (drawn,) = source.draw(np.random.default_rng(1))
    assert drawn.design.shadow_runs
    assert drawn.design.n_paths == len(drawn.mass) == 200
    for name in (FREE, ratio_to("r157-cc"), preventable_by("r157-cc")):
        assert right[name]["p_value"] > 0.01
        assert right[name]["refused"] <= 0.15  # 200 paths, of which 40 are to count
    heaviest = int(np.argmax(np.bincount(drawn.design.cell_stratum, drawn.crash_mass.sum(0))))
    _, wrong = repeated(speeds, crashing, (heaviest, 3.0))
    assert wrong[FREE]["p_value"] < 1e-6
    assert wrong[ratio_to("r157-cc")]["p_value"] < 1e-6


def test_crashes_on_few_paths_are_covered_or_refused(speeds):
    """All crashes on twelve of the paths: without the guard most intervals would be far too narrow."""
    crashing = speeds.mass * speeds.crashes(VEHICLE)
    weight = speeds.by_path(crashing)
    few = np.argsort(-weight)[:12]
    source, found = repeated(speeds, crashing * np.isin(speeds.path, few))
    assert found[FREE]["refused"] > 0.5
    assert found[FREE]["coverage"] >= 0.9
    assert source.crashing[0].sum() < 0.5 * weight.sum()
