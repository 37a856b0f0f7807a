"""Put synthetic episodes into shells, and estimate them with the harness's own estimator."""

from __future__ import annotations

from typing import Any

import numpy as np
from synthetic_overtaking import Episodes

from harness.estimators.block import Block
from harness.estimators.run_estimates import CampaignFacts, estimate_blocks
from harness.strata import ShellDesign

P = np.array([4e-8, 9e-8, 3e-5])
"""Probabilities that are far apart: sums that ignore how often a shell was tested come out wrong by orders."""
DESIGN = ShellDesign(
    pool="c0ffee" * 4, strata=("brakes-hard", "brakes-late", "outside"), p=P, moments=np.diag(P * P) * 3.0,
    n_paths=4_000, n_inside=2, boundary="brakes-late", p_cut_in=3.3e-5, p_impossible=2.87e-6,
)  # fmt: skip
BLOCK = 100


def put_into_shells(episodes: Episodes, *, outside: str, seed: int) -> None:
    """Draw a shell for each episode; ``outside`` is ``safe``, ``crashes`` or ``untested``."""
    c = episodes.columns
    n = len(c["outcome"])
    rng = np.random.default_rng(seed)
    shell = rng.choice(3, n, p=(0.2, 0.3, 0.5))
    inside = rng.choice(2, n)
    if outside == "untested":
        shell = inside
    elif outside == "safe":
        shell = np.where(c["outcome"] == "crash", inside, shell)
    c["component"] = shell
    c["log_weight"] = np.log(P)[shell]
    c["n_control_steps"] = np.ones(n, dtype=int)


def shells_estimates(episodes: Episodes, facts: CampaignFacts) -> dict[str, Any]:
    """Content of estimates.json."""
    c = episodes.columns
    n = len(c["outcome"])
    blocks = []
    for first in range(0, n, BLOCK):
        rows = slice(first, min(first + BLOCK, n))
        outcome = c["outcome"][rows]
        m = len(outcome)
        blocks.append(
            Block(
                first_episode=first,
                method="shells",
                crash=outcome == "crash",
                failed=outcome == "failed",
                cut_in=c["cut_in_step"][rows] >= 0,
                bv_lv_contact=np.zeros(m, np.bool_),
                log_weight=c["log_weight"][rows],
                log_q=np.zeros((m, 0)),
                alpha=np.zeros(0),
                n_control_steps=c["n_control_steps"][rows],
                component=c["component"][rows].astype(np.int64),
                shells=DESIGN,
            )
        )
    return estimate_blocks(blocks, facts)
