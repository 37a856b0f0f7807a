"""The alarm that weights, traffic and pool of a run do not belong together (`python -m studies alarm RUN`).

The stored maneuvers determine LV's and BV's motion, so that any surrogate k of a pool can be put in the AV's place, in
the twin; where the AV's crash ended an episode early, BV goes on under p with the episode's own random numbers. f_k
says whether it would have crashed, and W f_k has mean μ_k whatever the tests were drawn from and whatever the AV is.
μ_k is tested by bets (I. Waudby-Smith, A. Ramdas, JRSS B 86, 2024; why nothing is taken from the sample's variance:
docs/internals/validation.md): a capital of 1 is multiplied in every test by a factor of mean 1 if μ_k is right. So has
the product, which then exceeds 1/p with a probability of p at most, after any number of tests and for any weights.

* Too many crashes: (1 + λ W f_k)/(1 + λ μ_k).
* Too few: exp(-λ W f_k) over its mean, which is at most 1 - (μ_k/c)(1 - exp(-λc)) where W f_k has the mean square cμ_k
  at most (Jensen's inequality; it makes W. Hoeffding's, JASA 58, 1963, out of a mean square instead of a bound). With
  forced cut-ins at a share α_0, W is P(cut-in | path)/α_0 at most, and the pool knows its mean where surrogates crash.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
from scipy.special import logsumexp

from harness.campaign.files import load_campaign
from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.errors import MEND_PART, HarnessError, RunFolderError
from harness.estimators.block import EPISODE_COLUMNS, Block, Drawn, block_from_tables
from harness.estimators.estimate import finite_json
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.path import Trajectory, empty_trajectory, end_in, walk, who_crashes
from harness.families.cut_in.replay import StoredPaths, leave_stored, recall
from harness.families.cut_in.script import maneuvers_of, states_of
from harness.pool.build import campaign_pool
from harness.pool.kept import Pool
from harness.processes import made_ahead
from harness.progress import Progress
from harness.records.folder import Part, read_kept, read_manifest
from harness.records.schemas import LEAD, chosen_from, path_columns
from harness.resolved import Resolved, resolve
from harness.vehicles.drivers import Followers
from harness.vocabulary import CONTACT, FAILED, PASSED, RUNNING, BoolArray, FloatArray, IntArray


@compiled_inline
def approach(i: int, until: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> tuple[int, int]:
    """LV's and BV's stored motion to a step or a decision without cut-in; how it is decided, and the step.

    `FAILED` where fewer maneuvers are stored than that takes.
    """
    known = recall(i, stored, path)
    reach = min(until, known * environment.numbers.hold_steps, environment.numbers.max_steps)
    step = walk(stored.state[i], stored.seed, stored.episode[i], known, reach, True, environment, path)
    decided = end_in(step, path)
    return FAILED if decided == RUNNING and step < until else decided, step


@compiled_inline
def approach_cut_in(i: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> tuple[int, int]:
    """`approach` through the step of the stored cut-in: BV may touch LV before it has left the lane."""
    cut = stored.cut_step[i]
    decided, step = approach(i, cut + 1, stored, environment, path)
    if decided == PASSED and step == cut + 1:  # beside the AV on its own lane: that is for the AV to answer
        return RUNNING, step
    return decided, step


@compiled_threads
def replay_surrogates(
    stored: StoredPaths, environment: Environment, followers: Followers, path: Trajectory, crashes: IntArray
) -> int:
    """Which drivers would have crashed in each stored episode of an AV that keeps its speed until the cut-in.

    ``crashes`` (n,) receives one bit per driver, none without a cut-in; ``path`` is room to work in. Returns the row
    of the first episode whose maneuvers do not fit its steps, or -1.
    """
    max_steps = environment.numbers.max_steps
    for i in range(stored.cut_step.size):
        crashes[i] = 0
        cut = stored.cut_step[i]
        if cut < 0:
            continue
        decided, step = approach_cut_in(i, stored, environment, path)
        if decided == CONTACT and step == cut + 1:
            continue
        if decided != RUNNING or not leave_stored(i, max_steps, stored, environment, path):
            return i
        crashes[i] = who_crashes(followers, cut, stored.script.lead[i], environment, path)
    return -1


def stored_paths(episodes: pa.Table, seed: int) -> StoredPaths:
    """Initial states and maneuvers of rows of the episodes table; needs `path_columns`."""
    chosen = chosen_from(episodes, CUT_IN)
    index, n_steps = (np.asarray(episodes.column(name)).astype(np.int64) for name in ("episode", "n_steps"))
    return StoredPaths(seed, index, states_of(chosen.facts), n_steps, chosen.at, maneuvers_of(chosen))


def drivers_crash(episodes: pa.Table, seed: int, environment: Environment, followers: Followers) -> BoolArray:
    """Which drivers (D,) would have crashed in the place of the AV, shape (n, D).

    ``episodes`` are consecutive rows of the episodes table, with `path_columns`; ``seed`` is that of the campaign.

    Raises `RunFolderError`: an episode's maneuvers do not fit its steps.
    """
    stored, bits = stored_paths(episodes, seed), np.zeros(episodes.num_rows, np.int64)
    room = empty_trajectory(environment)
    wrong = replay_surrogates(unboxed(stored), unboxed(environment), unboxed(followers), unboxed(room), bits)
    if wrong >= 0:
        at, step = f"episodes, episode {stored.episode[wrong]}", stored.cut_step[wrong]
        expected = "the maneuvers that were driven: they determine the episode"
        raise RunFolderError(at, f"maneuvers that do not lead to a cut-in in step {step}", expected, MEND_PART)
    found: BoolArray = ((bits[:, None] >> np.arange(followers.drivers.size)) & 1).astype(np.bool_)
    return found


def surrogates_crash(episodes: pa.Table, resolved: Resolved, pool: Pool) -> BoolArray:
    """`drivers_crash` of a pool's surrogates, in its order, shape (n, D)."""
    environment, names = resolved.environment, list(pool.library.surrogates)
    followers = pool.library.followers(environment.lateral.present)
    crashes = drivers_crash(episodes, resolved.campaign.seed, environment, followers)
    return crashes[:, [names.index(name) for name in pool.names]]


