"""What NADE and SCV say of the same tests: rates, half-widths as in the paper, and how many tests these ask for."""

from __future__ import annotations

from typing import Any

from harness.estimators.block import Block
from harness.estimators.diagnostics import CARELESS_MEAN
from harness.estimators.estimate import BothWays
from harness.estimators.nade import Nade
from harness.estimators.scv import Scv
from harness.methods import Method
from harness.studies.case_study.figures import figure, marked, tests_for, z_of


def weights_are_in(method: Method, mean_weight: float) -> bool:
    """Whether the large weights of the step mixture, which nothing bounds, have come in: their mean is 1 if so."""
    return method != "step_mixture" or mean_weight >= CARELESS_MEAN


class Claims:
    """Both estimators, fed with the same blocks; SCV only where it is defined and wanted."""

    def __init__(self, *, with_scv: bool = True) -> None:
        self.nade, self.scv = BothWays(Nade()), Scv()
        self._scv, self._with_scv = BothWays(self.scv), with_scv
        self._n, self._weight = 0, 0.0
        self._method: Method = "nde"

    def add(self, block: Block) -> None:
        """Add tests."""
        self._method = block.method
        self._with_scv = self._with_scv and Scv.refusal(block) is None
        self._n += len(block)
        self._weight += float(block.weights().sum())
        self.nade.add(block)
        if self._with_scv:
            self._scv.add(block)

    def row(self, rhw: float, confidence: float) -> dict[str, Any]:
        """Figures of what is claimed so far; ``settled`` says whether it means anything."""
        nade, z = self.nade.result(confidence), z_of(confidence)
        scv = self._scv.result(confidence) if self._with_scv else None
        mean_weight = self._weight / self._n
        settled = weights_are_in(self._method, mean_weight)
        row: dict[str, Any] = {
            "n": self._n,
            "n_crashes": nade.n_crashes,
            "mean_weight": mean_weight,
            "settled": settled,
            "largest_weight_share": nade.largest_weight_share,
        }
        for name, found in (("nade", nade), ("scv", scv)):
            rate, half = (0.0, 0.0) if found is None else (found.crash_rate, z * found.std_error)
            said = figure(rate, max(rate - half, 0.0), rate + half) if rate > 0.0 else figure(None)
            row[f"{name}_rate"] = marked(said, settled=settled)
            row[f"{name}_rhw"] = half / rate if rate > 0.0 else None
            row[f"{name}_tests"] = tests_for(self._n * (half / z / rate) ** 2, rhw, confidence) if rate > 0.0 else None
        beside = scv if scv is not None and scv.std_error > 0.0 < nade.crash_rate else None
        row["gain_claimed"] = None if beside is None else (nade.std_error / beside.std_error) ** 2
        row["difference"] = None if beside is None else abs(beside.crash_rate / nade.crash_rate - 1.0)
        return row
