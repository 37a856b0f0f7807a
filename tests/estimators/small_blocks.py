"""Blocks by hand, for tests that need particular outcomes and weights, and estimators fed with blocks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np

from harness.campaign.models import Method
from harness.estimators.block import Block

State = TypeVar("State")


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
    usual = {"log_q": np.zeros((n, 2)), "alpha": np.array([0.5, 0.5]), "n_control_steps": np.ones(n, dtype=np.int64)}
    return Block(
        first_episode=first_episode,
        method=method,
        crash=np.array(crash, dtype=bool),
        failed=np.array(failed if failed is not None else [False] * n, dtype=bool),
        cut_in=np.array(crash, dtype=bool),
        bv_lv_contact=np.zeros(n, dtype=bool),
        log_weight=np.array(log_weight if log_weight is not None else [0.0] * n, dtype=np.float64),
        **(usual | settings),
    )


def fed(state: State, parts: Iterable[Block]) -> State:
    """The estimator once it has been given all parts."""
    for part in parts:
        state.add(part)
    return state
