"""SUMO and twin agree in every bit of every position, speed and command, in every lane and in every collision flag.

SUMO runs in a spawned process and is asked by its own getters; the twin runs here. The campaigns are real ones: the
recursive episode mixture for crashes, forced cut-ins for those that end well, the published method, and vehicles that
hardly brake, or react late, smoothly or not at all. Vanilla SUMO, which plans in every step, is a cell at a time. Where
the compiled shim is installed, it drives SUMO wherever it is not switched off.
"""

from __future__ import annotations

import numpy as np
import pytest

from harness.episode.loop import Shard
from harness.vocabulary import AV, BV, BV_LV_CONTACT, CRASH, LV, PASSED, STATE_DTYPE
from harness.worlds.twin import TwinWorld
from tests.episode.twin_runs import TWO
from tests.worlds.raw_getters import (
    Job,
    Recording,
    differences,
    motions_computed,
    record_in_another_process,
    run_episodes,
)

FORCED, NDE, STEP = (f"testing.method={name}" for name in ("forced", "nde", "step_mixture"))
AVS = {
    "late": "{model: idm, reaction: {delay_s: 0.6}}",
    "smooth": "{model: idm, reaction: {max_jerk_mps3: 5}}",
    "inattentive": "{model: idm, reaction: {inattention_probability: 0.5, inattention_delay_s: 1.5}}",
    "never_brakes": "{model: constant}",
    "accelerates": "{model: constant, parameters: {acceleration_mps2: 1.3}}",
    "all_at_once": "{model: fvdm, parameters: {min_acceleration_mps2: -6}, reaction: {delay_s: 0.3, max_jerk_mps3: 7.7,"
    " inattention_probability: 0.3, inattention_delay_s: 0.9}}",
    "careful_competent": "{model: r157-cc}",
    "fuzzy_safety": "{model: r157-fsm, parameters: {lateral_speed_mps: 1}, reaction: {inattention_probability: 0.5,"
    " inattention_delay_s: 0.9}}",
    "need_based": "{model: need-based, reaction: {max_jerk_mps3: 12}}",
}
LATERAL = "environment.parameters=ndd-overtaking-1-lateral"
OUTRUNS = "av={model: constant, parameters: {acceleration_mps2: 5}, reaction: {perceives_lateral_m: 0}}"
EPISODES = 150
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
PUBLISHED = (STEP, "testing.challenge=immediate", TWO, "av.parameters.min_acceleration_mps2=-1", "seed=7")
METHODS = {
    "mixture": Job((), 800, 64),
    "forced_without_shim": Job((FORCED,), 400, 64, shim=False),
    "forced_drawn_in_every_step": Job((FORCED, "environment.acceleration_hold_s=0.1", "seed=5"), 64, 64),
    "published": Job(PUBLISHED, 200, 32),
    "bv_into_lv": Job((NDE,), 16, 5, states=HOPELESS),
}
JOBS = {
    **METHODS,
    "vanilla": Job(("seed=3",), 250, 1, vanilla=True),
    "vanilla_bv_into_lv": Job((NDE,), 16, 1, vanilla=True, states=HOPELESS),
    # Fewer episodes than cells: the other cells stay parked, where nothing may be compared with where they are not.
    "five_in_64_cells": Job((FORCED,), 5, 64),
    "five_in_64_cells_without_shim": Job((FORCED,), 5, 64, shim=False),
    "late_under_step_mixture": Job((STEP, f"av={AVS['late']}"), 60, 16),
    **{name: Job((FORCED, f"av={av}"), EPISODES, 32) for name, av in AVS.items()},
    # Cut-ins that take time; before some that take long the AV has passed BV.
    "seen": Job((FORCED, LATERAL, "av={model: idm}"), 300, 32),
    "seen_by_a_reference": Job((FORCED, LATERAL, "av={model: r157-cc}"), 300, 32),
    "overtaken": Job((FORCED, "environment.cut_in_lead_s=4", OUTRUNS), 300, 32),
}


@pytest.fixture(scope="module")
def recordings() -> dict[str, Recording]:
    return record_in_another_process(JOBS)


@pytest.fixture(scope="module")
def twins() -> dict[str, Shard]:
    # Another number of cells than SUMO has: an episode must not know in which cell it runs, or beside whom.
    return {name: run_episodes(job, TwinWorld(48)) for name, job in JOBS.items()}


@pytest.mark.parametrize("name", JOBS)
def test_sumo_and_twin_agree_in_every_bit(name, recordings, twins):
    assert differences(recordings[name].motions, motions_computed(twins[name])) == {}
    assert np.array_equal(recordings[name].outcome, twins[name].results.episode["outcome"])


def test_the_episodes_compared_are_many_and_of_every_kind(twins):
    exact = np.concatenate([twins[name].results.episode for name in METHODS])
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
    speeds = [trace[..., 1] for name in ("mixture", "vanilla") for trace in twins[name].traces.values()]
    assert any(((v[1:] == 0.0) & (v[:-1] > 0.0)).any() for v in speeds), "somebody brakes to a standstill"
    assert any(((v[1:] > 0.0) & (v[:-1] == 0.0)).any() for v in speeds), "somebody drives off"


def test_among_cut_ins_that_take_time_are_side_contacts_and_vehicles_that_have_passed(twins):
    episode = twins["overtaken"].results.episode
    at_overlap = episode["n_steps"] == episode["cut_in_step"] + 1
    assert ((episode["outcome"] == PASSED) & at_overlap).sum() >= 5
    assert ((episode["outcome"] == CRASH) & at_overlap).sum() >= 5
    seen = twins["seen"].results.episode
    assert np.unique(seen["lead_steps"]).size >= 20


@pytest.mark.parametrize(("vehicle", "toward"), [(LV, 0.0), (BV, 0.0), (BV, 100.0), (AV, 100.0)])
def test_one_speed_command_off_by_one_unit_in_the_last_place_is_found(vehicle, toward, recordings):
    class PerturbedTwin(TwinWorld):
        steps = 0

        def step(self, speed, cut_in):
            self.steps += 1
            if self.steps == 10:
                speed[5, vehicle] = np.nextafter(speed[5, vehicle], toward)
            return super().step(speed, cut_in)

    perturbed = run_episodes(JOBS["mixture"], PerturbedTwin(48))
    found = differences(recordings["mixture"].motions, motions_computed(perturbed))
    assert list(found) == [5]
    assert "v" in found[5]


def test_a_crash_flagged_a_step_late_is_found(recordings, twins):
    motions = list(recordings["mixture"].motions)
    row = next(row for row, motion in enumerate(motions) if motion.contact.any())
    motions[row] = motions[row]._replace(contact=np.zeros_like(motions[row].contact))
    assert differences(motions, motions_computed(twins["mixture"])) == {row: {"contact"}}


def av_after_cut_in(shard: Shard, row: int) -> np.ndarray:
    """Commanded accelerations (steps,) of the AV from its cut-in step on."""
    return shard.traces[row][int(shard.results.episode["cut_in_step"][row]) : -1, AV, 2]


def test_the_drivers_compared_show_what_they_are_about(twins):
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


def test_another_delay_would_be_found(recordings):
    other = run_episodes(Job((FORCED, "av={model: idm, reaction: {delay_s: 0.5}}"), EPISODES, 32), TwinWorld(48))
    assert len(differences(recordings["late"].motions, motions_computed(other))) >= 100
