"""SUMO and twin agree in every bit of every position, speed and command, in every lane and in every collision flag.

SUMO runs in a spawned process and is asked by its own getters; the twin runs here. The campaigns are real ones: the
recursive episode mixture for crashes, forced cut-ins for those that end well, the published method, and a vehicle that
hardly brakes. Vanilla SUMO, which plans in every step, is a cell at a time. Where the compiled shim is installed, it
drives SUMO in all but one of them.
"""

from __future__ import annotations

import numpy as np
import pytest

from harness.episode.loop import Shard
from harness.outcomes import AV, BV, BV_LV_CONTACT, CRASH, LV
from harness.state import STATE_DTYPE
from harness.twin import TwinWorld
from tests.episode.twin_runs import TWO
from tests.sumo.raw_getters import (
    Job,
    Motion,
    differences,
    motion_of,
    motions_computed,
    motions_seen,
    record_in_another_process,
    run_episodes,
)

MIXTURE = "mixture"
PAIRS = [(0.5, -12.0), (1.0, -15.0), (0.2, -8.0), (3.0, -20.0)]
"""R1 (m) and R1dot (m/s) of starts from which no braking of BV can avoid LV."""


def hopeless_starts() -> np.ndarray:
    """Initial states (16,) from which BV runs into LV before AV is past."""
    rows = [(v, r1, r1dot, 60.0, -5.0) for v in (22.0, 28.0, 33.0, 37.5) for r1, r1dot in PAIRS]
    return np.array(rows, STATE_DTYPE)


@pytest.fixture(scope="module")
def jobs(smoke) -> dict[str, Job]:
    forced, weak = "testing.method=forced", "av.parameters.min_acceleration_mps2=-1"
    published = ("testing.method=step_mixture", "testing.challenge=immediate", TWO)
    draw_often = "environment.acceleration_hold_s=0.1"
    return {
        MIXTURE: Job(smoke(), 800, 64),
        "forced_without_shim": Job(smoke(forced), 400, 64, shim=False),
        "forced_drawn_in_every_step": Job(smoke(forced, draw_often, "seed=5"), 64, 64),
        "published": Job(smoke(*published, weak, "seed=7"), 200, 32),
        "bv_into_lv": Job(smoke("testing.method=nde"), 16, 5, states=hopeless_starts()),
        "vanilla": Job(smoke("seed=3"), 250, 1, vanilla=True),
        "vanilla_bv_into_lv": Job(smoke("testing.method=nde"), 16, 1, vanilla=True, states=hopeless_starts()),
    }


@pytest.fixture(scope="module")
def recordings(jobs, tmp_path_factory) -> dict[str, dict[str, np.ndarray]]:
    return record_in_another_process(jobs, tmp_path_factory.mktemp("sumo"))


@pytest.fixture(scope="module")
def twins(jobs) -> dict[str, Shard]:
    # Another number of cells than SUMO has: an episode must not know in which cell it runs, or beside whom.
    return {name: run_episodes(job, TwinWorld(48)) for name, job in jobs.items()}


@pytest.mark.parametrize(
    "name",
    [
        MIXTURE,
        "forced_without_shim",
        "forced_drawn_in_every_step",
        "published",
        "bv_into_lv",
        "vanilla",
        "vanilla_bv_into_lv",
    ],
)
def test_sumo_and_twin_agree_in_every_bit(name, recordings, twins):
    assert differences(motions_seen(recordings[name]), motions_computed(twins[name])) == {}
    assert np.array_equal(recordings[name]["outcome"], twins[name].results.episode["outcome"])


