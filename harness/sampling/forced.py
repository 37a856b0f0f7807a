"""Every test has a cut-in; its weight is the probability that there is one on its path."""

from __future__ import annotations

import numpy as np

from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.decide import CUT_IN_DRAW
from harness.loop.cells import PrescribedTraffic
from harness.loop.judge import motion_hashes
from harness.loop.loop import EpisodeLoop, Shard
from harness.pool.cut_ins import onset_steps
from harness.pool.walk import enumerate_cut_ins, write_script
from harness.random_stream import CUT_IN, uniforms
from harness.sampling.baseline import recorded, without_cut_in
from harness.sampling.protocol import ShardRequest, Source
from harness.vehicles.drivers import Followers, driver_records
from harness.vocabulary import RecordArray

AT_ONCE = 1000
"""Baseline runs whose motion is held in memory at once: some 15 MB."""


class Forced(Source):
    """The cut-in's step is drawn given that there is one.

    A vehicle that acts before the cut-in is driven along the path without one first, which prescribes the test.
    """

    def run(self, loop: EpisodeLoop, request: ShardRequest) -> Shard:
        if not self.campaign.has_baseline_runs:
            return super().run(loop, request)
        first, states = request.first_episode, self.states(request.first_episode, request.n_episodes)
        return loop.run(first, states, forced_traffic(loop, self.policy.seed, first, states, self.policy.environment))


def forced_traffic(
    loop: EpisodeLoop, seed: int, first: int, state: RecordArray, environment: Environment
) -> PrescribedTraffic:
    """Scripts of consecutive forced cut-ins (n,), each after a baseline run of its own on the same path.

    The cut-in's step is drawn given that there is one, and its weight is the probability of that: both follow from the
    baseline run. Where that fails there is no cut-in; the test fails as well, and weighs what it may have hidden.
    """
    begins = range(0, len(state), AT_ONCE)
    parts = [_forced(loop, seed, first + begin, state[begin : begin + AT_ONCE], environment) for begin in begins]
    return PrescribedTraffic._make(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _forced(
    loop: EpisodeLoop, seed: int, first: int, state: RecordArray, environment: Environment
) -> PrescribedTraffic:
    n, index = len(state), first + np.arange(len(state))
    runs = recorded(without_cut_in(loop, seed, first, index, state, environment), environment)
    nobody = Followers(driver_records([]))
    probability, _, p_after_failure = enumerate_cut_ins(seed, index, state, environment, nobody, runs)
    cumulative = np.cumsum(probability, axis=1)
    p_cut_in = cumulative[:, -1]
    u = uniforms(seed, first, n, CUT_IN, CUT_IN_DRAW + 1)[:, CUT_IN_DRAW]
    step = np.minimum((cumulative <= (u * p_cut_in)[:, None]).sum(1), (cumulative < p_cut_in[:, None]).sum(1))
    step[runs.failed] = -1
    lv, bv, _, _, lead = write_script(seed, index, step, state, environment, draws_per_cut_in=0)
    motion = motion_hashes(runs.x_m, runs.v_mps)[np.arange(n), onset_steps(step, lead)]
    return PrescribedTraffic(lv, bv, step, np.full(n, -1), np.log(p_cut_in + p_after_failure), index, motion, lead)
