"""SUMO and twin agree in every bit of every position, speed and command, in every lane and in every collision flag.

SUMO runs in a spawned process and is asked by its own getters; the twin runs here. The campaigns are real ones: the
recursive episode mixture for crashes, forced cut-ins for those that end well, the step mixture, and vehicles that
hardly brake, or react late, smoothly or not at all. Vanilla SUMO, which plans in every step, is a cell at a time. Where
the compiled shim is installed, it drives SUMO wherever it is not switched off.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from typing import NamedTuple

import libsumo
import numpy as np
import pytest

from harness.campaign.yaml_text import yaml_text
from harness.families.cut_in.nade.in_loop import DrawnInLoop, InLoop
from harness.families.cut_in.vocabulary import STATE_DTYPE
from harness.loop.loop import Shard
from harness.progress import Progress
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vehicles.kinematics import STEP_S, next_position
from harness.vocabulary import AV, BV, CONTACT, CRASH, LV, PASSED, VEHICLES
from harness.worlds.twin import TwinWorld
from tests.golden.campaigns import LATERAL
from tests.traffic.tables import tabled
from tests.worlds.running import smoke


class Job(NamedTuple):
    """Episodes of a campaign to run in SUMO and to record; ``states`` (n,) if not the campaign's own."""

    overrides: Sequence[str]
    n_episodes: int
    n_cells: int
    vanilla: bool = False
    shim: bool = True
    states: np.ndarray | None = None


class Motion(NamedTuple):
    """An episode as SUMO's getters or a world's traces show it.

    ``x``, ``v``, ``lane`` (steps + 1, 3) of LV, BV, AV; ``contact`` (steps + 1,): whether a collision was flagged.
    """

    x: np.ndarray
    v: np.ndarray
    lane: np.ndarray
    contact: np.ndarray


def planning(world: type) -> type:
    """A kind of world whose vehicles SUMO lets plan in every step (action step 0.1 s): a reference."""

    class Vanilla(world):
        _type = _av_type = "vanilla"

        def _plan_every(self, *_): ...

    return Vanilla


def record(job: Job) -> tuple[list[Motion], np.ndarray]:
    """Episodes in index order, with their outcomes (n,).

    Written down by libsumo's getters alone, beside the world under test and after it has done its work, so that nothing
    the world remembers, caches or expects can leak into it. Episodes are found again from the order in which cells were
    filled: a shard's episodes are given to the placed cells one after another.
    """
    import libsumo

    from harness.worlds.sumo import SumoWorld

    names = [f"{vehicle}{k}" for k in range(job.n_cells) for vehicle in VEHICLES]
    getters = (libsumo.vehicle.getLanePosition, libsumo.vehicle.getSpeed, libsumo.vehicle.getLaneIndex)
    seen: list[tuple[np.ndarray, ...]] = []
    filled: list[np.ndarray] = []

    def read(placed: np.ndarray) -> None:
        # A cell that is being filled again has not moved yet: what still collides belongs to the episode before.
        collisions = () if placed.any() else libsumo.simulation.getCollisions()
        colliding = {name for collision in collisions for name in (collision.collider, collision.victim)}
        contact = np.array([name in colliding for name in names]).reshape(-1, 3).any(axis=1)
        seen.append((*(np.array([getter(name) for name in names]).reshape(-1, 3) for getter in getters), contact))
        filled.append(placed)

    class RecordedWorld(SumoWorld):
        def place(self, cells, x, v, lane):
            super().place(cells, x, v, lane)
            read(np.isin(np.arange(job.n_cells), cells))

        def step(self, speed, lane):
            contact = super().step(speed, lane)
            read(np.zeros(job.n_cells, bool))
            return contact

    of = planning(RecordedWorld) if job.vanilla else RecordedWorld
    with closing(of(job.n_cells, shim=job.shim)) as world:
        shard = run_episodes(job, world)
    quantities, placed = [np.stack(values) for values in zip(*seen, strict=True)], np.stack(filled)
    steps = np.flatnonzero(~placed.any(axis=1))
    motions = []
    for (time, cell), n in zip(np.argwhere(placed), shard.episode["n_steps"], strict=True):
        times = np.append(time, steps[steps > time][:n])
        motions.append(Motion(*(values[times, cell] for values in quantities)))
    return motions, shard.episode["outcome"]


def run_episodes(job: Job, world) -> Shard:
    """Run the job's episodes in any world, all of them traced."""
    prepared = prepare(resolve(smoke(*job.overrides)))
    tests = prepared.tests(0, job.n_episodes)
    if job.states is not None:
        nde = InLoop(prepared.resolved, Progress())
        tests = DrawnInLoop(job.states, prepared.resolved.environment, nde.importance)
    return prepared.loop(world, traces="all").run(0, tests)


def motions_computed(shard: Shard) -> list[Motion]:
    """Episodes of a shard that was run without SUMO, in index order; contact by the formula's verdict."""
    motions = []
    for row, result in enumerate(shard.episode):
        x, v, _, lane = np.moveaxis(shard.traces[row], 2, 0)
        ended_by_contact = result["outcome"] in (CRASH, CONTACT)
        contact = ended_by_contact & (np.arange(len(x)) == result["n_steps"])
        motions.append(Motion(x, v, lane.astype(int), contact))
    return motions


