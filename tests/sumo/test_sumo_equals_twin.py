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
    "careful_competent": "{model: r157-cc}",
    "fuzzy_safety": "{model: r157-fsm, parameters: {lateral_speed_mps: 1}, reaction: {inattention_probability: 0.5,"
    " inattention_delay_s: 0.9}}",
    "need_based": "{model: need-based, reaction: {max_jerk_mps3: 12}}",
}
LATERAL = {
    "seen": ("environment.parameters=ndd-overtaking-1-lateral", "av={model: idm}"),
    "seen_by_a_reference": ("environment.parameters=ndd-overtaking-1-lateral", "av={model: r157-cc}"),
    "overtaken": (
        "environment.cut_in_lead_s=4",
        "av={model: constant, parameters: {acceleration_mps2: 5}, reaction: {perceives_lateral_m: 0}}",
    ),
}
"""Cut-ins that take time; before some that take long the AV has passed BV."""
MIXTURE = "mixture"
EPISODES = 150
"""Of each driver."""
PAIRS = [(0.5, -12.0), (1.0, -15.0), (0.2, -8.0), (3.0, -20.0)]
"""R1 (m) and R1dot (m/s) of starts from which no braking of BV can avoid LV."""


def hopeless_starts() -> np.ndarray:
    """Initial states (16,) from which BV runs into LV before AV is past."""
    rows = [(v, r1, r1dot, 60.0, -5.0) for v in (22.0, 28.0, 33.0, 37.5) for r1, r1dot in PAIRS]
    return np.array(rows, STATE_DTYPE)


METHODS = (MIXTURE, "forced_without_shim", "forced_drawn_in_every_step", "published", "bv_into_lv")
VANILLA = ("vanilla", "vanilla_bv_into_lv")
SMALL = ("five_in_64_cells", "five_in_64_cells_without_shim", "late_under_step_mixture")


@pytest.fixture(scope="module")
def jobs(smoke) -> dict[str, Job]:
    forced, weak = "testing.method=forced", "av.parameters.min_acceleration_mps2=-1"
    published = ("testing.method=step_mixture", "testing.challenge=immediate", TWO)
    draw_often = "environment.acceleration_hold_s=0.1"
    late = smoke("testing.method=step_mixture", f"av={AVS['late']}")
    of_methods = (
        Job(smoke(), 800, 64),
        Job(smoke(forced), 400, 64, shim=False),
        Job(smoke(forced, draw_often, "seed=5"), 64, 64),
        Job(smoke(*published, weak, "seed=7"), 200, 32),
        Job(smoke("testing.method=nde"), 16, 5, states=hopeless_starts()),
        Job(smoke("seed=3"), 250, 1, vanilla=True),
        Job(smoke("testing.method=nde"), 16, 1, vanilla=True, states=hopeless_starts()),
    )
    # Fewer episodes than cells: the other cells stay parked, where nothing may be compared with where they are not.
    small = (Job(smoke(forced), 5, 64), Job(smoke(forced), 5, 64, shim=False), Job(late, 60, 16))
    of_avs = {name: Job(smoke(forced, f"av={av}"), EPISODES, 32) for name, av in AVS.items()}
    of_avs |= {name: Job(smoke(forced, *of), 2 * EPISODES, 32) for name, of in LATERAL.items()}
    return {**dict(zip((*METHODS, *VANILLA, *SMALL), (*of_methods, *small), strict=True)), **of_avs}


@pytest.fixture(scope="module")
def recordings(jobs, tmp_path_factory) -> dict[str, dict[str, np.ndarray]]:
    return record_in_another_process(jobs, tmp_path_factory.mktemp("sumo"))


@pytest.fixture(scope="module")
def twins(jobs) -> dict[str, Shard]:
    # Another number of cells than SUMO has: an episode must not know in which cell it runs, or beside whom.
    return {name: run_episodes(job, TwinWorld(48)) for name, job in jobs.items()}


@pytest.mark.parametrize("name", [*METHODS, *VANILLA, *SMALL, *AVS, *LATERAL])
def test_sumo_and_twin_agree_in_every_bit(name, recordings, twins):
    assert differences(motions_seen(recordings[name]), motions_computed(twins[name])) == {}
    assert np.array_equal(recordings[name]["outcome"], twins[name].results.episode["outcome"])


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


def test_a_crash_flagged_a_step_late_is_found(recordings, twins):
    recording = {name: values.copy() for name, values in recordings[MIXTURE].items()}
    time, cell = np.argwhere(recording["contact"])[0]
    recording["contact"][time, cell] = False
    assert len(differences(motions_seen(recording), motions_computed(twins[MIXTURE]))) == 1


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


def test_another_delay_would_be_found(smoke, recordings):
    campaign = smoke("testing.method=forced", "av={model: idm, reaction: {delay_s: 0.5}}")
    other = run_episodes(Job(campaign, EPISODES, 32), TwinWorld(48))
    assert len(differences(motions_seen(recordings["late"]), motions_computed(other))) >= 100
