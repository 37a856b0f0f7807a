"""The paper's three theorems, by enumeration of all episodes of small chains: known exactly, not sampled.

Theorem 1 says that the mean stays μ, Theorem 2 bounds the variance with the best control parameters, and Theorem 3
promises none at all under four assumptions. All three are about columns whose means θ_l are *known*; what becomes of
the third when Algorithm 1 estimates them is drawn beside it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from harness.estimators.scv import MixtureCv, Scv
from harness.vocabulary import BoolArray, FloatArray
from studies.case_study.figures import exactly
from studies.case_study.study import Context, Theorems
from studies.chains.chain import DECISIVE, Chain, Episodes, enumerate_episodes, overtaking
from studies.chains.sampler import with_optimal_function


def small_chains() -> list[Chain]:
    """Chains of which all episodes can be listed."""
    return [
        overtaking("right and wrong", skill=0.6, surrogates=[0.6, 0.2], level=0.05, horizon=4),
        overtaking("all wrong", skill=0.9, surrogates=[0.1, 0.3], level=1e-4, horizon=4),
        DECISIVE[1],
    ]


def check_theorems(step: Theorems, context: Context) -> dict[str, Any]:
    """Exact means, variances and bounds of chains; estimates with known and with estimated means."""
    chains, found = [_chain(chain) for chain in small_chains()], list[tuple[float, float, float]]()
    world = with_optimal_function()
    context.progress.stage("theorem 3", step.draws)
    for k in range(step.draws):
        maneuver = world.maneuvers(step.tests, np.random.default_rng([1, k]))
        cv, scv = MixtureCv(), Scv()
        cv.add(world.block("episode_mixture", maneuver))
        scv.add(world.block("step_mixture", maneuver))
        known, estimated = cv.result(context.confidence), scv.result(context.confidence)
        found.append((known.crash_rate, estimated.crash_rate, estimated.std_error))
        context.progress.advance(1)
    known_means, estimated_means, claimed = np.transpose(found) / world.crash_rate
    return {
        "chains": chains,
        "figures": {
            "largest_bias": exactly(max(abs(mean - 1.0) for chain in chains for mean in chain["means"].values())),
            "variance_over_bound": exactly(max(chain["best"] / chain["bound"] for chain in chains)),
            "best_over_plain": exactly(max(chain["best"] / chain["plain"] for chain in chains)),
            "largest_error_known": exactly(float(np.max(np.abs(known_means - 1.0)))),
            "claimed_error_estimated": exactly(float(np.max(claimed))),
            "scatter_estimated": exactly(float(np.std(estimated_means))),
        },
    }


def _chain(chain: Chain) -> dict[str, Any]:
    """Exact results of a chain under the step mixture with equal weights; variances per test over μ²."""
    episodes = enumerate_episodes(chain)
    sampled = episodes.p * episodes.mixture
    y = episodes.crash / episodes.mixture
    mean = float(sampled @ y)
    plain = float(sampled @ (y - mean) ** 2)
    products = [within * each for within, ratios in _products(episodes) for each in ratios]
    columns = np.column_stack(products) / episodes.mixture[:, None]  # of every stratum, 0 outside of it
    columns -= sampled @ columns  # θ, exactly
    root = np.sqrt(sampled)[:, None]
    beta = np.linalg.lstsq(root * columns, root[:, 0] * (y - mean))[0]
    best = float(sampled @ (y - mean - columns @ beta) ** 2)
    square = mean * mean
    choices = {"plain": 0.0 * beta, "best": beta, "any": np.cos(np.arange(len(beta))) * mean}
    means = {name: float(sampled @ (y - columns @ each)) / chain.crash_rate for name, each in choices.items()}
    return {
        "chain": chain.name,
        "means": means,
        "plain": plain / square,
        "best": best / square,
        "bound": bound(episodes) / square,
    }


def _products(episodes: Episodes) -> Iterator[tuple[BoolArray, FloatArray]]:
    """By number of steps l ≥ 1, which episodes have so many (k,), and q_{j1…jl}/p of all choices (J^l, k)."""
    steps = [episodes.ratios[:, t].T for t in range(episodes.ratios.shape[1])]
    for level in range(1, len(steps) + 1):
        chosen = (np.prod(one, axis=0) for one in product(*steps[:level]))
        yield episodes.n_control_steps == level, np.array(list(chosen))


def bound(episodes: Episodes) -> float:
    """Right-hand side of Theorem 2 with equal weights."""
    uncontrolled = episodes.crash * (episodes.n_control_steps == 0)
    mean = float(episodes.p @ uncontrolled)
    total = float(episodes.p @ (uncontrolled - mean) ** 2)
    for within, ratios in _products(episodes):
        p, crash, ratio = episodes.p[within], episodes.crash[within], ratios[:, within]
        mu, inverse = float(p @ crash), float(len(ratios))  # 1/α of each choice
        variances = np.sum(p * ratio * (crash / ratio - mu) ** 2, axis=1)
        total += float(variances.min()) * inverse + 3.0 * (mu * inverse) ** 2
    return total * (int(episodes.n_control_steps.max()) + 1)
