"""What `dr` is worth beside `nade` on the same tests: coverage, bias and gain of campaigns of several sizes.

``python -m studies.replication.doubly_robust --tests 1000000`` cuts so many tests of each vehicle and setting into
campaigns. The truth is independent of them (`studies.replication.populations`); the refusal below some number of tests
is left out, as this is what it rests on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from itertools import repeat
from pathlib import Path

import numpy as np

from harness.estimators.block import Block
from harness.progress import Progress
from harness.vocabulary import BoolArray
from studies.replication.experiment import load_experiment
from studies.replication.judgement import Row, Subject, judge
from studies.replication.subjects import subjects
from studies.replication.weighted import CHUNK, WeightedCampaign
from studies.work import worker_processes

FILE = Path(__file__).parents[2] / "scenarios" / "validate" / "twin_dr.yaml"
SETTINGS = [("immediate", 0.99), ("recursive", 0.5), ("recursive", 0.95)]
SIZES = (200, 500, 1_000, 2_000)
"""Of campaigns, in tests; each divides `CHUNK`."""

LEAST_OF_STRATUM = 200
"""Tests of a number of control steps that has a coefficient of its own."""


def rows_of(repeated: WeightedCampaign, first: int) -> dict[int, list[Row]]:
    """Results of all campaigns that `CHUNK` tests are cut into, by their size."""
    block = repeated.source(first, CHUNK)
    return {
        n: [
            row for k in range(0, CHUNK, n) for row in repeated.results((first + k) // n, [block.take(slice(k, k + n))])
        ]
        for n in SIZES
    }


def line(setting: str, subject: Subject, n: int, rows: Sequence[Row]) -> str:
    """One row of the table."""
    of = {name: [row for row in rows if row.result == name] for name in ("nade", "dr")}
    found = {name: judge(subject, name, each, 0.9) for name, each in of.items()}
    spread = {name: np.var([row.crash_rate for row in each]) for name, each in of.items()}
    means = f"{found['dr']['bias']:+.1%} ± {found['dr']['bias_std_error']:.1%}"
    covered = " | ".join(f"{found[name]['coverage']:.3f}" for name in of)
    return f"| {setting} | {subject.name} | {n:,} | {means} | {covered} | {spread['nade'] / spread['dr']:.2f} |"


def by_strata(setting: str, subject: Subject, blocks: Sequence[Block]) -> str:
    """What a β of each number of control steps would bring, fitted to the first half of the tests, in the other half.

    Bias is over the rate: the mean of D_1 is 0 over all tests, and not over those with as many control steps.
    """
    y = np.concatenate([block.weighted_crashes() for block in blocks])
    d = np.concatenate([block.martingale[:, 0] for block in blocks])
    steps = np.concatenate([block.n_control_steps for block in blocks])
    half, beta = len(y) // 2, np.zeros(steps.max() + 1)

    def fitted(rows: BoolArray) -> float:
        away = d[:half][rows] - d[:half][rows].mean()
        return float(np.clip(away @ y[:half][rows] / max(away @ away, np.finfo(np.float64).tiny), 0.0, 1.0))

    one = beta[:] = fitted(np.ones(half, np.bool_))
    for level in np.unique(steps[:half]):
        if (rows := steps[:half] == level).sum() >= LEAST_OF_STRATUM:
            beta[level] = fitted(rows)
    y, d, of_steps = y[half:], d[half:], beta[steps[half:]] * d[half:]
    moved = one * d - of_steps
    bias = (
        f"{moved.mean() / subject.crash_rate.value:+.1%} ± {moved.std() / np.sqrt(half) / subject.crash_rate.value:.1%}"
    )
    gains = " | ".join(f"{y.var() / (y - taken).var():.2f}" for taken in (one * d, of_steps))
    return f"| {setting} | {subject.name} | {gains} | {bias} |"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tests", type=int, default=1_000_000, help="of each vehicle in each setting")
    parser.add_argument("--workers", type=int, help="one per core by default")
    parser.add_argument("--strata", action="store_true", help="instead: a coefficient of each number of control steps")
    asked = parser.parse_args()
    head = "| challenge, ε | vehicle | tests | bias of `dr` | covers: `nade` | `dr` | gain |"
    head = "| challenge, ε | vehicle | gain with one β | one by stratum | bias by stratum |" if asked.strata else head
    sys.stdout.write(f"{head}\n{'| --- ' * (head.count('|') - 1)}|\n")
    for challenge, epsilon in SETTINGS:
        own = f"campaign.testing.challenge={challenge}", f"campaign.testing.epsilon={epsilon}"
        with worker_processes(asked.workers) as executor:
            for subject, repeated in list(subjects(load_experiment(FILE, own), executor, Progress())):
                assert isinstance(repeated, WeightedCampaign)
                firsts, setting = range(0, asked.tests, CHUNK), f"{challenge} {epsilon:g}"
                if asked.strata:
                    blocks = list(executor.map(repeated.source, firsts, repeat(CHUNK)))
                    sys.stdout.write(by_strata(setting, subject, blocks) + "\n")
                    continue
                parts = list(executor.map(partial(rows_of, repeated), firsts))
                for n in SIZES:
                    rows = [row for part in parts for row in part[n]]
                    sys.stdout.write(line(setting, subject, n, rows) + "\n")
                sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
