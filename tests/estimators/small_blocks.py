"""Blocks by hand, for tests that need particular outcomes and weights, and estimators fed with blocks."""

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from harness.estimators.block import Block
from harness.strata import ShellDesign, Statement
from harness.vocabulary import Method

State = TypeVar("State")
SHELLS = ShellDesign(
    pool="0" * 24, strata=("careful", "careless", "outside"), cell_stratum=(0, 1, 2), cell_references=(0, 0, 0),
    cell_p=np.array([1e-4, 3e-4, 2e-2]), n_paths=10**9,
    statements=(Statement("library", "careless", "keeps to careless", 2),), p_cut_in=0.03, p_impossible=0.0096,
)  # fmt: skip
"""Shells of a pool that is known exactly."""


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


def in_shells(strata: list[int], crash: list[bool], failed: list[bool] | None = None, first: int = 0) -> Block:
    """Tests drawn from `SHELLS`."""
    n = len(strata)
    stratum = np.array(strata, np.int64)
    design = {"stratum": stratum, "cell": stratum, "cell_mass": np.tile(SHELLS.p, (n, 1)), "shells": SHELLS}
    none = {"log_q": np.zeros((n, 0)), "alpha": np.zeros(0)}
    log_weight = np.log(SHELLS.p)[strata]
    some = block(crash, log_weight, failed=failed, method="shells", first_episode=first, **design, **none)
    return replace(some, cut_in=np.ones(n, np.bool_))


def fed(state: State, parts: Iterable[Block]) -> State:
    """The estimator once it has been given all parts."""
    for part in parts:
        state.add(part)
    return state
