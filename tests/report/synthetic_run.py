"""Write a whole run folder, as `harness run` would leave it, from the synthetic overtaking simulation."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from synthetic_overtaking import N_COMPONENTS, Episodes, simulate

from harness.campaign.models import Campaign
from harness.estimators.one_pass import CampaignFacts, estimate_blocks
from harness.importance.build import importance_names
from harness.maneuvers import CUT_IN, STAY
from harness.outcomes import VEHICLES
from harness.records.schemas import episodes_schema, moments_schema, traces_schema
from harness.runner.stored_estimates import stored_blocks
from harness.strata import ShellDesign, Statement

HASH = "0123456789abcdef"
LARGEST_P_CUT_IN = 1e-6
"""Made up: it bounds the weights by 1e-5, which none of these tests exceeds, so that there is a half-width to show."""
P = np.array([4e-8, 9e-8, 3e-5])
"""Probabilities that are far apart: sums that ignore how often a shell was tested come out wrong by orders."""
PATH_MASS = 3.0 * P
"""Of a crashed test's path: some paths have more mass than others."""
DESIGN = ShellDesign(
    pool="c0ffee" * 4, strata=("brakes-hard", "brakes-late", "outside"), cell_stratum=(0, 1, 2), cell_p=P,
    cell_references=(0, 0, 0),
    n_paths=4_000, statements=(Statement("library", "brakes-late", "keeps to brakes-late", 2),),
    p_cut_in=3.3e-5, p_impossible=2.87e-6,
)  # fmt: skip


@dataclass(frozen=True)
class RunRecipe:
    """What the run folder should look like; crashes outside the boundary may be ``safe``, ``crashes``, ``untested``."""

    method: str = "episode_mixture"
    n_episodes: int = 1_500
    shard_size: int = 500
    crashes: bool = True
    traces: str = "crash"
    moments: bool = True
    n_failed: int = 0
    level: float = 1.0
    target_rhw: float | None = 0.1
    outside: str = "safe"
    statement: str = "assumption_free"


RECIPES = {
    "full": RunRecipe(n_episodes=3_000, shard_size=1_000),
    "no_crashes": RunRecipe(crashes=False),
    "bare": RunRecipe(traces="none", moments=False),
    "nde": RunRecipe(method="nde", level=2e6, n_episodes=3_000, target_rhw=None),
    "nde_no_crashes": RunRecipe(method="nde", traces="none"),
    "failed": RunRecipe(n_failed=25, traces="none"),
    "shells": RunRecipe(method="shells", moments=False, traces="none", n_failed=5),
    "shells_refuted": RunRecipe(method="shells", moments=False, outside="crashes"),
    "shells_no_crashes": RunRecipe(method="shells", moments=False, crashes=False, traces="none"),
    "shells_inside_only": RunRecipe(
        method="shells", moments=False, traces="none", outside="untested", statement="library"
    ),
}


def write_run(folder: Path, recipe: RunRecipe) -> Path:
    """Write the folder and return it."""
    drawn = recipe.method != "nde"
    episodes = simulate(recipe.n_episodes, seed=7, level=recipe.level, controlled=drawn)
    if not recipe.crashes:
        _let_every_crash_time_out(episodes)
    _let_some_fail(episodes, recipe.n_failed)
    if recipe.method == "shells":
        _put_into_shells(episodes, outside=recipe.outside)
    for table in ("episodes", "moments", "traces"):
        (folder / table).mkdir(parents=True)
    shards = [_write_shard(folder, episodes, recipe, first) for first in range(0, recipe.n_episodes, recipe.shard_size)]
    campaign, distance_m = _campaign(recipe), float(episodes.columns["av_distance_m"].mean())
    (folder / "campaign.yaml").write_text(campaign.model_dump_json())
    (folder / "manifest.json").write_text(json.dumps(_manifest(recipe, shards, distance_m)))
    (folder / "shells.json").write_text(json.dumps(DESIGN.to_json()))
    facts = CampaignFacts("synthetic", HASH, recipe.level, 0.9, distance_m, importance_names(campaign))
    (folder / "estimates.json").write_text(json.dumps(estimate_blocks(stored_blocks(folder, moments=False), facts)))
    return folder


