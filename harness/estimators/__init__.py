"""Crash rates from blocks of weighted tests: estimators, intervals, diagnostics, stopping.

Estimators have one shape (``estimate.Accumulator``): add blocks, ask for the result. ``one_pass`` feeds them all.
"""

from harness.estimators.answer import CampaignFacts, estimate_blocks
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, Unavailable
from harness.estimators.one_pass import accumulator, one_pass
from harness.estimators.shells import Shells
from harness.estimators.stopping import StopRule
from harness.vocabulary import ESTIMATORS

__all__ = [
    "ESTIMATORS",
    "Block",
    "CampaignFacts",
    "Estimate",
    "Shells",
    "StopRule",
    "Unavailable",
    "accumulator",
    "estimate_blocks",
    "one_pass",
]
