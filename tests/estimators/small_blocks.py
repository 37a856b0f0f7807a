"""Blocks by hand, for tests that need particular outcomes and weights."""

from __future__ import annotations

import numpy as np

from harness.estimators.block import Block
from harness.methods import Method


def block(
    crash: list[bool],
    log_weight: list[float] | None = None,
    *,
    failed: list[bool] | None = None,
    method: Method = "step_mixture",
    first_episode: int = 0,
    **settings,
) -> Block:
    """Episodes with the given outcomes; those with a crash have a cut-in."""
    n = len(crash)
    return Block(
        first_episode=first_episode,
        method=method,
        crash=np.array(crash, dtype=bool),
        failed=np.array(failed if failed is not None else [False] * n, dtype=bool),
        cut_in=np.array(crash, dtype=bool),
        bv_lv_contact=np.zeros(n, dtype=bool),
        log_weight=np.array(log_weight if log_weight is not None else [0.0] * n, dtype=np.float64),
        log_q=settings.pop("log_q", np.zeros((n, 2))),
        alpha=settings.pop("alpha", np.array([0.5, 0.5])),
        n_control_steps=settings.pop("n_control_steps", np.ones(n, dtype=np.int64)),
        **settings,
    )
