"""How far the challenge tables are from Monte Carlo: reported with every run, used by none.

A surrogate is put in the AV's place and run in the twin. If its tables were exact, the mean of V_j(s_0) before any
maneuver, and the mean of W V_j(s) at the first redraw after the cut-in, would both equal its crash rate. A difference
costs efficiency, never correctness: weights use the probabilities that were drawn from.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any

import numpy as np

from harness.compiled import WORLD_SOURCES, cache_root, source_hash
from harness.episode.loop import MOMENT_LIMITS, EpisodeLoop, Keep, Policy, Shard
from harness.importance.build import build_importance
from harness.importance.tables import Tables, tables_hash
from harness.records.folder import write_json
from harness.resolved import Resolved
from harness.traffic.initial_state import InitialStates
from harness.vocabulary import CRASH, FloatArray
from harness.worlds.twin import TwinWorld

EPISODES = 6_000
SEED = 40_001
_CELLS = 512


def table_errors(resolved: Resolved, tables: Tables | None) -> list[dict[str, Any]]:
    """Compare the tables of a recursive campaign with Monte Carlo; kept beside the tables.

    Returns
    -------
    list of dict
        ``surrogate``, ``table`` (before or after the cut-in), ``quantity``, ``table_value``, ``monte_carlo`` and
        ``std_error`` of their difference. Empty for the immediate challenge, which is a yes or no by definition.
    """
    campaign, environment = resolved.campaign, resolved.environment
    if tables is None or campaign.testing.challenge == "immediate":
        return []
    of_tables = tables_hash(environment, resolved.surrogates, "recursive")
    level = float(environment.numbers["level"])
    content = [of_tables, list(campaign.surrogates), level, source_hash(WORLD_SOURCES)]
    key = hashlib.sha256(json.dumps(content).encode()).hexdigest()
    path = cache_root() / "tables" / f"accuracy-{key[:24]}.json"
    if path.exists():
        found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))
        return found
    rows = [row for j in range(resolved.surrogates.size) for row in _errors_of(j, resolved, tables)]
    write_json(path, rows)
    return rows


def _errors_of(j: int, resolved: Resolved, tables: Tables) -> list[dict[str, Any]]:
    name = list(resolved.campaign.surrogates)[j]
    shard = _run_surrogate(j, resolved, tables)
    episode = shard.results.episode
    y = np.where(episode["outcome"] == CRASH, np.exp(episode["log_weight"]), 0.0)
    quantities = {"before the cut-in": "mean of V_j(s_0)", "after the cut-in": "mean of W V_j(s) at BV's first redraw"}
    return [
        {
            "surrogate": name,
            "table": table,
            "quantity": quantity,
            "table_value": float(predicted.mean()),
            "monte_carlo": float(y.mean()),
            "std_error": float((predicted - y).std(ddof=1)) / math.sqrt(y.size),
        }
        for (table, quantity), predicted in zip(quantities.items(), _predictions(j, shard), strict=True)
    ]


def _run_surrogate(j: int, resolved: Resolved, tables: Tables) -> Shard:
    """Episodes of the campaign's mixture with surrogate ``j`` as the AV, every control step kept."""
    campaign, environment = resolved.campaign, resolved.environment
    testing = campaign.testing.model_copy(update={"method": "episode_mixture", "criticality_threshold": 0.0})
    importance = build_importance(campaign.model_copy(update={"testing": testing}), tables)
    policy = Policy(SEED, environment, importance, resolved.surrogates[j : j + 1])
    states = InitialStates(environment.numbers).draw(SEED, 0, EPISODES)
    return EpisodeLoop(TwinWorld(_CELLS), policy, Keep(MOMENT_LIMITS["all"], "none", 0.0)).run(0, states)


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
    before, after = np.zeros(len(shard.results.episode)), np.zeros(len(shard.results.episode))
    at_start = moment["step"] == 0
    before[moment["row"][at_start]] = v[at_start]
    at_redraw = moment["step"] == shard.results.episode["cut_in_step"][moment["row"]] + 1
    at_redraw &= shard.results.episode["cut_in_step"][moment["row"]] >= 0
    after[moment["row"][at_redraw]] = (weight_before * v)[at_redraw]
    return before, after