def differences(seen: list[Motion], computed: list[Motion]) -> dict[int, set[str]]:
    """Episode → quantities in which two runs of it differ in any bit: 0.0 and -0.0 differ, NaN equals itself."""
    found = {}
    for episode, pair in enumerate(zip(seen, computed, strict=True)):
        if wrong := {
            name
            for name, a, b in zip(Motion._fields, *pair, strict=True)
            if (a.shape, a.dtype, a.tobytes()) != (b.shape, b.dtype, b.tobytes())
        }:
            found[episode] = wrong
    return found


FORCED, NDE, STEP = (f"testing.method={name}" for name in ("forced", "nde", "step_mixture"))
AVS = {
    "late": "{model: idm, reaction: {delay_s: 0.6}}",
    "accelerates": "{model: constant, parameters: {acceleration_mps2: 1.3}}",
    "all_at_once": "{model: fvdm, parameters: {min_acceleration_mps2: -6}, reaction: {delay_s: 0.3, max_jerk_mps3: 7.7,"
    " inattention_probability: 0.3, inattention_delay_s: 0.9}}",
    "careful_competent": "{model: r157-cc}",
    "fuzzy_safety": "{model: r157-fsm, parameters: {lateral_speed_mps: 1}, reaction: {inattention_probability: 0.5,"
    " inattention_delay_s: 0.9}}",
}
OUTRUNS = (
    "av={model: constant, parameters: {acceleration_mps2: 5}, reaction: {perceives_lateral_m: 0}, takes_over: onset}"
)
EPISODES = 100
"""Of each driver."""
HOPELESS = np.array(
    [
        (v, r1, r1dot, 60.0, -5.0)
        for v in (22.0, 28.0, 33.0, 37.5)
        for r1, r1dot in [(0.5, -12.0), (1.0, -15.0), (0.2, -8.0), (3.0, -20.0)]
    ],
    STATE_DTYPE,
)
"""Starts from which no braking of BV can avoid LV, which it runs into before AV is past."""
METHODS = {
    "mixture": Job((), 600, 64),
    "forced_without_shim": Job((FORCED,), 250, 64, shim=False),
    "forced_drawn_in_every_step": Job((FORCED, "environment.acceleration_hold_s=0.1", "seed=5"), 64, 64),
    "step": Job((STEP, "av.parameters.min_acceleration_mps2=-1", "seed=7"), 200, 32),
    "bv_into_lv": Job((NDE,), 16, 5, states=HOPELESS),
}
JOBS = {
    **METHODS,
    "vanilla": Job(("seed=3",), 150, 1, vanilla=True),
    "vanilla_bv_into_lv": Job((NDE,), 16, 1, vanilla=True, states=HOPELESS),
    **{name: Job((FORCED, f"av={av}"), EPISODES, 32) for name, av in AVS.items()},
    # Cut-ins that take time; before some that take long the AV has passed BV.
    "seen": Job((FORCED, LATERAL, "av={model: idm}"), 200, 32),
    "seen_by_a_reference": Job((FORCED, LATERAL, "av={model: r157-cc}"), 200, 32),
    "overtaken": Job((FORCED, "environment.cut_in_lead_s=4", OUTRUNS), 300, 32),
}


@pytest.fixture(scope="module")
def jobs(tmp_path_factory) -> dict[str, Job]:
    file = tmp_path_factory.mktemp("traffic") / "tabled.yaml"
    file.write_text(yaml_text(tabled()))
    return {**JOBS, "tables_of_traffic": Job((FORCED, f"environment.parameters={file}"), EPISODES, 32)}


@pytest.fixture(scope="module")
def recordings(jobs) -> dict[str, tuple[list[Motion], np.ndarray]]:
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return dict(zip(jobs, process.map(record, jobs.values()), strict=True))


@pytest.fixture(scope="module")
def twins(jobs) -> dict[str, Shard]:
    # Another number of cells than SUMO has: an episode must not know in which cell it runs, or beside whom.
    return {name: run_episodes(job, TwinWorld(48)) for name, job in jobs.items()}


@pytest.mark.parametrize("name", [*JOBS, "tables_of_traffic"])
def test_sumo_and_twin_agree_in_every_bit(name, recordings, twins):
    motions, outcome = recordings[name]
    assert differences(motions, motions_computed(twins[name])) == {}
    assert np.array_equal(outcome, twins[name].episode["outcome"])


def test_the_episodes_compared_are_many_and_of_every_kind(twins):
    exact = np.concatenate([twins[name].episode for name in METHODS])
    crashed, cut_in = exact["outcome"] == CRASH, exact["event_step"] >= 0
    assert exact.size >= 1_000
    assert crashed.sum() >= 200
    assert (cut_in & ~crashed).sum() >= 200
    assert (~cut_in).sum() >= 10
    assert (exact["outcome"] == CONTACT).sum() >= 10
    vanilla = twins["vanilla"].episode
    assert (vanilla["outcome"] == CRASH).sum() >= 30
    assert ((vanilla["event_step"] >= 0) & (vanilla["outcome"] != CRASH)).sum() >= 30
    speeds = [trace[..., 1] for name in ("mixture", "vanilla") for trace in twins[name].traces.values()]
    assert any(((v[1:] == 0.0) & (v[:-1] > 0.0)).any() for v in speeds), "somebody brakes to a standstill"
    assert any(((v[1:] > 0.0) & (v[:-1] == 0.0)).any() for v in speeds), "somebody drives off"


