"""Vehicles that SUMO, a program or an FMU drives from the start: baseline runs, and tests that find the same motion."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from harness.campaign.files import load_campaign
from harness.resolved import resolve
from harness.sampling import prepare
from harness.sampling.baseline import as_recorded, baseline_requests, run_baseline
from harness.worlds import build_world
from harness.worlds.sumo_driven import FreshWorld, SumoAvWorld
from tests.controllers.driving import fmu_av
from tests.pool.conftest import MIXTURE_FILE, SMALL_POOL
from tests.worlds.running import EXAMPLE, program

SHOWN = 60
EARLY = ", before_cut_in: controller}"


def acting(av: str, engine: str):
    changes = [f"av={av}", "testing.method=shells", f"world.engine={engine}", "world.cells=8", *SMALL_POOL]
    return load_campaign(MIXTURE_FILE, [*changes, "pool.shadow_paths=120"])


def driven(av: str, engine: str = "sumo"):
    campaign = acting(av, engine)
    return driven_in(build_world(campaign), campaign)


def driven_in(world, campaign):
    """Causes of failure of the baseline runs, what tests on their paths left, and the motion of the former."""
    ready = prepare(resolve(campaign))
    loop, environment = ready.loop(world), ready.policy.environment
    try:
        specs = list(baseline_requests(len(ready.baseline_paths)))
        done = [run_baseline(loop, ready.baseline_paths, environment, spec) for spec in specs]
        runs = as_recorded(pa.concat_tables(part.table for part in done), environment)
        ready.begin_after(runs)
        rows = np.linspace(0, ready.prescribed.available.sum() - 1, SHOWN).astype(np.int64)
        shard = loop.run(1000, *ready.prescribed.of_rows(rows, np.zeros(SHOWN, np.int64)))
    finally:
        loop.close()
        world.close()
    return sum((part.failures for part in done), start=done[0].failures), shard, runs


FORMS = {
    "SUMO's ACC": "{sumo: {carFollowModel: ACC}",
    "SUMO's Krauss with seeded noise": "{sumo: {carFollowModel: Krauss, sigma: 0.5}",
    "TraCI style": "{controller: 'tests.controllers.early:SpeedsTraci'",
    "a program": f"{{traci: {{command: {program(EXAMPLE).traci.command!r}}}",
}


@pytest.mark.parametrize("av", [av + EARLY for av in FORMS.values()], ids=FORMS)
def test_it_does_in_tests_what_it_did_in_its_baseline_runs(av):
    failures, shard, runs = driven(av)
    assert not failures
    assert shard.failures == {}
    moved = np.abs(runs.v_mps[np.arange(120), runs.n_steps] - runs.v_mps[:, 0]) > 0.1
    assert moved.mean() > 0.2 or "idm_client" in av, "it never acted"  # but the client holds its speed, too
    assert np.all(shard.results.episode["cut_in_step"] >= 0)


def test_models_that_are_recycled_otherwise_remember_the_last_cut_in():
    """Why they get a simulation per episode when they act from the start: in one, tests are not the same again."""
    campaign = acting("{sumo: {carFollowModel: Krauss}" + EARLY, "sumo")
    world = build_world(campaign)
    assert isinstance(world, FreshWorld)
    world.close()
    _, shard, _ = driven_in(SumoAvWorld(8, campaign.av.sumo, acts_before_cut_in=True), campaign)
    assert len(shard.failures) > 5


def test_an_fmu_in_both_worlds(fmu):
    av = fmu_av(fmu, EARLY[:-1])
    failures, shard, runs = driven(av)
    other, in_twin, runs_in_twin = driven(av, "twin")
    assert not failures
    assert not other
    assert shard.failures == in_twin.failures == {}
    assert runs.digest() == runs_in_twin.digest()
    assert shard.results.episode.tobytes() == in_twin.results.episode.tobytes()