def test_the_episodes_compared_are_many_and_of_every_kind(jobs, twins):
    exact = np.concatenate([twins[name].results.episode for name, job in jobs.items() if not job.vanilla])
    crashed, cut_in = exact["outcome"] == CRASH, exact["cut_in_step"] >= 0
    assert exact.size >= 1_000
    assert crashed.sum() >= 200
    assert (cut_in & ~crashed).sum() >= 200
    assert (~cut_in).sum() >= 10
    assert (exact["outcome"] == BV_LV_CONTACT).sum() >= 10
    vanilla = twins["vanilla"].results.episode
    assert vanilla.size >= 200
    assert (vanilla["outcome"] == CRASH).sum() >= 50
    assert ((vanilla["cut_in_step"] >= 0) & (vanilla["outcome"] != CRASH)).sum() >= 50


def test_vehicles_that_brake_to_a_standstill_and_drive_off_are_among_them(twins):
    speeds = [trace[..., 1] for name in ("mixture", "vanilla") for trace in twins[name].traces.values()]
    assert sum(int(((v[1:] == 0.0) & (v[:-1] > 0.0)).sum()) for v in speeds) >= 1
    assert sum(int(((v[1:] > 0.0) & (v[:-1] == 0.0)).sum()) for v in speeds) >= 1


@pytest.mark.parametrize(("vehicle", "toward"), [(LV, 0.0), (BV, 0.0), (BV, 100.0), (AV, 100.0)])
def test_one_speed_command_off_by_one_unit_in_the_last_place_is_found(vehicle, toward, jobs, recordings):
    class PerturbedTwin(TwinWorld):
        steps = 0

        def step(self, speed, cut_in):
            self.steps += 1
            if self.steps == 10:
                speed[5, vehicle] = np.nextafter(speed[5, vehicle], toward)
            return super().step(speed, cut_in)

    perturbed = run_episodes(jobs[MIXTURE], PerturbedTwin(48))
    found = differences(motions_seen(recordings[MIXTURE]), motions_computed(perturbed))
    assert list(found) == [5]
    assert "v" in found[5]


def recomputed(motion: Motion, acceleration: np.ndarray | None = None) -> Motion:
    return motion_of(
        motion.x[0], motion.v[0], motion.lane, motion.acceleration if acceleration is None else acceleration
    )


def test_commanded_accelerations_and_two_formulas_give_sumos_motion_and_collisions(recordings):
    seen = motions_seen(recordings[MIXTURE])
    assert differences(seen, [recomputed(motion) for motion in seen]) == {}


@pytest.mark.parametrize("vehicle", [LV, BV, AV])
def test_one_acceleration_off_by_one_unit_in_the_last_place_is_found(vehicle, recordings):
    seen = motions_seen(recordings[MIXTURE])[:20]
    wrong = [motion.acceleration.copy() for motion in seen]
    wrong[5][10, vehicle] = np.nextafter(wrong[5][10, vehicle], -100.0)
    computed = [recomputed(motion, acceleration) for motion, acceleration in zip(seen, wrong, strict=True)]
    found = differences(seen, computed)
    assert list(found) == [5]
    assert "acceleration" in found[5]


def test_it_changes_the_speed_of_a_vehicle_that_starts_from_standstill(recordings):
    """At 30 m/s the last place of an acceleration is too small to show in a speed; at a standstill it is not."""
    seen = motions_seen(recordings[MIXTURE])
    starting = [
        (episode, *place)
        for episode, motion in enumerate(seen)
        for place in np.argwhere((motion.v[:-1] == 0.0) & (motion.acceleration > 0.0))
    ]
    episode, step, vehicle = starting[0]
    acceleration = seen[episode].acceleration.copy()
    acceleration[step, vehicle] = np.nextafter(acceleration[step, vehicle], 100.0)
    found = differences([seen[episode]], [recomputed(seen[episode], acceleration)])
    assert found[0] >= {"acceleration", "v"}


def test_a_crash_flagged_a_step_late_is_found(recordings, twins):
    recording = {name: values.copy() for name, values in recordings[MIXTURE].items()}
    time, cell = np.argwhere(recording["contact"])[0]
    recording["contact"][time, cell] = False
    assert len(differences(motions_seen(recording), motions_computed(twins[MIXTURE]))) == 1
