"""Prescribed traffic in both worlds: cut-ins close to LV and to the AV, and fewer episodes than cells."""

from __future__ import annotations

import numpy as np
import pytest

from harness.compiled import unboxed
from harness.families.cut_in.loading import load_environment
from harness.families.cut_in.path import empty_trajectory
from harness.loop.loop import EpisodeLoop, RecordPolicy, Shard
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.vehicles.drivers import Followers
from harness.vehicles.library import load_library
from harness.vocabulary import CONTACT, CRASH, STATE_DTYPE, TIMEOUT
from harness.worlds.twin import TwinWorld
from studies.alarm import replay_surrogates, stored_paths
from tests.episode.test_lateral import BESIDE, at_once, beside
from tests.retracing import retraced
from tests.worlds.running import smoke

STATES = np.array(
    [
        (21.0, 0.3, -4.0, 30.0, -8.0),  # BV is over LV's rear when it has left the lane
        (21.0, 3.0, -4.0, 30.0, -8.0),  # in good time
        (21.0, 30.0, 0.0, 0.5, -8.0),  # in front of the AV's bumper
        (21.0, 0.3, -4.0, 0.5, -8.0),  # both at once
    ],
    STATE_DTYPE,
)
OUTCOMES = [CONTACT, TIMEOUT, CRASH, CONTACT]


def loop_in(world, model: str) -> EpisodeLoop:
    resolved = resolve(smoke("testing.method=shells", f"av={{model: {model}}}"))
    return EpisodeLoop(world, resolved.scenario, RecordPolicy("all", 0.0))


def run(world) -> Shard:
    return loop_in(world, "idm").run(0, at_once(STATES))


def test_contact_in_the_step_of_the_cut_in_is_retraced_and_no_surrogate_crashes():
    campaign = smoke("testing.method=shells")
    environment, library = load_environment(campaign.environment), load_library("ladder-1")
    shard = run(TwinWorld(4))
    assert shard.episode["outcome"].tolist() == OUTCOMES
    assert shard.episode["n_steps"].tolist() == [1, 200, 1, 1]
    episodes = episodes_table(shard, campaign.seed)
    assert retraced(episodes, resolve(campaign)) == []
    crashes = np.full(len(STATES), -1, np.int64)
    stored, room = stored_paths(episodes, campaign.seed), empty_trajectory(environment)
    followers = Followers(library.followers(environment.lateral.present).drivers)
    assert replay_surrogates(*map(unboxed, (stored, environment, followers, room)), crashes) == -1
    everybody = 2 ** len(library.surrogates) - 1
    assert crashes.tolist()[::2] == [0, everybody]
    assert crashes[3] == 0


@pytest.mark.parametrize("shim", [True, False])
@pytest.mark.parametrize("n_cells", [1, 4, 64])
def test_sumo_agrees_also_with_cells_that_stay_empty(open_world, n_cells, shim):
    twin, sumo = run(TwinWorld(4)), run(open_world(n_cells, shim=shim))
    assert twin.episode.tobytes() == sumo.episode.tobytes()
    for row, trace in twin.traces.items():
        assert np.array_equal(trace, sumo.traces[row], equal_nan=True)


def test_sumo_flags_vehicles_beside_each_other_by_the_rule_of_the_first_overlap(open_world):
    """Around -0.001 and -9.999 m: the loop stops where SUMO's own flag says something else than the positions."""
    traffic = beside([r2_m for r2_m, _ in BESIDE])
    episode = {}
    for name, world in (("twin", TwinWorld(4)), ("sumo", open_world(4))):
        episode[name] = loop_in(world, "constant").run(0, traffic).episode
    assert episode["sumo"].tobytes() == episode["twin"].tobytes()
    for row, (_, outcome) in zip(episode["sumo"], BESIDE, strict=True):
        assert (row["n_steps"] > 1) if outcome is None else (row["outcome"], row["n_steps"]) == (outcome, 1)
