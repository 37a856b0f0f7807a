"""How often the alarm is false, and how wrong weights must be to raise it.

    python -m benchmarks.alarm [REPLICATIONS]

Drives tests in the twin once, asks the surrogates of the pool about them, and draws campaigns from them: their own
means are then the known rates. Prints the numbers of docs/internals/validation.md. The normal p-value that the alarm is
compared with takes its variance from the campaign itself, where that has 100 effective crashes; the smallest of the
nine surrogates counts, nine times (Bonferroni).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from harness.campaign.campaign import Campaign
from harness.estimators.block import Block, block_from_tables
from harness.pool.build import campaign_pool
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import BoolArray, FloatArray, IntArray, Method
from harness.worlds.twin import TwinWorld
from studies.alarm import LEVEL, Alarm, KnownRates, surrogates_crash

SEED = 77
TESTS, MOST = 20_000, 50_000
SIZES = (400, 1_000, 4_000)
METHODS: tuple[Method, ...] = ("forced", "episode_mixture")
WRONG = (0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2, 1.3, 1.5, 2.0)


class Asked(NamedTuple):
    """Tests, which surrogates would have crashed in them (n, D), and the rates that they are told to have."""

    tests: Block
    crashes: BoolArray
    known: KnownRates

    @property
    def h(self) -> FloatArray:
        """Weighted crashes of surrogates, shape (n, D)."""
        return np.where(self.crashes, self.tests.weights()[:, None], 0.0)

    def p_value(self, wrong: float = 1.0) -> float:
        """That of the alarm, where all weights are wrong by a factor."""
        alarm = Alarm(self.known)
        alarm.add(replace(self.tests, log_weight=self.tests.log_weight + np.log(wrong)), self.crashes)
        return float(alarm.result()["p_value"])

    def first(self, n: int) -> Asked:
        """The first tests."""
        return Asked(self.tests.take(slice(0, n)), self.crashes[:n], self.known)


def asked(method: Method, n: int) -> Asked:
    """Tests of the default AV in the twin, and what surrogates would have done in them."""
    content = {"environment": {"parameters": "ndd-overtaking-1"}, "testing": {"method": method}}
    campaign = Campaign.model_validate({"name": "alarm", "seed": SEED, **content})
    ready, pool = prepare(resolve(campaign)), campaign_pool(resolve(campaign))
    table = episodes_table(ready.loop(TwinWorld(256)).run(0, ready.tests(0, n)), SEED)
    block = block_from_tables(campaign, table)
    return Asked(block, surrogates_crash(table, resolve(campaign), pool), KnownRates.of(pool))


def drawn(found: Asked, rows: IntArray, known: KnownRates) -> Asked:
    """Some of the tests, in any order, with other known rates."""
    return Asked(found.tests.chosen(rows), found.crashes[rows], known)


def by_sample_variance(found: Asked) -> float:
    """Normal p-value of the surrogate that differs most."""
    h = found.h
    squares, error = (h * h).sum(axis=0), h.std(axis=0) / np.sqrt(len(h))
    many = h.sum(axis=0) ** 2 >= 100.0 * np.maximum(squares, 1e-300)
    z = (h.mean(axis=0) - found.known.mu)[many] / error[many]
    return float(np.min(2.0 * ndtr(-np.abs(z)), initial=1.0) * h.shape[1])


def false_alarms(found: Asked, n: int, replications: int) -> str:
    """Row of the first table."""
    h = found.h
    exact = found.known._replace(mu=h.mean(axis=0), std_error=np.zeros(h.shape[1]))
    raised = np.zeros(2)
    for k in range(replications):
        rows = np.random.default_rng([SEED, n, k]).integers(0, len(h), n)
        campaign = drawn(found, rows, exact)
        raised += [by_sample_variance(campaign) <= LEVEL, campaign.p_value() <= LEVEL]
    return f"| `{found.tests.method}` | {n:,} | {raised[0] / replications:.1%} | {raised[1] / replications:.1%} |"


def noticed(found: Asked, n: int) -> str:
    """Row of the second table."""
    p = {wrong: found.first(n).p_value(wrong) for wrong in WRONG}
    small = max((wrong for wrong in WRONG if wrong < 1.0 and p[wrong] <= LEVEL), default=0.0)
    large = min((wrong for wrong in WRONG if wrong > 1.0 and p[wrong] <= LEVEL), default=np.inf)
    return f"| `{found.tests.method}` | {n:,} | {small:g} | {large:g} |"


def main(replications: int) -> None:
    """Print both tables."""
    blocks = [asked(method, MOST) for method in METHODS]
    print("| method | tests | false by the sample's variance | false as reported |\n| --- | --- | --- | --- |")
    for block in blocks:
        for n in SIZES:
            print(false_alarms(block.first(TESTS), n, replications), flush=True)
    print("\n| method | tests | all weights times, at most | or at least |\n| --- | --- | --- | --- |")
    for block in blocks:
        for n in (4_000, TESTS, MOST):
            print(noticed(block, n), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
