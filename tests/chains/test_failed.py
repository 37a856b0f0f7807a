"""What intervals are worth when a share of the crashes fails instead, by replication; counting these as safe must fail.

Seeds are fixed. Each `binomtest` would reject a coverage of 0.90 with probability 1e-4; the mutant, which takes a
failed test for one without a crash, must miss at 1e-9.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

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
FAILING = 0.4
CHAIN = frequent_decisive()


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


@pytest.mark.parametrize(
    ("name", "drawn", "wrong"),
    [
        ("nde", partial(draw, CHAIN, "nde", 10_000), ACCUMULATORS["nde"]),
        ("nade", partial(draw, CHAIN, "forced", 2_000), ACCUMULATORS["nade"]),
        ("mixture_cv", partial(draw, CHAIN, "episode_mixture", 2_000), ACCUMULATORS["mixture_cv"]),
        ("shells", shells_block, FailedAsSafe),
    ],
)
def test_intervals_cover_whatever_failed_tests_would_have_come_to(name, drawn, wrong):
    """Counting failed tests as safe must not cover."""

    def with_failures(rng: np.random.Generator) -> Block:
        block = drawn(rng)
        return block.ending(block.crash & (rng.random(len(block)) < FAILING), FAILED)

    make = {"both ways": lambda: accumulator(name), "as no crash": wrong}
    right, mutant = replicate(with_failures, REPLICATIONS, 31, make, CHAIN.crash_rate).values()
    assert right["p_value"] > 1e-4
    assert mutant["p_value"] < 1e-9