def _let_every_crash_time_out(episodes: Episodes) -> None:
    c = episodes.columns
    crash = c["outcome"] == "crash"
    c["outcome"][crash] = "timeout"
    c["crash_time_s"][crash] = c["impact_speed_mps"][crash] = np.nan


def _let_some_fail(episodes: Episodes, n_failed: int) -> None:
    c = episodes.columns
    rows = np.linspace(0, len(c["outcome"]) - 1, n_failed).astype(int)
    c["outcome"][rows] = "failed"
    c["log_weight"][rows] = 0.0
    c["crash_time_s"][rows] = c["impact_speed_mps"][rows] = np.nan


def _put_into_shells(episodes: Episodes, *, outside: str) -> None:
    """Draw a shell for each episode."""
    c = episodes.columns
    n = len(c["outcome"])
    rng = np.random.default_rng(7)
    shell, inside = rng.choice(3, n, p=(0.2, 0.3, 0.5)), rng.choice(2, n)
    if outside == "untested":
        shell = inside
    elif outside == "safe":
        shell = np.where(c["outcome"] == "crash", inside, shell)
    c["component"], c["log_weight"] = shell, np.log(P)[shell]
    c["n_control_steps"] = np.ones(n, dtype=int)


def _write_shard(folder: Path, episodes: Episodes, recipe: RunRecipe, first: int) -> dict[str, Any]:
    rows = np.arange(first, min(first + recipe.shard_size, recipe.n_episodes))
    index = first // recipe.shard_size
    tables = {"episodes": _episodes_table(episodes, rows, recipe)}
    if recipe.moments:
        tables["moments"] = _moments_table(episodes, rows)
    if recipe.traces != "none":
        tables["traces"] = _traces_table(episodes, rows)
    files = {name: f"{name}/shard-{index:06d}.parquet" for name in tables}
    for name, table in tables.items():
        pq.write_table(table, folder / files[name], compression="zstd")
    return {"index": index, "first_episode": first, "n_episodes": len(rows), "files": files}


def _table(columns: dict[str, Any], schema: pa.Schema) -> pa.Table:
    return pa.Table.from_pandas(pd.DataFrame(columns), schema=schema, preserve_index=False)


def _episodes_table(episodes: Episodes, rows: np.ndarray, recipe: RunRecipe) -> pa.Table:
    n_importance = N_COMPONENTS if recipe.method == "episode_mixture" else 0
    c = {name: values[rows] for name, values in episodes.columns.items()}
    columns = c | {
        "episode": rows,
        "seed": 7,
        "cut_in_step": np.where(c["cut_in_step"] < 0, np.nan, c["cut_in_step"]),
        "pool_cut_in": rows if recipe.method == "shells" else None,
        "log_p_cut_in": np.log(LARGEST_P_CUT_IN) if n_importance else np.nan,
        "log_q": list(episodes.log_q[rows, :n_importance]),
        "martingale": [np.zeros(max(n_importance - 1, 0))] * len(rows),
        "lv_maneuvers": [_drawn(episodes.lv_maneuvers[r], episodes.columns["n_steps"][r], -1) for r in rows],
        "bv_maneuvers": [
            _drawn(episodes.bv_maneuvers[r], episodes.columns["n_steps"][r], episodes.columns["cut_in_step"][r])
            for r in rows
        ],
        "failure": ["the world lost vehicle AV" if outcome == "failed" else None for outcome in c["outcome"]],
    }
    if recipe.method == "shells":
        columns |= {"cell": c["component"], "cell_mass": [PATH_MASS] * len(rows), "ahead_step": None}
    n_cells = P.size if recipe.method == "shells" else 0
    return _table(columns, episodes_schema(n_importance, max(n_importance - 1, 0), n_cells))