LEVEL = 1e-4
"""Probability of a false alarm, at most, after any given number of tests."""
BETS = 2.0 ** -np.arange(1.0, 25.0)
"""λ μ_k of the bets, whose capitals are averaged. The best λ is within a factor of 1.5 of one of them, which costs a
tenth of its growth; smaller ones would win nothing below 1e8 tests."""
_UNBOUNDED = "weights of the step mixture are not bounded: rare large ones may be missing, so that nothing is concluded"


class KnownRates(NamedTuple):
    """Crash rates ``mu`` (D,) of surrogates as a pool knows them, from conservative to aggressive.

    ``std_error`` (D,) is that of ``mu``; ``p_event_at_crash`` (D,) the mean P(cut-in | path) of the cut-ins on which
    each crashes, at most.
    """

    names: tuple[str, ...]
    mu: FloatArray
    std_error: FloatArray
    p_event_at_crash: FloatArray

    @classmethod
    def of(cls, pool: Pool) -> KnownRates:
        """Those of a pool."""
        return cls(pool.names, pool.mu, np.sqrt(np.diag(pool.mu_covariance)), pool.p_event_at_crash)


class Alarm:
    """Sums of the surrogates' weighted crashes W f_k, arrays of shape (D,), and of log(1 + λ W f_k), (bets, D)."""

    def __init__(self, known: KnownRates) -> None:
        self._known, d = known, known.mu.size
        self._drawn = Drawn("nde")  # that of the first block
        self._n = self._n_lost = 0
        self._hits, self._sum, self._squares = np.zeros((3, d))
        self._won = np.zeros((BETS.size, d))
        # Rates that bets are measured in; infinite where there is none, and then nothing is bet.
        self._unit = np.where(known.mu > 0.0, known.mu, np.inf)

    def add(self, block: Block, crashes: BoolArray) -> None:
        """Add one block, and which surrogates would have crashed in its tests (n, D)."""
        h = np.where(crashes, block.weights()[:, None], 0.0)
        self._drawn = block.drawn
        self._n += len(block)
        self._n_lost += int(np.count_nonzero(block.failed & ~block.happened))
        self._hits += np.count_nonzero(h, axis=0)
        self._sum += h.sum(axis=0)
        self._squares += (h * h).sum(axis=0)
        relative = h / self._unit
        self._won += [np.log(1.0 + bet * relative).sum(axis=0) for bet in BETS]

    def result(self) -> dict[str, Any]:
        """Means against known rates, and whether the alarm is raised."""
        known, drawn, log_capital = self._known, self._drawn, self._log_capital()
        p_value = _p_value(float(logsumexp(log_capital)) - math.log(log_capital.size))
        no_verdict = _UNBOUNDED if drawn.method == "step_mixture" else None
        if no_verdict is None and self._n_lost:
            lost = "failed tests have no cut-in, and what surrogates would have done in them is not known"
            no_verdict = f"{self._n_lost} {lost}"
        columns = {
            "surrogate": known.names,
            "n_crashes": self._hits.astype(int),
            "n_effective": self._sum**2 / np.where(self._squares > 0.0, self._squares, np.inf),
            "mean": self._sum / self._n,
            "mu": known.mu,
            "mu_std_error": known.std_error,
            "p_value": list(map(_p_value, log_capital.tolist())),
        }
        return {
            "raised": no_verdict is None and p_value <= LEVEL,
            "no_verdict": no_verdict,
            "n_episodes": self._n,
            "p_value": p_value,
            "surrogates": pd.DataFrame(columns).to_dict("records"),
        }

    def _log_capital(self) -> FloatArray:
        """Log of the mean capital of all bets on each surrogate, shape (D,).

        The pool's own error of μ_k is taken as normal. The log of each product then has a normal error too, and half
        its variance is what that adds to the log of the product's mean.
        """
        n, unit, bets, known, drawn = self._n, self._unit, BETS[:, None], self._known, self._drawn
        # Mean square of W f_k over its mean, at most; infinite where nothing bounds W.
        at_crash = known.p_event_at_crash / drawn.forced_share if drawn.forced_share else np.inf
        heavy = np.maximum((at_crash if drawn.weight_cap is None else drawn.weight_cap) / unit, 1.0)
        error = known.std_error / unit
        many, few = bets, np.expm1(-bets * heavy) / heavy  # mean factors are 1 + these, their errors these times μ_k's
        won = np.stack([self._won, -bets * self._sum / unit])
        gain = np.stack([np.broadcast_to(many, few.shape), few]) * (known.mu > 0.0)
        price = n * np.log1p(gain) + 0.5 * (n * gain * error / (1.0 + gain)) ** 2
        found: FloatArray = logsumexp(won - price, axis=(0, 1)) - math.log(2 * BETS.size)
        return found


