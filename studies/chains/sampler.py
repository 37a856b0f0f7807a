"""Draw episodes of a chain by any method, vectorised, and hand them over as the Block that SUMO's records become."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from harness.estimators.block import MAX_CONTROL_STEPS, Block, SamplingPlan
from harness.vocabulary import CRASH, TIMEOUT, BoolArray, FloatArray, IntArray, Method
from studies.chains.chain import Chain

DEFENSIVE_SHARE = 0.1
Seen = tuple[BoolArray, FloatArray]
"""Whether a step is critical (m,), and C_j of its maneuvers (J, m, A)."""


def mixture_weights(chain: Chain, method: Method) -> FloatArray:
    """Weights of the importance functions, with the forced cut-in as component 0 of the episode mixture, shape (M,)."""
    equal = np.full(chain.n_surrogates, 1.0 / chain.n_surrogates)
    if method == "episode_mixture":
        return np.concatenate([[DEFENSIVE_SHARE], (1.0 - DEFENSIVE_SHARE) * equal])
    return {"nde": np.empty(0), "forced": np.ones(1)}.get(method, equal)


def draw(chain: Chain, method: Method, n: int, rng: np.random.Generator, *, first_episode: int = 0) -> Block:
    """Draw n episodes."""
    return Sampler(chain, method, n, rng).run(first_episode)


def approach_paths(chain: Chain, n: int, rng: np.random.Generator) -> IntArray:
    """States that staying would pass through, shape (n, T); no vehicle under test is involved."""
    path = np.empty((n, chain.horizon), dtype=np.int64)
    path[:, 0] = _choose(np.broadcast_to(chain.start, (n, len(chain.start))), rng)
    for t in range(1, chain.horizon):
        path[:, t] = _choose(chain.approach[path[:, t - 1]], rng)
    return path


def _choose(p: FloatArray, rng: np.random.Generator) -> IntArray:
    """Index drawn from each row of probabilities (m, A), shape (m,)."""
    u = rng.random(len(p))
    chosen: IntArray = np.minimum((np.cumsum(p, axis=1) <= u[:, None]).sum(axis=1), p.shape[1] - 1)
    return chosen


class Sampler:
    """Episodes on their way: path before the cut-in ahead, then maneuvers and responses step by step."""

    def __init__(self, chain: Chain, method: Method, n: int, rng: np.random.Generator) -> None:
        self.chain, self.method, self.rng = chain, method, rng
        self.alpha = mixture_weights(chain, method)
        self.path = approach_paths(chain, n, rng)
        stay = np.log1p(-chain.hazard[self.path])
        self.p_cut_later = -np.expm1(np.cumsum(stay[:, ::-1], axis=1)[:, ::-1])
        self.component = rng.choice(len(self.alpha), size=n, p=self.alpha) if len(self.alpha) else np.empty(0, np.int64)
        self.log_p_cut = np.log(np.maximum(self.p_cut_later[:, 0], np.finfo(float).tiny))
        self.log_ratio = np.zeros((n, chain.n_surrogates))
        self.log_step, self.log_forced = np.zeros((2, n))
        self.martingale = np.zeros((n, chain.n_surrogates))
        self.ratios = np.ones((n, MAX_CONTROL_STEPS, chain.n_surrogates))
        self.n_control = np.zeros(n, dtype=np.int64)
        self.after = np.full(n, -1)
        self.cut_in = np.zeros(n, dtype=bool)

    def run(self, first_episode: int) -> Block:
        """Draw them to their end."""
        for t in range(self.chain.horizon):
            after = np.flatnonzero(self.cut_in & (self.after < self.chain.crashed - 1))
            self._step_before(t, np.flatnonzero(~self.cut_in))
            self._step_after(t, after)
        log_q, log_weight, cap = self.log_ratio, self.log_step, self.chain.cut_in_cap
        if self.method != "step_mixture":
            forced = np.where(self.cut_in, -self.log_p_cut, -np.inf)
            log_q = np.column_stack([forced, log_q])[:, : len(self.alpha)]
        columns = {"happened": self.cut_in, "log_q": log_q, "n_control_steps": self.n_control}
        columns["martingale"] = self.martingale
        if self.method == "step_mixture":
            columns["first_ratios"] = self.ratios
        if self.method in ("forced", "episode_mixture"):
            columns["log_p_event"] = self.log_p_cut
            log_weight = -logsumexp(log_q + np.log(self.alpha), axis=1)
            log_weight[np.isinf(log_weight)] = 0.0  # a forced cut-in that could not be
        outcome = np.where(self.after == self.chain.crashed, CRASH, TIMEOUT).astype(np.int8)
        weight_cap = {"nde": 1.0, "forced": cap, "episode_mixture": cap / DEFENSIVE_SHARE}.get(self.method)
        return Block(first_episode, outcome, log_weight, columns, SamplingPlan(self.method, self.alpha, weight_cap))

    def _step_before(self, t: int, rows: IntArray) -> None:
        chain, state = self.chain, self.path[rows, t]
        p = np.stack([1.0 - chain.hazard[state], chain.hazard[state]], axis=1)
        q_cut = chain.proposals.cut[:, t, state].T
        q = np.stack([1.0 - q_cut, q_cut], axis=2)
        later = self.p_cut_later[rows, t]
        forced_cut = np.divide(p[:, 1], later, out=np.zeros(len(rows)), where=later > 0.0)
        forced = np.stack([1.0 - forced_cut, forced_cut], axis=1)
        seen = chain.proposals.critical_before[t, state], self.challenge(t)[0][:, state]
        cut = self._maneuver(rows, p, q, forced, seen) == 1
        self.after[rows[cut]] = _choose(chain.entry[state[cut]], self.rng)

    def _step_after(self, t: int, rows: IntArray) -> None:
        chain, state = self.chain, self.after[rows]
        p = chain.exposure[state]
        q = np.moveaxis(chain.proposals.maneuver[:, t, state], 0, 1)
        seen = chain.proposals.critical_after[t, state], self.challenge(t)[1][:, state]
        maneuver = self._maneuver(rows, p, q, p, seen)
        self.after[rows] = _choose(chain.response[state, maneuver], self.rng)

    def challenge(self, t: int) -> tuple[FloatArray, FloatArray]:
        """C_j before and after the cut-in, shapes (J, G, 2) and (J, D, A)."""
        return self.chain.proposals.challenge_before[:, t], self.chain.proposals.challenge_after[:, t]

    def predicted(self, p: FloatArray, challenge: FloatArray) -> FloatArray:
        """V_j = Σ_a p(a) C_j(a) of each row, shape (m, J); p (m, A), challenge (J, m, A)."""
        return np.asarray(np.einsum("ma,jma->mj", p, challenge))

    def weight(self, rows: IntArray) -> FloatArray:
        """W so far, shape (m,)."""
        if self.method == "step_mixture":
            return np.exp(self.log_step[rows])
        log_q = np.column_stack([self.log_forced[rows], self.log_ratio[rows]])
        return np.asarray(np.exp(-logsumexp(log_q + np.log(self.alpha), axis=1)))

    def _maneuver(self, rows: IntArray, p: FloatArray, q: FloatArray, forced: FloatArray, seen: Seen) -> IntArray:
        """Draw from what the method says and keep the likelihood ratios; p (m, A), q (m, J, A)."""
        (critical, challenge), sampled = seen, p
        if self.method == "step_mixture":
            sampled = np.where(critical[:, None], np.einsum("mja,j->ma", q, self.alpha), p)
        elif self.method != "nde":
            candidates = np.concatenate([forced[:, None, :], q], axis=1)
            sampled = candidates[np.arange(len(rows)), self.component[rows]]
        chosen = _choose(sampled, self.rng)
        self.cut_in[rows] |= (self.after[rows] < 0) & (chosen == 1)
        if self.method in ("nde", "forced"):
            return chosen
        at, every = np.flatnonzero(critical), np.arange(len(rows))
        before = self.weight(rows)[:, None]
        with np.errstate(divide="ignore"):
            self.log_forced[rows] += np.log(forced[every, chosen] / p[every, chosen])
        picked_p, picked_q = p[at, chosen[at]], q[at, :, chosen[at]]
        episode = rows[at]
        self.log_ratio[episode] += np.log(picked_q / picked_p[:, None])
        if self.method == "step_mixture":
            mixed = picked_q @ self.alpha
            step = self.n_control[episode]
            self.log_step[episode] += np.log(picked_p / mixed)
            kept = step < MAX_CONTROL_STEPS
            self.ratios[episode[kept], step[kept]] = (picked_q / mixed[:, None])[kept]
        self.n_control[episode] += 1
        terms = self.weight(rows)[:, None] * challenge[:, every, chosen].T - before * self.predicted(p, challenge)
        self.martingale[episode] += terms[at]
        return chosen


@dataclass(frozen=True, eq=False)
class SingleChoice:
    """Maneuvers with exposure p (A,), which of them crash (A,), importance functions (M, A) and weights (M,)."""

    p: FloatArray
    crash: BoolArray
    q: FloatArray
    alpha: FloatArray

    @property
    def crash_rate(self) -> float:
        """μ."""
        return float(self.p @ self.crash)

    def maneuvers(self, n: int, rng: np.random.Generator) -> IntArray:
        """Drawn from the mixture."""
        return rng.choice(len(self.p), size=n, p=self.alpha @ self.q)

    def block(self, method: Method, maneuver: IntArray) -> Block:
        """Episodes with given maneuvers."""
        n = len(maneuver)
        with np.errstate(divide="ignore"):
            log_q = np.log(self.q[:, maneuver] / self.p[maneuver]).T
        log_weight = np.log(self.p / (self.alpha @ self.q))[maneuver]
        ratios = np.ones((n, 9, len(self.alpha)))
        ratios[:, 0] = np.exp(log_q + log_weight[:, None])
        columns = {"happened": np.ones(n, np.bool_), "log_q": log_q, "n_control_steps": np.ones(n, np.int64)}
        outcome = np.where(self.crash[maneuver], CRASH, TIMEOUT).astype(np.int8)
        return Block(0, outcome, log_weight, {**columns, "first_ratios": ratios}, SamplingPlan(method, self.alpha))


def with_optimal_function(tilt: float = 1.0) -> SingleChoice:
    """Five maneuvers, two crash; q_1 is p given a crash, the others are p and one that is wholly wrong.

    A `tilt` other than 1 makes q_1 prefer one of the crashing maneuvers, so that it is only nearly optimal.
    """
    p = np.array([0.6, 0.39, 9.5e-3, 4e-4, 1e-4])
    crash = np.array([False, False, False, True, True])
    tilted = p * crash * np.array([1.0, 1.0, 1.0, 1.0, tilt])
    wrong = np.array([0.1, 0.5, 0.3, 0.02, 0.08])
    return SingleChoice(p, crash, np.stack([tilted / tilted.sum(), p, wrong]), np.array([0.4, 0.3, 0.3]))
