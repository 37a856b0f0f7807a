"""An environment beside what is published about cut-ins and lane changes (`published.yaml`), with pass or fail.

Where a figure comes from traffic unlike the scenario's, whose tests begin with an AV that closes in by 5 to 10 m/s, its
conditions are taken: the law of acceptance is asked at the closing speeds that were seen, of gaps that are equally
likely up to the sensor's view. What depends on the scenario is asked of naturalistic paths.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml
from scipy import stats
from scipy.optimize import brentq

from harness.campaign.sections import EnvironmentSettings
from harness.estimators.estimate import finite_json
from harness.families.cut_in.events import write_maneuvers
from harness.families.cut_in.laws import Environment, InitialStates
from harness.families.cut_in.loading import evaluate_laws, load_environment
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2
from harness.families.protocol import Paths
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import BV, LV, FloatArray

PUBLISHED = Path(__file__).with_name("published.yaml")
N_PATHS, SEED = 4096, 1
BOUND = "not_looking_bound_percent"


def beside_published(environment: str) -> list[dict[str, Any]]:
    """Rows of an environment (shipped name or file): each figure, the model's number, and whether it passes."""
    loaded = load_environment(EnvironmentSettings(parameters=environment))
    table, rows = yaml.safe_load(PUBLISHED.read_text(encoding="utf-8")), list[dict[str, Any]]()
    approach = SimpleNamespace(**table["approach"])
    found = {**_leads(loaded), **_kept(loaded, approach), **_scenario(loaded, approach)}
    for figure in table["figures"]:
        value, verdict, within = found[figure.pop("model")], "-", None
        if "within" in figure:
            within = [found.get(end, end) for end in figure["within"]]
            verdict = "pass" if within[0] <= value <= within[1] else "fail"
        rows.append(finite_json(figure | {"model": value, "within": within, "verdict": verdict}))
    return rows


def _leads(environment: Environment) -> dict[str, float]:
    """Quantiles of the time from onset to overlap, of twice that, and of the lateral speed."""
    (distance_m, cumulative), lead = environment.lateral, dict.fromkeys((1, 5, 50, 95), 0.0)
    if environment.lateral.present:
        upto_s = STEP_S * (np.arange(cumulative.size) + 0.5)
        lead = {percent: float(np.interp(percent / 100, cumulative, upto_s)) for percent in lead}
    speed = {percent: distance_m / lead[100 - percent] if lead[50] else np.inf for percent in (50, 95, 99)}
    found = {f"lead_p{p}_s": lead_s for p, lead_s in lead.items()} | {"duration_p50_s": 2.0 * lead[50]}
    return found | {f"lateral_p{p}_mps": speed_mps for p, speed_mps in speed.items()}


def _kept(environment: Environment, approach: SimpleNamespace) -> dict[str, float]:
    """The law of acceptance at published closing speeds, with equally likely gaps up to the sensor's view."""
    low, high = approach.closing_mps
    sd = (high - low) / (2.0 * stats.norm.isf(0.05))
    closing = stats.norm.ppf((np.arange(200) + 0.5) / 200, 0.5 * (low + high), sd)
    longest = approach.headway_s * approach.speed_mps
    gaps = longest * (np.arange(240) + 0.5) / 240
    pairs = np.column_stack([np.tile(gaps, closing.size), np.repeat(-closing, gaps.size)])
    accepted = evaluate_laws(environment, np.empty((0, 3)), pairs).accepted.reshape(closing.size, gaps.size)
    share = accepted / accepted.sum(1, keepdims=True)
    headway = np.cumsum(share.mean(0))
    quantile = {f"headway_p{p}_s": float(np.interp(p / 100, headway, gaps)) / approach.speed_mps for p in (5, 50, 95)}
    below = (gaps < approach.ttc_s * closing[:, None])[closing > 0.0]
    looks = evaluate_laws(environment, np.empty((0, 3)), np.array([[1e-3, -1.0]])).accepted[0]
    of_lookers = np.maximum(accepted - looks, 0.0)[closing > 0.0] / (1.0 - looks)

    def ttc_below(not_looking: float) -> float:
        each = not_looking + (1.0 - not_looking) * of_lookers
        return float(((each * below).sum(1) / each.sum(1)).mean())

    bound = 1.0 - 0.05 ** (1.0 / approach.n_closing)
    most = brentq(lambda i: ttc_below(i) - bound, 0.0, 1.0) if ttc_below(1.0) > bound > ttc_below(0.0) else np.nan
    return {
        **quantile,
        "ttc_below_percent": 100.0 * ttc_below(looks),
        "not_looking_percent": 100.0 * float(looks),
        BOUND: 100.0 * float(most),
    }


def _scenario(environment: Environment, approach: SimpleNamespace) -> dict[str, float]:
    """Cut-ins of naturalistic paths whose AV keeps its speed, and lane changes per km where nobody is behind."""
    index = np.arange(N_PATHS)
    start = InitialStates(environment.numbers).draw(SEED, 0, N_PATHS)
    script = write_maneuvers(SEED, Paths(index, start), np.full(N_PATHS, -1), environment)
    hold, n_steps = int(environment.numbers["hold_steps"]), int(environment.numbers["max_steps"])
    initial = {LV: np.maximum(start["v_bv_mps"] + start["r1dot_mps"], 0.0), BV: start["v_bv_mps"]}
    x, v = {}, {}
    for vehicle, maneuvers in ((LV, script.lv), (BV, script.bv)):
        steps = STEP_S * np.repeat(ACCELERATIONS_MPS2[maneuvers], hold, axis=1)[:, :n_steps]
        speed = np.maximum(initial[vehicle][:, None] + np.cumsum(steps, axis=1), 0.0)
        v[vehicle] = np.column_stack([initial[vehicle], speed])
        driven = np.cumsum(0.5 * STEP_S * (v[vehicle][:, 1:] + v[vehicle][:, :-1]), axis=1)
        x[vehicle] = np.column_stack([np.zeros(N_PATHS), driven])
    v_av = (start["v_bv_mps"] - start["r2dot_mps"])[:, None]
    r1 = start["r1_m"][:, None] + x[LV] - x[BV]
    r2 = start["r2_m"][:, None] + x[BV] - v_av * STEP_S * np.arange(n_steps + 1)
    real = np.logical_and.accumulate((r1 > 0.0) & (np.arange(n_steps + 1) < hold * script.n_bv[:, None]), axis=1)
    every = np.s_[:, ::hold]  # decisions are per second
    there = real[every]
    states = np.column_stack([each[every][there] for each in (v[BV], r1, v[LV] - v[BV])])
    behind = np.column_stack([each[every][there] for each in (r2, v[BV] - v_av)])
    *_, wished, accepted = evaluate_laws(environment, states, behind)
    beside = behind[:, 0] > 0.0
    weight, gap, closing = (wished * accepted)[beside], behind[beside, 0], -behind[beside, 1]
    headway = gap / (states[beside, 0] + closing)
    seen = (closing > 0.0) & (headway < approach.headway_s)
    order = np.argsort(closing)
    return {
        "scenario_ttc_below_percent": 100.0 * _share(weight[seen], (gap < approach.ttc_s * closing)[seen]),
        "scenario_closing_percent": 100.0 * _share(weight, closing > 0.0),
        "scenario_closing_p50_mps": float(np.interp(0.5, np.cumsum(weight[order]) / weight.sum(), closing[order])),
        "lane_changes_per_km": float(1e3 * wished.sum() / states[:, 0].sum()),
    }


def _share(weight: FloatArray, of: FloatArray) -> float:
    return float(weight @ of / weight.sum())
