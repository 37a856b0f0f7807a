"""Blocks by hand, for tests that need particular outcomes and weights, and estimators fed with blocks."""

from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from harness.estimators.block import Block, SamplingPlan
from harness.estimators.tally import Tally
from harness.strata import ShellDesign
from harness.vocabulary import CRASH, FAILED, TIMEOUT, Method
from studies.chains.chain import Chain
from studies.chains.sampler import draw

State = TypeVar("State")
SHELLS = ShellDesign(
    pool="0" * 24, strata=("careful", "careless", "outside"), cell_stratum=(0, 1, 2), cell_references=(0, 0, 0),
    cell_p=np.array([1e-4, 3e-4, 2e-2]), n_paths=10**9,
    boundary="careless", assumes="keeps to careless", n_inside=2, p_event=0.03, p_unreachable=0.0096,
)  # fmt: skip
"""Shells of a pool that is known exactly."""
RARE = ShellDesign(
    pool="0" * 24, strata=("a", "b", "outside"), cell_stratum=(0, 1, 2), cell_p=np.array([1e-7, 2e-7, 3e-5]),
    n_paths=10**9, boundary="b", assumes="keeps to b", n_inside=2, p_event=4e-5, p_unreachable=0.0,
)  # fmt: skip
"""Others, of rare cut-ins."""
EXACT = 10**12
"""Paths of another."""


def blocks(chain: Chain, method: Method, sizes: list[int], seed: int) -> Iterator[Block]:
    """Consecutive blocks of a chain, of the given sizes; each has its own random stream."""
    first = 0
    for k, size in enumerate(sizes):
        yield draw(chain, method, size, np.random.default_rng([seed, k]), first_episode=first)
        first += size


def block(
    crash: list[bool],
    log_weight: list[float] | None = None,
    *,
    failed: list[bool] | None = None,
    method: Method = "step_mixture",
    first_episode: int = 0,
    alpha: np.ndarray | None = None,
    weight_cap: float | None = None,
    epsilon: float = 0.0,
    **more: np.ndarray,
) -> Block:
    """Episodes with the given outcomes; those with a crash have a cut-in."""
    n, crashed = len(crash), np.array(crash, dtype=bool)
    outcome = np.select(
        [np.array([False] * n if failed is None else failed, bool), crashed], [FAILED, CRASH], TIMEOUT
    ).astype(np.int8)
    columns = {"happened": crashed, "log_q": np.zeros((n, 2)), "n_control_steps": np.ones(n, dtype=np.int64)}
    columns |= {"martingale": np.zeros((n, 2)), **more}
    drawn = SamplingPlan(method, np.full(2, 0.5) if alpha is None else alpha, weight_cap, epsilon=epsilon)
    return Block(
        first_episode, outcome, np.array([0.0] * n if log_weight is None else log_weight, np.float64), columns, drawn
    )


def in_shells(strata: list[int], crash: list[bool], failed: list[bool] | None = None, first: int = 0) -> Block:
    """Tests drawn from `SHELLS`."""
    n, stratum = len(strata), np.array(strata, np.int64)
    some = block(crash, failed=failed)
    columns = {"happened": np.ones(n, np.bool_), "stratum": stratum, "cell": stratum}
    columns["cell_mass"] = np.tile(SHELLS.p, (n, 1))
    return Block(first, some.outcome, np.log(SHELLS.p)[strata], columns, SamplingPlan("shells", shells=SHELLS))


def tally(mass: np.ndarray, crashes: Sequence[int], tests: Sequence[int], failed: Sequence[int] | int = 0) -> Tally:
    """Counts of strata; all paths have the same ``mass`` in each."""
    k, n = np.array(crashes), np.array(tests)
    f = np.zeros_like(k) + failed
    return Tally(n, k, f, np.outer(k, mass), np.outer(f, mass))


def fed(state: State, parts: Iterable[Block]) -> State:
    """The estimator once it has been given all parts."""
    for part in parts:
        state.add(part)
    return state
