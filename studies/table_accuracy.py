"""How far the tables of the recursive challenge are from Monte Carlo.

A surrogate is put in the AV's place and run in the twin. If its tables were exact, the mean of V_j(s_0) before any
maneuver, and the mean of W V_j(s) at the first redraw after the cut-in, would both equal its crash rate. A difference
costs efficiency, never correctness: weights use the probabilities that were drawn from.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from harness.episode.loop import MOMENT_LIMITS, Drawing, EpisodeLoop, RecordPolicy, Shard
from harness.importance.build import build_importance
from harness.importance.tables import Tables
from harness.resolved import Resolved
from harness.runner.resolve import prepare
from harness.traffic.initial_state import InitialStates
from harness.vocabulary import CRASH, FloatArray
from harness.worlds.twin import TwinWorld

EPISODES = 6_000
SEED = 40_001
_CELLS = 512
QUANTITIES = {"before the cut-in": "mean of V_j(s_0)", "after the cut-in": "mean of W V_j(s) at BV's first redraw"}


def table_errors(resolved: Resolved) -> Iterator[dict[str, Any]]:
    """By surrogate and table: its value, Monte Carlo's, and the standard error of the difference.

    Nothing for campaigns without tables, nor for the immediate challenge, which is a yes or no by definition.
    """
    tables = prepare(resolved).tables
    if tables is None or resolved.campaign.testing.challenge == "immediate":
        return
    for j, surrogate in enumerate(resolved.campaign.surrogates):
        shard = _run_surrogate(j, resolved, tables)
        y = np.where(shard.results.episode["outcome"] == CRASH, np.exp(shard.results.episode["log_weight"]), 0.0)
        for (table, quantity), predicted in zip(QUANTITIES.items(), _predictions(j, shard), strict=True):
            yield {
                "surrogate": surrogate,
                "table": table,
                "quantity": quantity,
                "table_value": float(predicted.mean()),
                "monte_carlo": float(y.mean()),
                "std_error": float((predicted - y).std(ddof=1)) / math.sqrt(y.size),
            }


def _run_surrogate(j: int, resolved: Resolved, tables: Tables) -> Shard:
    """Episodes of the campaign's mixture with surrogate ``j`` as the AV, every control step kept."""
    campaign, environment = resolved.campaign, resolved.environment
    testing = campaign.testing.model_copy(update={"method": "episode_mixture", "criticality_threshold": 0.0})
    importance = build_importance(campaign.model_copy(update={"testing": testing}), tables)
    policy = Drawing(SEED, environment, importance, resolved.surrogates[j : j + 1])
    states = InitialStates(environment.numbers).draw(SEED, 0, EPISODES)
    return EpisodeLoop(TwinWorld(_CELLS), policy, RecordPolicy(MOMENT_LIMITS["all"], "none", 0.0)).run(0, states)


def _predictions(j: int, shard: Shard) -> tuple[FloatArray, FloatArray]:
    """Per episode V_j(s_0), and W V_j(s) at the first control step after the cut-in (0 without one)."""
    used = int(shard.results.moment_count[0])
    moment, v = shard.results.moment[:used], shard.results.moment_v[:used, j]
    order = np.lexsort((moment["step"], moment["row"]))
    moment, v = moment[order], v[order]
    log_step = np.log(moment["p"]) - np.log(moment["q_sampled"])
    first = np.searchsorted(moment["row"], moment["row"])
    total = np.concatenate([[0.0], np.cumsum(log_step)])
    weight_before = np.exp(total[:-1] - total[first])
    before, after = np.zeros((2, len(shard.results.episode)))
    at_start = moment["step"] == 0
    before[moment["row"][at_start]] = v[at_start]
    cut_in = shard.results.episode["cut_in_step"][moment["row"]]
    at_redraw = (cut_in >= 0) & (moment["step"] == cut_in + 1)
    after[moment["row"][at_redraw]] = (weight_before * v)[at_redraw]
    return before, after
