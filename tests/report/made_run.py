"""Write a whole run folder, as `harness run` would leave it: tests drawn in the twin, some of them changed.

What no such tests would show is put in: crashes that did not happen, tests that failed, shells with made-up numbers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.campaign import Campaign
from harness.episode.cells import PrescribedCutIns
from harness.episode.loop import Shard
from harness.estimators.answer import estimate_blocks
from harness.records.folder import checksum, encoded, write_shard
from harness.records.schemas import shard_tables
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.runner.stored import stored_blocks
from harness.strata import STORED_DESIGN, ShellDesign, Statement
from harness.vocabulary import CRASH, FAILED, TIMEOUT
from harness.worlds.twin import TwinWorld

HASH = "0123456789abcdef"
LARGEST_P_CUT_IN = 1e-6
"""Bounds the weights by 1e-5, so that so few tests have a half-width to show."""
P = np.array([4e-8, 9e-8, 3e-5])
"""Probabilities that are far apart: sums that ignore how often a shell was tested come out wrong by orders."""
PATH_MASS = 3.0 * P
"""Of a crashed test's path: some paths have more mass than others."""
DESIGN = ShellDesign(
    pool="c0ffee" * 4, strata=("brakes-hard", "brakes-late", "outside"), cell_stratum=(0, 1, 2), cell_p=P,
    cell_references=(0, 0, 0),
    n_paths=4_000, statements=(Statement("library", "brakes-late", "keeps to brakes-late", 2),),
    p_cut_in=3.3e-5, p_unreachable=2.87e-6,
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
    "weighted": RunRecipe(n_episodes=3_000, shard_size=1_000),
    "no_crash": RunRecipe(crashes=False),
    "nde": RunRecipe(method="nde", level=2e6, n_episodes=3_000, target_rhw=None),
    "failed": RunRecipe(n_failed=25, traces="none", moments=False),
    "shells": RunRecipe(method="shells", moments=False, traces="none", n_failed=5),
    "shells_refuted": RunRecipe(method="shells", moments=False, outside="crashes"),
    "shells_inside_only": RunRecipe(
        method="shells", moments=False, traces="none", outside="untested", statement="library"
    ),
}


def write_run(folder: Path, recipe: RunRecipe) -> Path:
    """Write the folder and return it."""
    campaign = _campaign(recipe)
    of_shells = recipe.method == "shells"
    drawn = prepare(resolve(_campaign(replace(recipe, method="episode_mixture")) if of_shells else campaign))
    loop, rng = drawn.loop(TwinWorld(64)), np.random.default_rng(7)
    failing = np.linspace(0, recipe.n_episodes - 1, recipe.n_failed).astype(int)
    shards, distance_m = [], 0.0
    for index, first in enumerate(range(0, recipe.n_episodes, recipe.shard_size)):
        n = min(recipe.shard_size, recipe.n_episodes - first)
        shard = loop.run(first, drawn.states(first, n))
        e = shard.results.episode
        e["log_p_cut_in"] = np.log(LARGEST_P_CUT_IN)
        if not recipe.crashes:
            _end(shard, e["outcome"] == CRASH, TIMEOUT)
        failed = np.isin(first + np.arange(n), failing)
        _end(shard, failed, FAILED)
        e["log_weight"][failed] = 0.0
        shard.failures.update(dict.fromkeys(np.flatnonzero(failed).tolist(), "the world lost vehicle AV"))
        if of_shells:
            shard = _put_into_shells(shard, rng, outside=recipe.outside)
        files = write_shard(folder, index, encoded(shard_tables(shard, 7, keep_traces=recipe.traces != "none")))
        shards.append({"index": index, "first_episode": first, "n_episodes": n, "files": files})
        distance_m += float(e["av_distance_m"].sum()) / recipe.n_episodes
    (folder / "campaign.yaml").write_text(campaign.model_dump_json())
    manifest = _manifest(recipe, shards, distance_m) | {"campaign_crc32": checksum(folder / "campaign.yaml")}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "shells.json").write_bytes(STORED_DESIGN.dump_json(DESIGN))
    estimates = estimate_blocks(stored_blocks(folder, moments=False), campaign, manifest)
    (folder / "estimates.json").write_text(json.dumps(estimates))
    return folder


def _end(shard: Shard, rows: np.ndarray, outcome: int) -> None:
    """Let some tests have ended otherwise, without a crash."""
    e = shard.results.episode
    e["outcome"][rows] = outcome
    e["crash_time_s"][rows] = e["impact_speed_mps"][rows] = np.nan
    for row in np.flatnonzero(rows).tolist():
        shard.traces.pop(row, None)


def _put_into_shells(shard: Shard, rng: np.random.Generator, *, outside: str) -> Shard:
    """Draw a shell for each test."""
    e = shard.results.episode
    cell, inside = rng.choice(3, e.size, p=(0.2, 0.3, 0.5)), rng.choice(2, e.size)
    if outside == "untested":
        cell = inside
    elif outside == "safe":
        cell = np.where(e["outcome"] == CRASH, inside, cell)
    e["component"], e["log_weight"], e["n_control_steps"] = cell, np.log(P)[cell], 1
    none = np.zeros((e.size, 0))
    results = shard.results._replace(log_q=none, martingale=none)
    cut_ins = PrescribedCutIns(np.arange(e.size), cell, np.tile(PATH_MASS, (e.size, 1)))
    return replace(shard, results=results, cut_ins=cut_ins)


def _campaign(recipe: RunRecipe) -> Campaign:
    return Campaign.model_validate(
        {
            "name": "made",
            "description": "Tests that exercise the report.",
            "seed": 7,
            "environment": {"lane_change_level": recipe.level},
            "testing": {"method": recipe.method, "challenge": "immediate", "shells": {"statement": recipe.statement}},
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
        "cpu": "Some CPU @ 3.0 GHz",
        "n_episodes": recipe.n_episodes,
        "stopped_by": "episodes",
        "wall_time_s": 71.3,
        "workers": 2,
    }