def _drawn(maneuvers: np.ndarray, n_steps: int, cut_in_step: int) -> list[int]:
    drawn = maneuvers[: -(-int(n_steps) // 10)].tolist()
    if cut_in_step >= 0:
        drawn.insert(int(cut_in_step) // 10 + 1, CUT_IN)
    return drawn


def _moments_table(episodes: Episodes, rows: np.ndarray) -> pa.Table:
    """The first control step of each episode."""
    c, x, v = episodes.columns, episodes.x_m[rows, 0], episodes.v_mps[rows, 0]
    n = len(rows)
    columns = {
        "episode": rows, "step": 0, "v_bv_mps": v[:, 1], "r1_m": x[:, 0] - 5.0 - x[:, 1],
        "r1dot_mps": v[:, 0] - v[:, 1],
        "r2_m": x[:, 1] - 5.0 - x[:, 2], "r2dot_mps": v[:, 1] - v[:, 2],
        "maneuver": np.where(c["cut_in_step"][rows] == 0, CUT_IN, STAY), "p": 0.999, "q_sampled": 0.99,
        "q": [[0.99] * (N_COMPONENTS - 1)] * n, "v": [[1e-4] * (N_COMPONENTS - 1)] * n,
    }  # fmt: skip
    return _table(columns, moments_schema(N_COMPONENTS - 1))


def _traces_table(episodes: Episodes, rows: np.ndarray) -> pa.Table:
    parts = []
    for r in rows[episodes.columns["outcome"][rows] == "crash"]:
        n = int(episodes.columns["n_steps"][r]) + 1
        step, vehicle = np.repeat(np.arange(n), len(VEHICLES)), np.tile(VEHICLES, n)
        on_left = (vehicle == "LV") | ((vehicle == "BV") & (step <= episodes.columns["cut_in_step"][r]))
        parts.append(
            pd.DataFrame({
                "episode": r, "step": step, "vehicle": vehicle, "lane": on_left.astype(int),
                "x_m": episodes.x_m[r, :n].ravel(), "v_mps": episodes.v_mps[r, :n].ravel(), "a_mps2": np.nan,
            })
        )  # fmt: skip
    return _table(pd.concat(parts), traces_schema()) if parts else traces_schema().empty_table()


def _campaign(recipe: RunRecipe) -> Campaign:
    return Campaign.model_validate(
        {
            "name": "synthetic",
            "description": "Synthetic overtaking tests that exercise the report.",
            "seed": 7,
            "environment": {"lane_change_level": recipe.level},
            "testing": {"method": recipe.method, "shells": {"statement": recipe.statement}},
            "records": {"traces": recipe.traces, "moments": "first_9" if recipe.moments else "none"},
            "stop": {"episodes": recipe.n_episodes, "rhw": recipe.target_rhw},
        }
    )


def _manifest(recipe: RunRecipe, shards: list[dict[str, Any]], distance_m: float) -> dict[str, Any]:
    return {
        "campaign_hash": HASH,
        "created": "2025-01-02T03:04:05Z",
        "versions": {"harness": "0.1.0", "python": "3.11.9", "numpy": "2.1.0", "libsumo": "1.28.0"},
        "seed": 7,
        "shards": shards,
        "distance_per_test_m": distance_m,
        "cpu": "Synthetic CPU @ 3.0 GHz",
        "n_episodes": recipe.n_episodes,
        "stopped_by": "episodes",
        "wall_time_s": 71.3,
        "workers": 2,
        "table_errors": [
            {"surrogate": "SM-I", "table": "after the cut-in", "quantity": "crash probability", "table_value": 3.21e-5,
             "monte_carlo": 3.18e-5, "std_error": 2.1e-7},
        ] if recipe.method == "episode_mixture" else [],
    }  # fmt: skip
