"""Write a whole run folder, as `harness run` would leave it, from the synthetic overtaking simulation."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy import stats
from synthetic_overtaking import N_SURROGATES, STEP_S, Episodes, simulate
from synthetic_shells import put_into_shells, shells_estimates

from harness.campaign.models import Campaign
from harness.estimators.run_estimates import CampaignFacts
from harness.records.schemas import CUT_IN, STAY, VEHICLES, episodes_schema, moments_schema, traces_schema

HASH = "0123456789abcdef"


@dataclass(frozen=True)
class RunRecipe:
    """What the run folder should look like."""

    method: str = "episode_mixture"
    n_episodes: int = 3_000
    shard_size: int = 1_000
    crashes: bool = True
    traces: str = "crash"
    moments: bool = True
    n_failed: int = 0
    level: float = 1.0
    seed: int = 7
    name: str = "synthetic"
    target_rhw: float | None = 0.1
    outside: str = "safe"
    statement: str = "assumption_free"

    @property
    def controlled(self) -> bool:
        """Whether maneuvers were drawn from importance functions."""
        return self.method not in {"nde", "shells"}


RECIPES = {
    "full": RunRecipe(),
    "no_crashes": RunRecipe(crashes=False, n_episodes=1_500),
    "no_traces": RunRecipe(traces="none", n_episodes=1_500),
    "no_moments": RunRecipe(moments=False, n_episodes=1_500),
    "nde": RunRecipe(method="nde", level=2e6, n_episodes=3_000, target_rhw=None),
    "nde_no_crashes": RunRecipe(method="nde", n_episodes=1_500, traces="none"),
    "failed": RunRecipe(n_failed=25, n_episodes=1_500, traces="none"),
    "shells": RunRecipe(method="shells", moments=False, n_episodes=1_500, n_failed=5),
    "shells_refuted": RunRecipe(method="shells", moments=False, n_episodes=1_500, outside="crashes"),
    "shells_no_crashes": RunRecipe(method="shells", moments=False, n_episodes=1_500, crashes=False, traces="none"),
    "shells_inside_only": RunRecipe(
        method="shells", moments=False, n_episodes=1_500, traces="none", outside="untested", statement="conditional"
    ),
}


def write_run(folder: Path, recipe: RunRecipe) -> Path:
    """Write the folder and return it."""
    drawn = recipe.method != "nde"
    episodes = simulate(recipe.n_episodes, seed=recipe.seed, level=recipe.level, controlled=drawn)
    if not recipe.crashes:
        _let_every_crash_time_out(episodes)
    _let_some_fail(episodes, recipe.n_failed)
    if recipe.method == "shells":
        put_into_shells(episodes, outside=recipe.outside, seed=recipe.seed)
    for table in ("episodes", "moments", "traces"):
        (folder / table).mkdir(parents=True)
    shards = [_write_shard(folder, episodes, recipe, first) for first in range(0, recipe.n_episodes, recipe.shard_size)]
    (folder / "campaign.yaml").write_text(json.dumps(_campaign(recipe)))
    (folder / "manifest.json").write_text(json.dumps(_manifest(recipe, shards, episodes)))
    (folder / "estimates.json").write_text(json.dumps(_estimates(recipe, episodes)))
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
    for name in ("crash_time_s", "impact_speed_mps"):
        c[name][rows] = np.nan


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


def _episodes_table(episodes: Episodes, rows: np.ndarray, recipe: RunRecipe) -> pa.Table:
    n_importance, n_surrogates = (N_SURROGATES + 1, N_SURROGATES) if recipe.controlled else (0, 0)
    schema = episodes_schema(n_importance, n_surrogates)
    columns: dict[str, Any] = {name: values[rows] for name, values in episodes.columns.items()}
    columns |= {
        "episode": rows,
        "seed": np.full(len(rows), recipe.seed),
        "pool_cut_in": [int(r) if recipe.method == "shells" else None for r in rows],
        "log_p_cut_in": np.full(len(rows), np.nan),
        "log_q": [list(map(float, episodes.log_q[r][:n_importance])) for r in rows],
        "martingale": [[0.0] * n_surrogates for _ in rows],
        "lv_maneuvers": [_drawn(episodes.lv_maneuvers[r], episodes.columns["n_steps"][r], -1) for r in rows],
        "bv_maneuvers": [
            _drawn(episodes.bv_maneuvers[r], episodes.columns["n_steps"][r], episodes.columns["cut_in_step"][r])
            for r in rows
        ],
        "failure": ["the world lost vehicle AV" if o == "failed" else None for o in columns["outcome"]],
        "cut_in_step": [None if step < 0 else int(step) for step in columns["cut_in_step"]],
    }
    return pa.Table.from_arrays([_array(columns[field.name], field) for field in schema], schema=schema)


def _drawn(maneuvers: np.ndarray, n_steps: int, cut_in_step: int) -> list[int]:
    drawn = [int(m) for m in maneuvers[: -(-int(n_steps) // 10)]]
    if cut_in_step >= 0:
        drawn.insert(int(cut_in_step) // 10 + 1, CUT_IN)
    return drawn


def _array(values: Any, field: pa.Field) -> pa.Array:
    if pa.types.is_floating(field.type) and field.nullable:
        return pa.array(np.asarray(values, dtype=float), field.type, from_pandas=True)
    if pa.types.is_dictionary(field.type):
        return pa.array([str(v) for v in values]).dictionary_encode().cast(field.type)
    return pa.array(values if isinstance(values, list) else np.asarray(values).tolist(), field.type)


def _moments_table(episodes: Episodes, rows: np.ndarray) -> pa.Table:
    schema = moments_schema(N_SURROGATES)
    c = episodes.columns
    content = []
    for r in rows[:200]:
        for step in range(min(int(c["n_control_steps"][r]), 9)):
            x, v = episodes.x_m[r, step], episodes.v_mps[r, step]
            content.append({
                "episode": int(r), "step": step, "v_bv_mps": v[1], "r1_m": x[0] - 5.0 - x[1], "r1dot_mps": v[0] - v[1],
                "r2_m": x[1] - 5.0 - x[2], "r2dot_mps": v[1] - v[2],
                "maneuver": CUT_IN if c["cut_in_step"][r] == step else STAY,
                "p": 0.999, "q_sampled": 0.99, "q": [0.99] * N_SURROGATES, "v": [1e-4] * N_SURROGATES,
            })  # fmt: skip
    return pa.Table.from_pylist(content, schema=schema)


def _traces_table(episodes: Episodes, rows: np.ndarray) -> pa.Table:
    schema = traces_schema()
    crashed = rows[episodes.columns["outcome"][rows] == "crash"]
    columns: dict[str, list[Any]] = {name: [] for name in schema.names}
    for r in crashed:
        n = int(episodes.columns["n_steps"][r]) + 1
        cut_in = int(episodes.columns["cut_in_step"][r])
        for k, vehicle in enumerate(VEHICLES):
            steps = np.arange(n)
            lane = np.ones(n) if vehicle == "LV" else np.zeros(n) if vehicle == "AV" else (steps <= cut_in).astype(int)
            v = episodes.v_mps[r, :n, k]
            columns["episode"] += [int(r)] * n
            columns["step"] += steps.tolist()
            columns["vehicle"] += [vehicle] * n
            columns["lane"] += lane.astype(int).tolist()
            columns["x_m"] += episodes.x_m[r, :n, k].tolist()
            columns["v_mps"] += v.tolist()
            columns["a_mps2"] += [*(np.diff(v) / STEP_S).tolist(), None]
    arrays = [
        pa.array(columns[f.name], pa.string()).dictionary_encode().cast(f.type)
        if pa.types.is_dictionary(f.type)
        else pa.array(columns[f.name], f.type)
        for f in schema
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _campaign(recipe: RunRecipe) -> dict[str, Any]:
    campaign = Campaign.model_validate(
        {
            "name": "synthetic",
            "description": "Synthetic overtaking tests that exercise the report.",
            "seed": recipe.seed,
            "environment": {"lane_change_level": recipe.level},
            "testing": {"method": recipe.method}
            | ({"shells": {"statement": recipe.statement}} if recipe.method == "shells" else {}),
            "records": {"traces": recipe.traces, "moments": "first_9" if recipe.moments else "none"},
            "stop": {"episodes": recipe.n_episodes, "rhw": recipe.target_rhw},
        }
    )
    return campaign.model_dump(mode="json") | {"name": recipe.name}


def _manifest(recipe: RunRecipe, shards: list[dict[str, Any]], episodes: Episodes) -> dict[str, Any]:
    return {
        "campaign_hash": HASH,
        "created": "2025-01-02T03:04:05Z",
        "versions": {"harness": "0.1.0", "python": "3.11.9", "numpy": "2.1.0", "libsumo": "1.28.0"},
        "seed": recipe.seed,
        "shards": shards,
        "distance_per_test_m": float(episodes.columns["av_distance_m"].mean()),
        "cpu": "Synthetic CPU @ 3.0 GHz",
        "n_episodes": recipe.n_episodes,
        "stopped_by": "episodes",
        "wall_time_s": 71.3,
        "workers": 2,
        "table_errors": [
            {"surrogate": "SM-I", "table": "after the cut-in", "quantity": "crash probability", "table_value": 3.21e-5,
             "monte_carlo": 3.18e-5, "std_error": 2.1e-7},
            {"surrogate": "SM-II", "table": "before the cut-in", "quantity": "crash probability",
             "table_value": 8.05e-6, "monte_carlo": 7.96e-6, "std_error": 6.0e-8},
        ] if recipe.controlled else [],
    }  # fmt: skip


def _normal(y: np.ndarray) -> dict[str, Any]:
    n, rate = len(y), float(y.mean())
    error = float(y.std(ddof=1) / np.sqrt(n))
    half = 1.6448536 * error
    upper = float(-np.log(0.1) * max(y.max(), 1e-5) / n) if rate == 0.0 else rate + 1.2815516 * error
    return {
        "crash_rate": rate, "std_error": error, "ci_low": max(rate - half, 0.0),
        "ci_high": rate + half if rate else upper,
        "upper_bound": upper, "confidence": 0.9, "rhw": half / rate if rate else None, "n_episodes": n,
        "n_crashes": int((y > 0).sum()), "n_effective": float(y.sum() ** 2 / (y**2).sum()) if rate else 0.0,
        "largest_weight_share": float(y.max() / y.sum()) if rate else None, "method": "normal", "warnings": [],
        "details": {},
    }  # fmt: skip


def _clopper_pearson(crash: np.ndarray) -> dict[str, Any]:
    n, k = len(crash), int(crash.sum())
    low = float(stats.beta.ppf(0.05, k, n - k + 1)) if k else 0.0
    high = float(stats.beta.ppf(0.95, k + 1, n - k))
    return _normal(crash.astype(float)) | {
        "ci_low": low, "ci_high": high, "upper_bound": float(stats.beta.ppf(0.9, k + 1, n - k)),
        "method": "Clopper-Pearson", "rhw": (high - low) / 2.0 / (k / n) if k else None,
    }  # fmt: skip


def _estimates(recipe: RunRecipe, episodes: Episodes) -> dict[str, Any]:
    c = episodes.columns
    if recipe.method == "shells":
        facts = CampaignFacts(recipe.name, HASH, recipe.level, 0.9, float(c["av_distance_m"].mean()))
        return shells_estimates(episodes, facts)
    valid, crash = c["outcome"] != "failed", c["outcome"] == "crash"
    y = np.where(crash, np.exp(c["log_weight"]), 0.0)[valid]
    nade = _normal(y)
    if recipe.method == "nde":
        found = {"nde": _clopper_pearson(crash[valid]), "nade": nade}
        found |= {
            name: {"crash_rate": None, "reason": "no importance function was used"} for name in ("mixture_cv", "scv")
        }
        headline = "nde"
    else:
        cv = {**nade, "method": "normal, control variates", "details": {"n_control_variates": 3}}
        scv_warning = "Algorithm 1 estimates the means of its columns from the same tests: its interval is too narrow."
        found = {
            "nade": nade,
            "mixture_cv": cv,
            "scv": {**nade, "warnings": [scv_warning]} if recipe.moments
            else {"crash_rate": None, "reason": "records.moments is none; scv needs first_9"},
            "nde": {"crash_rate": None, "reason": "tests were drawn from an importance function"},
        }  # fmt: skip
        headline = "mixture_cv"
    best, km = found[headline], float(c["av_distance_m"].mean()) / 1000.0
    return {
        "campaign": recipe.name, "campaign_hash": HASH, "lane_change_level": recipe.level, "confidence": 0.9,
        "n_episodes": int(valid.sum()), "n_crashes": int(crash.sum()), "headline": headline, "distance_per_test_km": km,
        "crash_rate_per_1e6_km": {"rate": best["crash_rate"] * 1e6 / km, "ci_low": best["ci_low"] * 1e6 / km,
                                  "ci_high": best["ci_high"] * 1e6 / km},
        "estimates": found, "diagnostics": {"mean_weight_of_cut_ins": 3.1e-5, "p_cut_in": {"twin": 2.8e-5, "z": 0.4}},
        "convergence": _convergence(y), "statement": _statement(best, km, recipe.level),
    }  # fmt: skip


def _convergence(y: np.ndarray) -> list[dict[str, Any]]:
    sizes = np.unique(np.geomspace(min(100, len(y)), len(y), 40).astype(int))
    points = [{"n": int(n)} | _normal(y[:n]) for n in sizes]
    return [{key: p[key] for key in ("n", "crash_rate", "ci_low", "ci_high", "rhw", "n_crashes")} for p in points]


def _statement(best: dict[str, Any], km: float, level: float) -> str:
    if not best["crash_rate"]:
        return (
            f"No crash was seen in {best['n_episodes']:,} tests: the AV crashes less often than "
            f"{best['upper_bound']:.2e} times per test, with 90 % confidence, at lane-change level {level:g}."
        )
    return (
        f"The AV crashes {best['crash_rate']:.3g} times per overtaking test (90 % interval {best['ci_low']:.3g} to "
        f"{best['ci_high']:.3g}), that is {best['crash_rate'] * 1e6 / km:.3g} times per 1e6 km of such driving, at "
        f"lane-change level {level:g}."
    )
