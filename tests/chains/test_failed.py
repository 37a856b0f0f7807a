"""What intervals are worth when a share of the crashes fails instead, by replication; counting these as safe must fail.

Seeds are fixed. Each `binomtest` would reject a coverage of 0.90 with probability 1e-4; the mutant, which takes a
failed test for one without a crash, must miss at 1e-9.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.estimators.block import Block
from harness.estimators.one_pass import ACCUMULATORS, accumulator
from harness.vocabulary import FAILED, TIMEOUT
from studies.chains.chain import frequent_decisive
from studies.chains.sampler import draw
from studies.chains.shells import ChainShells
from studies.replication.shells import DrawnPool, campaign_block

from .coverage import replicate

REPLICATIONS = 150
N = 2_000
FAILING = 0.4
CHAIN = frequent_decisive()
METHODS = {"nde": "nde", "nade": "forced", "mixture_cv": "episode_mixture"}


def with_failures(block: Block, rng: np.random.Generator) -> Block:
    failed = block.crash & (rng.random(len(block)) < FAILING)
    return block.ending(failed, FAILED)


def require_coverage(drawn, seed: int, name: str, wrong: type) -> None:
    """Of the estimator by name; counting failed tests as safe must not cover."""
    make = {"both ways": lambda: accumulator(name), "as no crash": wrong}
    right, mutant = replicate(
        lambda rng: with_failures(drawn(rng), rng), REPLICATIONS, seed, make, CHAIN.crash_rate
    ).values()
    assert right.p_value > 1e-4
    assert mutant.p_value < 1e-9


@pytest.mark.parametrize("name", METHODS)
def test_intervals_cover_whatever_failed_tests_would_have_come_to(name):
    n = 5 * N if name == "nde" else N
    require_coverage(lambda rng: draw(CHAIN, METHODS[name], n, rng), 31, name, ACCUMULATORS[name])


def shells_block(rng: np.random.Generator) -> Block:
    """Fixed numbers of tests in the shells of a pool that is exactly known."""
    source = ChainShells(CHAIN, 20)
    design = replace(source.draw(rng)[0].design, cell_p=source.shell_p, n_paths=10**12)
    drawn = DrawnPool(design, source.shell_p[None], source.crash_p[None])
    return campaign_block(drawn, np.full(len(design.p), 300), 0, rng)


class FailedAsSafe(ACCUMULATORS["shells"]):
    """Mutant: shells that forget that tests failed."""

    def add(self, block: Block) -> None:
        super().add(block.ending(block.failed, TIMEOUT))


def test_shells_cover_too():
    require_coverage(shells_block, 32, "shells", FailedAsSafe)