def _p_value(log_capital: float) -> float:
    """Probability of so much capital, at most (Markov); never 0, which no test can show."""
    return max(math.exp(-max(log_capital, 0.0)), sys.float_info.min)


def alarm_of_run(folder: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Ask the surrogates of the campaign's pool about all tests that a run has on record.

    Raises `HarnessError`: the folder is not a run, or its records are damaged or do not allow it.
    """
    progress, manifest = progress or Progress(), read_manifest(folder)
    resolved = resolve(load_campaign(folder / "campaign.yaml", check_files=False))
    campaign = resolved.campaign
    if (shells := campaign.testing.method == "shells") or campaign.av.acts_before_event:
        found = "tests drawn from shells" if shells else "an AV that acted before the cut-in"
        expected = "weighted tests of an AV that keeps its speed until the cut-in: pools know rates of surrogates then"
        mend = "Choose another run; SUMO's positions are held against the twin's in each step."
        raise HarnessError(str(folder), found, expected, mend)
    pool = campaign_pool(resolved, progress)
    alarm = Alarm(KnownRates.of(pool))
    lead = [LEAD] if resolved.environment.lateral.present else []
    columns = [*dict.fromkeys([*EPISODE_COLUMNS, *path_columns(CUT_IN), *lead])]

    def replayed(part: Part) -> tuple[Block, BoolArray]:
        episodes = read_kept(folder, part, "episodes", columns)
        block = block_from_tables(campaign, episodes)
        return block, surrogates_crash(episodes, resolved, pool)

    progress.stage("surrogates in the AV's place", manifest["n_episodes"])
    for block, crashes in made_ahead(replayed, manifest["parts"]):
        alarm.add(block, crashes)
        progress.advance(len(block))
    return finite_json({"run": str(folder), "pool": pool.key, **alarm.result()})
