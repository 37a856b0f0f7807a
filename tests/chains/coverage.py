"""Replications of a campaign on a chain: what an estimator's interval is worth is judged by these, never by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Accumulator
from studies.judgement import Judgement, Row, Subject, estimate_row, judge
from tests.estimators.small_blocks import fed


def replicate(
    draw: Callable[[np.random.Generator], Block],
    replications: int,
    seed: int,
    make: Mapping[str, Callable[[], Accumulator]],
    truth: float,
) -> dict[str, Judgement]:
    """Give the same data, drawn anew for each replication, to every estimator, and judge their 90 % intervals."""
    rows: dict[str, list[Row]] = {name: [] for name in make}
    for k in range(replications):
        block = draw(np.random.default_rng([seed, k]))
        for name, new in make.items():
            rows[name].append(estimate_row(name, k, fed(new(), [block]).result(0.9), reached=False))
    return {name: judge(Subject.exact("", truth), name, of_name, 0.9) for name, of_name in rows.items()}
