"""What the records say about the sampling itself: mean weight, mean ratios, failed tests, contacts of BV and LV.

The mean of W = p/q_sampled over all episodes is 1 in expectation, and so is that of every q_j/q_sampled. They are
**diagnostics, never tests**: `NOTE` says why, in every report.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harness.estimators.block import Block
from harness.estimators.weighted import Moments
from harness.vocabulary import SAMPLING, Method

NOTE = (
    "Diagnostics, never tests: each mean is 1 in expectation, except that of W·1{cut-in}, which is P(cut-in). Under "
    "the step mixture the mean of W is carried by weights that hardly ever occur: published NADE shows about 0.03 at "
    "4e5 episodes although it is unbiased. A mean far below 1 then means that the episodes that matter most have not "
    "been met yet, not that a weight is wrong."
)
NOTE_SHELLS = "Every test within a shell stands for the same probability: there are no weights to be diagnosed."
CARELESS_MEAN = 0.5


class Diagnostics:
    """Running moments of weights and ratios; add blocks, ask for the result."""

    def __init__(self) -> None:
        self.n = self.n_failed = self.n_cut_ins = self.n_contacts = 0
        self.method: Method | None = None
        self._weight, self._cut_in, self._contact = Moments(), Moments(), Moments()
        self._ratios: list[Moments] = []

    def add(self, block: Block) -> None:
        """Add one block."""
        weights = block.weights()
        self.method = block.drawn.method
        self.n += len(block)
        self.n_failed += int(np.count_nonzero(block.failed))
        self.n_cut_ins += int(np.count_nonzero(block.cut_in))
        self.n_contacts += int(np.count_nonzero(block.bv_lv_contact))
        self._weight.add(weights)
        self._cut_in.add(weights[block.cut_in])
        self._contact.add(weights[block.bv_lv_contact])
        if SAMPLING[block.drawn.method].mixes:
            self._ratios = self._ratios or [Moments() for _ in block.drawn.alpha]
            for sums, ratios in zip(self._ratios, block.mixture_ratios().T, strict=True):
                sums.add(ratios)

    def result(self, importance_names: tuple[str, ...] = ()) -> dict[str, Any]:
        """Means with standard errors; the M importance functions, in order, are numbered where names are left out."""
        names = importance_names or tuple(f"q_{j}" for j in range(len(self._ratios)))
        result: dict[str, Any] = {
            "mean_weight": self._mean(self._weight),
            "mean_weight_cut_in": self._mean(self._cut_in),
            "mean_ratio": {name: self._mean(sums) for name, sums in zip(names, self._ratios, strict=False)},
            "bv_lv_contact_share": self._mean(self._contact),
            "n_cut_ins": self.n_cut_ins,
            "n_bv_lv_contacts": self.n_contacts,
            "n_failed": self.n_failed,
            "note": NOTE_SHELLS if self.method == "shells" else NOTE,
        }
        if self.method == "step_mixture" and (mean := self._weight.mean(self.n)) < CARELESS_MEAN:
            result["heavy_tail"] = (
                f"the mean weight is {mean:.3g} where 1 is expected: the episodes with large weights are still missing"
            )
        return result

    def _mean(self, sums: Moments) -> dict[str, float]:
        if self.method == "shells":
            return {"mean": math.nan, "std_error": math.inf}
        return {"mean": sums.mean(self.n), "std_error": sums.std_error(self.n)}