def test_among_cut_ins_that_take_time_are_side_contacts_and_vehicles_that_have_passed(twins):
    episode = twins["overtaken"].episode
    at_overlap = episode["n_steps"] == episode["event_step"] + 1
    assert ((episode["outcome"] == PASSED) & at_overlap).sum() >= 5
    assert ((episode["outcome"] == CRASH) & at_overlap).sum() >= 5
    seen = twins["seen"].episode
    assert np.unique(seen["lead_steps"]).size >= 20


@pytest.mark.parametrize(("vehicle", "toward"), [(BV, 0.0), (AV, 100.0)])
def test_one_speed_command_off_by_one_unit_in_the_last_place_is_found(vehicle, toward, recordings):
    class PerturbedTwin(TwinWorld):
        steps = 0

        def step(self, speed, lane):
            self.steps += 1
            if self.steps == 10:
                speed[5, vehicle] = np.nextafter(speed[5, vehicle], toward)
            return super().step(speed, lane)

    perturbed = run_episodes(JOBS["mixture"], PerturbedTwin(48))
    found = differences(recordings["mixture"][0], motions_computed(perturbed))
    assert list(found) == [5]
    assert "v" in found[5]


# -- one step of SUMO, for any two speeds, is next_position to the last bit: standstill included --


CELLS, ROUNDS, SEED = 64, 40, 20_261_121


def log_uniform(random: np.random.Generator, low: float, high: float, shape: int | tuple[int, int]) -> np.ndarray:
    return np.exp(random.uniform(np.log(low), np.log(high), shape))


def random_positions(random: np.random.Generator) -> np.ndarray:
    """Positions (CELLS, 3) at which nobody touches anybody; near the road's start floats are fine enough to differ."""
    x = np.empty((CELLS, 3))
    x[:, AV] = log_uniform(random, 0.1, 3000.0, CELLS)
    x[:, BV] = log_uniform(random, 0.1, 2000.0, CELLS)
    x[:, LV] = x[:, BV] + random.uniform(100.0, 1500.0, CELLS)
    return x


def driven(random: np.random.Generator, before: np.ndarray) -> np.ndarray:
    return np.maximum(before + random.integers(-100, 51, before.shape) / 5.0 * STEP_S, 0.0)


SHAPE = CELLS, 3
SPEEDS = {
    "any change": lambda random: (random.uniform(0.0, 45.0, SHAPE), random.uniform(0.0, 45.0, SHAPE)),
    "driving": lambda random: (before := random.uniform(0.0, 45.0, SHAPE), driven(random, before)),
    "braking to a stop": lambda random: (random.uniform(0.0, 2.0, SHAPE), np.zeros(SHAPE)),
    "stopping from any speed": lambda random: (log_uniform(random, 1e-12, 45.0, SHAPE), np.zeros(SHAPE)),
    "driving off": lambda random: (np.zeros(SHAPE), random.uniform(0.0, 2.0, SHAPE)),
}
"""Speeds before and after a step."""


@pytest.mark.parametrize("vanilla", [False, True])
@pytest.mark.parametrize("speeds", SPEEDS)
def test_a_step_of_sumo_is_the_formula_in_every_bit(speeds, vanilla, open_world):
    from harness.worlds.sumo import SumoWorld

    random = np.random.default_rng(SEED)
    world = open_world(CELLS, of=planning(SumoWorld) if vanilla else SumoWorld)
    everywhere, lanes = np.arange(CELLS), np.tile(np.array([1, 1, 0], np.int8), (CELLS, 1))
    for _ in range(ROUNDS):
        x, (before, after) = random_positions(random), SPEEDS[speeds](random)
        world.place(everywhere, x, before, lanes)
        world.step(after, lanes)
        for k in range(CELLS):
            for vehicle, name in enumerate(VEHICLES):
                expected = next_position(x[k, vehicle], before[k, vehicle], after[k, vehicle])
                assert libsumo.vehicle.getLanePosition(f"{name}{k}").hex() == expected.hex()
                assert libsumo.vehicle.getSpeed(f"{name}{k}").hex() == float(after[k, vehicle]).hex()


def test_these_samples_tell_sumos_formula_from_the_textbooks():
    random = np.random.default_rng(SEED)
    x = np.concatenate([random_positions(random)[:, BV] for _ in range(ROUNDS)])
    speed = random.uniform(0.0, 2.0, x.size)
    textbook = x + 0.5 * (speed + 0.0) * STEP_S
    exact = np.array([next_position(*pair, 0.0) for pair in zip(x, speed, strict=True)])
    assert (textbook != exact).sum() >= 5
    np.testing.assert_allclose(textbook, exact, rtol=1e-14)
