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

from harness.arrays import FloatArray
from harness.campaign.models import AutomatedVehicle, Campaign
from harness.compiled import cache_root, source_hash
from harness.criticality.tables import Tables, tables_hash
from harness.environment.driving import Environment
from harness.environment.initial_state import InitialStates
from harness.episode.loop import MOMENT_LIMITS, EpisodeLoop, Keep, Policy, Shard
from harness.importance.build import build_importance
from harness.outcomes import CRASH
from harness.records.folder import write_json
from harness.twin import TwinWorld
from harness.vehicles.models import av_records, surrogate_records

EPISODES = 6_000
SEED = 40_001
_CELLS = 512


def table_errors(campaign: Campaign, environment: Environment, tables: Tables | None) -> list[dict[str, Any]]:
    """Compare the tables of a recursive campaign with Monte Carlo; kept beside the tables.

    Returns
    -------
    list of dict
        ``surrogate``, ``table`` (before or after the cut-in), ``quantity``, ``table_value``, ``monte_carlo`` and
        ``std_error`` of their difference. Empty for the immediate challenge, which is a yes or no by definition.
    """
    if tables is None or campaign.testing.challenge == "immediate":
        return []
    drivers = surrogate_records(campaign.surrogates)
    of_tables = tables_hash(environment, drivers, "recursive")
    level = float(environment.numbers["level"])
    key = hashlib.sha256(json.dumps([of_tables, list(campaign.surrogates), level, source_hash()]).encode()).hexdigest()
    path = cache_root() / "tables" / f"accuracy-{key[:24]}.json"
    if path.exists():
        found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))
        return found
    rows = [row for j in range(drivers.size) for row in _errors_of(j, campaign, environment, tables)]
    write_json(path, rows)
    return rows


def _errors_of(j: int, campaign: Campaign, environment: Environment, tables: Tables) -> list[dict[str, Any]]:
    name = list(campaign.surrogates)[j]
    shard = _run_surrogate(name, campaign, environment, tables)
    crash = shard.results.episode["outcome"] == CRASH
    y = np.where(crash, np.exp(shard.results.episode["log_weight"]), 0.0)
    before, after = _predictions(j, shard)
    return [
        _row(name, "before the cut-in", "mean of V_j(s_0)", before, y),
        _row(name, "after the cut-in", "mean of W V_j(s) at BV's first redraw", after, y),
    ]


def _run_surrogate(name: str, campaign: Campaign, environment: Environment, tables: Tables) -> Shard:
    """Episodes of the campaign's mixture with a surrogate as the AV, every control step kept."""
    model = campaign.surrogates[name]
    testing = campaign.testing.model_copy(update={"method": "episode_mixture", "criticality_threshold": 0.0})
    copy = campaign.model_copy(
        update={"av": AutomatedVehicle(model=model.model, parameters=model.parameters), "testing": testing}
    )
    policy = Policy(SEED, environment, build_importance(copy, tables), av_records(copy.av))
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


def _row(surrogate: str, table: str, quantity: str, predicted: FloatArray, y: FloatArray) -> dict[str, Any]:
    difference = predicted - y
    return {
        "surrogate": surrogate,
        "table": table,
        "quantity": quantity,
        "table_value": float(predicted.mean()),
        "monte_carlo": float(y.mean()),
        "std_error": float(difference.std(ddof=1)) / math.sqrt(y.size),
    }
