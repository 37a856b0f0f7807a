"""Replications of a campaign on a chain: what an estimator's interval is worth is judged by these, never by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from harness.estimators.block import Block
from harness.estimators.estimate import Accumulator
from studies.replication.judgement import Judgement, Row, Subject, estimate_row, judge
from studies.replication.shells import Draw, DrawnPool
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


def wrong_shell(draw: Draw, shell: int, factor: float) -> Draw:
    """Pools that believe one shell this many times as probable as it is."""

    def drawn(rng: np.random.Generator) -> list[DrawnPool]:
        pools = draw(rng)
        wrong = np.where(np.array(pools[0].design.cell_stratum) == shell, factor, 1.0)
        return [replace(one, design=replace(one.design, cell_p=one.design.cell_p * wrong)) for one in pools]

    return drawn
