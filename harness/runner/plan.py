"""What a campaign will cost, before it is run; an AV that is not built in is run for about a second to see."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.sections import Stop
from harness.controllers.find import AvEndedProcessError, build_host, run_apart
from harness.controllers.hosts import BatchHost, ControllerHost
from harness.controllers.protocol import BatchObservation
from harness.importance.build import needs_tables
from harness.pool.shells import acceleration_limit, design_shells
from harness.pool.storage import cached_pool
from harness.resolved import Resolved
from harness.runner.prepare import build_world, cached_files, require_ready
from harness.strata import ASSUMPTION_FREE
from harness.traffic.lateral import DISTANCE_M as OVERLAP_M
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import FloatArray, IntArray
from harness.worlds.protocol import AVLostError, DrivingWorld, World
from harness.worlds.shim import shim_library

EPISODES_PER_SECOND_PER_CORE = {
    "sumo": {"nde": 3500, "forced": 1500, "step_mixture": 1600, "episode_mixture": 2000, "shells": 1700},
    "sumo with shim": {"nde": 6000, "forced": 2500, "step_mixture": 2700, "episode_mixture": 3000, "shells": 2700},
    "twin": {"nde": 70000, "forced": 32000, "step_mixture": 25000, "episode_mixture": 18000, "shells": 30000},
}
"""Orders of magnitude, recording included, measured on one core of a 2020s server; `benchmarks/` measures yours."""
POOL_S = "about 15 s"
KB_PER_EPISODE = 0.2
KB_PER_MOMENT = 0.1
MOMENTS_PER_EPISODE = {"all": 70, "first_9": 9, "none": 0}

OVER_BOUND = 1.6
"""Tests that a rate takes, over the lower bound (measured: medians of the panel, 1.5 to 1.75)."""
USUAL_RHW = 0.3

MEASURED_S = 1.0
SLOW_TEST_S = 0.1
"""Time of a test from which on handing tests out one by one costs less than workers that wait (docs/performance.md)."""
MOST_AT_ONCE = 16
"""Controllers of one vehicle each that are asked between two looks at the clock."""
STEPS, STEPS_WITH_CUT_IN = 89, 185
"""Mean steps of a test without and with a cut-in, of the default IDM in 5,000 tests of `nde` and of `forced`."""
STEPS_ACTED = 162
"""Of the latter, those after the cut-in."""
_POSITION_M = np.array([700.0, 640.0, 600.0])
_SPEED_MPS = np.array([30.0, 28.0, 30.0])
"""LV, BV and AV at a cut-in as it may be: 35 m of gap, closing at 2 m/s."""


def plan_campaign(campaign: Campaign) -> dict[str, Any]:
    """Cost of a campaign that runs to its budget of episodes.

    Returns
    -------
    dict
        ``episodes``, ``episodes_per_second_estimate`` (all cores), ``seconds_estimate``, ``tables`` (in words) and
        ``disk_mb``; of an AV that is not built in ``av_ms_per_test``, measured, or in words why there is none. Where
        cut-ins take time, ``within_reach_of_`` each statement: which rates it can tell, in words.

    Raises
    ------
    CampaignError
        A run would refuse the campaign before it starts.
    """
    resolved = require_ready(campaign)
    engine = "sumo with shim" if campaign.world.engine == "sumo" and shim_library() else campaign.world.engine
    per_core: float = EPISODES_PER_SECOND_PER_CORE[engine][campaign.testing.method]
    of_av: dict[str, float | str] = {}
    if campaign.av.model is None:
        measured = seconds_per_test(campaign)
        of_av["av_ms_per_test"] = measured if isinstance(measured, str) else _rounded(1e3 * measured)
        if isinstance(measured, float):
            moved_by_sumo = campaign.av.source in ("sumo", "traci")
            per_core = 1.0 / (measured + (0.0 if moved_by_sumo else 1.0 / per_core))
            of_av |= _if_slow(measured, campaign)
    rate = _rounded(per_core * (os.cpu_count() or 1))
    moments = MOMENTS_PER_EPISODE[campaign.records.moments] if needs_tables(campaign) else 0
    episodes = campaign.stop.episodes
    return {
        "episodes": episodes,
        "episodes_per_second_estimate": rate,
        "seconds_estimate": round(episodes / rate),
        "tables": _tables(resolved),
        "disk_mb": round(episodes * (KB_PER_EPISODE + KB_PER_MOMENT * moments) / 1000.0, 1),
        **of_av,
        **_reach(resolved),
    }


def _if_slow(test_s: float, campaign: Campaign) -> dict[str, str]:
    """How many workers are fed where a test takes long."""
    task_s = test_s * campaign.run.smallest_shard
    if test_s < SLOW_TEST_S or campaign.run.shard_size == 1:
        return {}
    said = f"with run.shard_size 1 a task is one test of {test_s:.2g} s, and now up to {task_s:,.0f} s"
    if campaign.testing.method == "shells":
        said += "; testing.shells.smallest_round feeds so many workers from the first round on"
    return {"slow_av": said}


def _reach(resolved: Resolved) -> dict[str, str]:
    """Which rates statements can tell, where cut-ins take time and those of attentive vehicles are tiny."""
    campaign = resolved.campaign
    if not resolved.environment.lateral.present or campaign.testing.method != "shells" or campaign.has_shadow_runs:
        return {}
    if (pool := cached_pool(resolved)) is None:
        return {"within_reach": "known once the pool is built (harness pool)"}
    design = design_shells(pool, shells=campaign.testing.shells, limit_mps2=acceleration_limit(campaign.av))
    p = {ASSUMPTION_FREE: float(design.p.sum())}
    p |= {each.name: float(design.p[: each.n_inside].sum()) for each in design.statements}
    return {f"within_reach_of_{name}": _within_reach(at_stake, campaign.stop) for name, at_stake in p.items()}


def _within_reach(p: float, stop: Stop) -> str:
    """What can be said of a rate where cut-ins of probability ``p`` have to be shown not to crash.

    A rate to within ± r of itself needs some 1.6 ln(1/α) p/(2 r μ) tests: without an assumption p is that of all that
    the envelope reaches, inside a boundary that of its shells. (Lower bound ln(1/α) p/(2 r μ); the panel of
    docs/shells-validation.md took 1.5 to 1.75 times that.) Where cut-ins take time, the rate of an attentive vehicle
    falls by orders of magnitude, and that number of tests grows as its inverse; what remains is the upper limit
    ln(1/α) p/n.
    """
    rhw, n, nats = stop.rhw or USUAL_RHW, stop.episodes, math.log(1.0 / (1.0 - stop.confidence))
    smallest, limit = OVER_BOUND * nats * p / (2.0 * rhw * n), nats * p / n
    return (
        f"a rate to within ±{100.0 * rhw:.0f} % from some {smallest:.1e} per test on, with {n:,} tests; of a vehicle "
        f"that crashes less an upper limit, {limit:.1e} without a crash"
    )


def _rounded(value: float) -> float:
    """Two digits: more are not known."""
    return float(f"{value:.2g}")


def _tables(resolved: Resolved) -> str:
    campaign, files = resolved.campaign, cached_files(resolved)
    if not files:
        return "none needed"
    cached = all(file.is_file() for file in files)
    if campaign.testing.method != "shells":
        seconds = (5 if campaign.environment.acceleration_hold_s >= 0.5 else 40) * len(campaign.surrogates)
        return "cached" if cached else f"to build (about {seconds} s of one core)"
    what, make = "pool of cut-ins", "build"
    if campaign.has_shadow_runs:
        what, make = f"paths of {campaign.pool.shadow_paths:,} shadow runs", "choose"
    return f"{what}: " + ("cached" if cached else f"to {make} ({POOL_S} on two cores)")


class _FailedError(Exception):
    """The AV failed while it was measured."""


def seconds_per_test(campaign: Campaign) -> float | str:
    """Time (s) that the campaign's AV adds to a test on one core, the world's included where SUMO moves the AV.

    Returns
    -------
    float or str
        The time, or why there is none.
    """
    try:
        return run_apart(campaign.av, _measure, campaign)
    except AvEndedProcessError as error:
        return f"not known: {error.found}"


def _measure(campaign: Campaign, *, black_box: Path | None = None) -> float | str:
    host = build_host(campaign.av, n_cells=campaign.world.cells, seed=campaign.seed, black_box=black_box)
    try:
        if host is not None:
            return _of_host(host, campaign)
        return _of_world(build_world(campaign), campaign)
    except (_FailedError, AVLostError) as error:
        return f"not known: {error}"


def _of_host(host: ControllerHost, campaign: Campaign) -> float:
    n = campaign.world.cells if isinstance(host, BatchHost) else min(campaign.world.cells, MOST_AT_ONCE)
    n_steps = STEPS_ACTED
    if campaign.testing.method == "nde":
        n_steps = STEPS if host.acts_before_cut_in else 0  # cut-ins are rare there
    cells = np.arange(n)
    seen = [_observation(cells, k) for k in range(STEPS_ACTED)]

    def begin(episodes: IntArray) -> None:
        _require_success(host.start(cells, episodes, episodes))

    def step(k: int) -> None:
        _require_success(host.act(seen[k])[1])

    try:
        return n_steps * _seconds_per_step(begin, step, n) / n
    finally:
        host.close()


def _of_world(world: World, campaign: Campaign) -> float:
    n = world.n_cells
    cells, none = np.arange(n), np.zeros(n, np.int8)
    speed: FloatArray = np.tile(_SPEED_MPS, (n, 1))

    def begin(episodes: IntArray) -> None:
        if isinstance(world, DrivingWorld):
            world.announce(cells, episodes)
        world.place(cells, np.tile(_POSITION_M, (n, 1)), speed)

    def step(k: int) -> None:
        world.step(speed, none + (k == 0))

    n_steps = STEPS if campaign.testing.method == "nde" else STEPS_WITH_CUT_IN
    try:
        return n_steps * _seconds_per_step(begin, step, n) / n
    finally:
        world.close()


def _seconds_per_step(begin: Callable[[IntArray], None], step: Callable[[int], None], n: int) -> float:
    """Time of a step of n cells, a share of what beginning a test takes included; what comes first warms up."""
    begin(np.arange(n))
    step(0)
    n_steps, began = 0, time.perf_counter()
    while True:
        begin(np.arange(n) + n * (1 + n_steps))
        for k in range(STEPS_ACTED):
            step(k)
            n_steps += 1
            elapsed_s = time.perf_counter() - began
            if elapsed_s > MEASURED_S:
                return elapsed_s / n_steps


def _observation(cells: IntArray, k: int) -> BatchObservation:
    """Step ``k`` of tests in which all keep their speeds."""
    lv, bv, av = _POSITION_M + k * STEP_S * _SPEED_MPS
    v_lv, v_bv, v_av = _SPEED_MPS
    gap = max(bv - VEHICLE_LENGTH_M - av, 1.0)
    real = [k * STEP_S, av, v_av, 0.0, gap, v_bv, bv, v_bv, lv, v_lv]
    columns = [np.full(cells.size, value) for value in real]
    overlaps = np.full(cells.size, OVERLAP_M), np.zeros(cells.size), np.ones_like(cells)
    return BatchObservation._make([cells, cells, *columns[:8], np.zeros_like(cells), *columns[8:], *overlaps])


def _require_success(failures: dict[int, str]) -> None:
    for cause in failures.values():
        raise _FailedError(cause)
