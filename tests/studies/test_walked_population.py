"""Vehicles that act before the cut-in, walked once and repeated: exact where they equal a driver; faults are found."""

from dataclasses import replace

import numpy as np
import pytest

from harness.campaign.campaign import Campaign
from harness.errors import HarnessError
from harness.progress import Progress
from harness.vehicles.library import load_library
from studies.replication.judgement import Subject, judge
from studies.replication.populations import (
    RATE,
    choose_paths,
    of_vehicle,
    preventable_by,
    ratio_to,
    reference_drivers,
    walk_paths,
)
from studies.replication.shells import FREE, Division, ShellCampaign
from tests.studies.here import Here, wrong_shell

pytestmark = pytest.mark.slow

LIBRARY = load_library("ladder-2")
PATHS = 1024
FEW = 60
VEHICLE = LIBRARY.n_drivers


def campaign(controller: str, **parameters) -> Campaign:
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
    paths = choose_paths(campaign("examples.acting:Holds"), 5, PATHS, Progress(), 2048)

    def walked(of: Campaign, n_paths: int):
        columns = {name: getattr(paths, name)[:n_paths] for name in ("index", "start", "weight")}
        return walk_paths(of, replace(paths, **columns), Here(), Progress())

    return walked


@pytest.fixture(scope="module")
def speeds(walk):
    return walk(campaign("examples.acting:Speeds"), PATHS)


@pytest.mark.parametrize("name", ["FreshNoise", "Breaks"])
def test_a_vehicle_without_a_known_truth_is_refused(walk, name):
    with pytest.raises(HarnessError, match="failed"):
        walk(campaign(f"tests.controllers.early:{name}", **({"noise_mps2": 0.5} if name == "FreshNoise" else {})), 64)


def repeated(population, crashing, wrong=(0, 1.0), paths=200):
    division = Division(LIBRARY, population, [crashing], paths, limit_mps2=2.0, shadow_runs=True)
    source = division.of_vehicle(crashing)
    rows = ShellCampaign(campaign("examples.acting:Speeds"), wrong_shell(source.draw, *wrong), 3).run(range(FEW))
    known = of_vehicle(population, crashing, reference_drivers(LIBRARY))
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
