"""Cut-ins as a pool enumerates them, as the episode loop drives them, and by a second walk of the path."""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled_threads
from harness.episode.loop import Drawing, EpisodeLoop, RecordPolicy
from harness.episode.path import Followers
from harness.importance.build import build_importance
from harness.maneuvers import acceleration
from harness.pool.shells import Draw, PrescribedEpisodes
from harness.pool.walk import enumerate_cut_ins
from harness.random_stream import BV_DRAWS, LV_DRAWS, uniform
from harness.traffic.initial_state import InitialStates
from harness.traffic.laws import (
    Environment,
    acceptance,
    car_following,
    cut_in_hazard,
    draw_acceleration,
    free_driving,
    opportunity,
)
from harness.traffic.loading import load_environment
from harness.vehicles.kinematics import CONTACT_M, next_position, next_speed
from harness.vocabulary import State
from harness.worlds.twin import TwinWorld
from tests.chains.seed import SEED


def enumerated(library, environment: Environment, n: int, *, enclosed=True, stride=1, offset=0):
    """Probability of each cut-in of n paths, and who crashes on it; with or without an envelope that is asked first."""
    states, offsets = InitialStates(environment.numbers).draw(SEED, 0, n), np.full(n, offset)
    followers = library.followers_in(environment)
    asked = environment, followers if enclosed else Followers(followers.drivers)
    found = enumerate_cut_ins(SEED, np.arange(n), states, *asked, stride=stride, offset=offsets)
    return found.probability, found.crashes


def driven(campaign, pool, library, name: str):
    """Sixty cut-ins of each stratum, as rows of the pool; the episodes that a driver has met them in; their log p."""
    prescribed = PrescribedEpisodes(campaign, pool)
    states, traffic, cut_ins = prescribed.episodes(tuple(Draw(s, 0, 60) for s in range(prescribed.design.p.size)))
    environment = load_environment(campaign.environment)
    place = [*library.surrogates, *library.references].index(name)
    driver = library.followers_in(environment).drivers[place][None].copy()
    if name == library.envelope:  # it acts from the onset
        driver["perceives_lateral_m"] = 0.0
    policy = Drawing(1, environment, build_importance(campaign, None), driver)
    shard = EpisodeLoop(TwinWorld(16), policy, RecordPolicy(0, "none", 0.0)).run(0, states, traffic)
    return cut_ins.row, shard.results.episode, np.log(prescribed.design.p[traffic.stratum])


@compiled_threads
def _hazards(seed: int, states: np.ndarray, environment: Environment, out: np.ndarray) -> None:
    for i in range(states.size):
        s = states[i]
        x_av, x_bv, v_av, v_bv = 100.0, 105.0 + s.r2_m, s.v_bv_mps - s.r2dot_mps, s.v_bv_mps
        x_lv, v_lv = x_bv + 5.0 + s.r1_m, max(s.v_bv_mps + s.r1dot_mps, 0.0)
        a_lv = a_bv = out[i] = 0.0
        for step in range(environment.numbers.max_steps):
            now = State(v_bv, x_lv - 5.0 - x_bv, v_lv - v_bv, x_bv - 5.0 - x_av, v_bv - v_av)
            if step > 0 and (now.r1_m < CONTACT_M or now.r2_m <= 0.0):
                break
            draw, held = divmod(step, environment.numbers.hold_steps)
            if held == 0:
                u_lv, u_bv = uniform(seed, i, LV_DRAWS, draw), uniform(seed, i, BV_DRAWS, draw)
                a_lv = acceleration(draw_acceleration(u_lv, free_driving(v_lv, environment), environment))
                a_bv = acceleration(draw_acceleration(u_bv, car_following(now, environment), environment))
            accepted = acceptance(now.r2_m, now.r2dot_mps, environment)
            out[i] += cut_in_hazard(opportunity(now, environment), accepted, environment)
            after_lv, after_bv = next_speed(v_lv, a_lv), next_speed(v_bv, a_bv)
            x_lv, x_bv = next_position(x_lv, v_lv, after_lv), next_position(x_bv, v_bv, after_bv)
            x_av = next_position(x_av, v_av, v_av)
            v_lv, v_bv = after_lv, after_bv


def p_cut_in_of_paths(seed: int, states: np.ndarray, environment: Environment) -> np.ndarray:
    """P(cut-in | path), the path walked a second time: only draws, hazards and a vehicle's step are shared."""
    hazards = np.zeros(len(states))
    _hazards(seed, states, environment, hazards)
    return -np.expm1(-hazards)
