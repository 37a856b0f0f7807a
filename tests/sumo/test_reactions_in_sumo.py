"""Late, smooth, inattentive and indifferent drivers move in SUMO as in the twin, in every bit."""

from __future__ import annotations

import numpy as np
import pytest

from harness.episode.loop import Shard
from harness.outcomes import AV, CRASH
from harness.twin import TwinWorld
from tests.sumo.raw_getters import (
    Job,
    differences,
    motions_computed,
    motions_seen,
    record_in_another_process,
    run_episodes,
)

AVS = {
    "late": "{model: idm, reaction: {delay_s: 0.6}}",
    "smooth": "{model: idm, reaction: {max_jerk_mps3: 5}}",
    "inattentive": "{model: idm, reaction: {inattention_probability: 0.5, inattention_delay_s: 1.5}}",
    "never_brakes": "{model: constant}",
    "accelerates": "{model: constant, parameters: {acceleration_mps2: 1.3}}",
    "all_at_once": "{model: fvdm, parameters: {min_acceleration_mps2: -6}, reaction: {delay_s: 0.3, max_jerk_mps3: 7.7,"
    " inattention_probability: 0.3, inattention_delay_s: 0.9}}",
}
EPISODES = 150


def job(smoke, av: str, *more: str, n: int = EPISODES, cells: int = 32, shim: bool = True) -> Job:
    return Job(smoke("testing.method=forced", f"av={av}", *more), n, cells, shim=shim)


@pytest.fixture(scope="module")
def jobs(smoke) -> dict[str, Job]:
    every_av = {name: job(smoke, av) for name, av in AVS.items()}
    # Fewer episodes than cells: the other cells stay parked, where nothing may be compared with where they are not.
    first_shard = {
        "five_in_64_cells": job(smoke, "{model: idm}", n=5, cells=64),
        "five_in_64_cells_without_shim": job(smoke, "{model: idm}", n=5, cells=64, shim=False),
    }
    mixed = {"step_mixture": Job(smoke("testing.method=step_mixture", f"av={AVS['late']}"), 60, 16)}
    return {**every_av, **first_shard, **mixed}


@pytest.fixture(scope="module")
def recordings(jobs, tmp_path_factory) -> dict[str, dict[str, np.ndarray]]:
    return record_in_another_process(jobs, tmp_path_factory.mktemp("sumo"))


@pytest.fixture(scope="module")
def twins(jobs) -> dict[str, Shard]:
    # Another number of cells than SUMO has.
    return {name: run_episodes(job, TwinWorld(48)) for name, job in jobs.items()}


@pytest.mark.parametrize("name", [*AVS, "step_mixture", "five_in_64_cells", "five_in_64_cells_without_shim"])
def test_sumo_and_twin_agree_in_every_bit(name, recordings, twins):
    assert differences(motions_seen(recordings[name]), motions_computed(twins[name])) == {}
    assert np.array_equal(recordings[name]["outcome"], twins[name].results.episode["outcome"])


def av_after_cut_in(shard: Shard, row: int) -> np.ndarray:
    """Commanded accelerations (steps,) of the AV from its cut-in step on."""
    return shard.traces[row][int(shard.results.episode["cut_in_step"][row]) : -1, AV, 2]


def test_the_episodes_compared_show_what_they_are_about(twins):
    steps = {name: [av_after_cut_in(twins[name], row) for row in range(EPISODES)] for name in AVS}
    assert all((a[:7] == 0.0).all() for a in steps["late"])
    assert sum(a.size > 7 and a[7] != 0.0 for a in steps["late"]) >= 100
    assert max(np.abs(np.diff(a, prepend=0.0)).max() for a in steps["smooth"]) == pytest.approx(0.5)
    assert min(a.min() for a in steps["smooth"]) == -4.0
    long = [a for a in steps["inattentive"] if a.size > 16]
    slow = np.array([(a[:16] == 0.0).all() and a[16] != 0.0 for a in long])
    fast = np.array([a[1] != 0.0 for a in long])
    assert len(long) >= 120
    assert 0.25 <= slow.mean() <= 0.75  # probability 0.5: outside with probability below 1e-7
    assert (slow ^ fast).all()
    assert all((a == 0.0).all() for a in steps["never_brakes"])
    assert all((a[1:] == 1.3).all() for a in steps["accelerates"])
    crashes = {name: int((twins[name].results.episode["outcome"] == CRASH).sum()) for name in AVS}
    assert crashes["accelerates"] > crashes["never_brakes"] > crashes["late"]


def test_another_delay_would_be_found(smoke, recordings):
    other = run_episodes(job(smoke, "{model: idm, reaction: {delay_s: 0.5}}"), TwinWorld(48))
    assert len(differences(motions_seen(recordings["late"]), motions_computed(other))) >= 100
