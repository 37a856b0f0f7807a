"""`shells`: crashes counted within shells of known probability, and the two statements that they allow.

The assumption-free statement counts every shell, tested or empty. The conditional one holds for vehicles that crash
only where the boundary surrogate, or a more careful one, crashes too: it needs far fewer tests, and one crash outside
refutes it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from harness.arrays import IntArray
from harness.estimators.accumulator import require_episodes
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate
from harness.estimators.stratified import Limits, combined, pool_variance, share_limits
from harness.methods import EstimatorName
from harness.strata import ShellDesign

_METHOD = "crashes within shells of known probability; Clopper-Pearson limits per shell, combined (MOVER)"


class Shells:
    """Tests and crashes of each stratum."""

    name: ClassVar[EstimatorName] = "shells"

    def __init__(self) -> None:
        self.design: ShellDesign | None = None
        self.tests: IntArray = np.zeros(0, np.int64)
        self.crashes: IntArray = np.zeros(0, np.int64)
        self.failed: IntArray = np.zeros(0, np.int64)

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Shells must have been drawn from, and their probabilities be known."""
        if block.shells is None or block.component is None:
            return f"tests must be drawn from shells (testing.method shells), these were drawn by {block.method}"
        return None

    def add(self, block: Block) -> None:
        """Count one block."""
        if block.shells is None or block.component is None:
            raise ValueError("the block has no shells")
        if self.design is None:
            self._begin(block.shells)
        n_strata = self.tests.size
        self.tests += np.bincount(block.component, minlength=n_strata)
        self.crashes += np.bincount(block.component[block.crash], minlength=n_strata)
        self.failed += np.bincount(block.component[block.failed], minlength=n_strata)

    def _begin(self, design: ShellDesign) -> None:
        self.design = design
        self.tests, self.crashes, self.failed = (np.zeros(design.p.size, np.int64) for _ in range(3))

    def assumption_free(self, confidence: float) -> Limits:
        """Rate over all strata."""
        return self._limits(slice(None), (1.0 - confidence) / 2.0)

    def conditional(self, confidence: float) -> Limits:
        """Rate over the strata inside."""
        return self._limits(slice(0, self._design().n_inside), (1.0 - confidence) / 2.0)

    def _limits(self, strata: slice, tail: float) -> Limits:
        design = self._design()
        return combined(
            design.p[strata],
            self.crashes[strata],
            self.tests[strata],
            design.moments[strata, strata],
            design.n_paths,
            tail,
            self.failed[strata],
        )

    def _design(self) -> ShellDesign:
        if self.design is None:
            raise ValueError("an estimate needs at least one episode")
        return self.design

    def result(self, confidence: float) -> Estimate:
        """Assumption-free estimate; the conditional one is among its details."""
        n = int(self.tests.sum())
        require_episodes(n)
        design = self._design()
        free = self.assumption_free(confidence)
        share = self.crashes / np.maximum(self.tests, 1)
        y = design.p / np.maximum(self.tests, 1)  # contribution of one crash, up to the factor n
        squares = float((self.crashes * y * y).sum())
        variance = float((design.p**2 * share * (1.0 - share) / np.maximum(self.tests, 1)).sum())
        variance += pool_variance(share, design.moments, free.rate, design.n_paths)
        return Estimate(
            crash_rate=free.rate,
            std_error=float(np.sqrt(variance)),
            ci_low=free.low,
            ci_high=free.high,
            upper_bound=self._limits(slice(None), 1.0 - confidence).high,
            confidence=confidence,
            rhw=free.rhw,
            n_episodes=n,
            n_crashes=int(self.crashes.sum()),
            n_effective=free.rate**2 / squares if squares > 0.0 else 0.0,
            largest_weight_share=float(np.max(y[self.crashes > 0], initial=0.0)) / free.rate if free.rate > 0 else 0.0,
            method=_METHOD + "; upper bound: the same, one-sided",
            warnings=tuple(self._warnings()),
            details=self._details(confidence, free),
        )

    def _details(self, confidence: float, free: Limits) -> dict[str, Any]:
        design = self._design()
        return {
            "boundary": design.boundary,
            "pool": design.pool,
            "rhw_from_pool": free.rhw_from_pool,
            "rhw_from_pool_at_least": free.rhw_from_pool_at_least,
            "p_cut_in": design.p_cut_in,
            "p_impossible": design.p_impossible,
            "conditional": self._conditional(confidence),
            "shells": self._shells(confidence),
        }

    def _conditional(self, confidence: float) -> dict[str, Any]:
        """The statement given that there are no crashes outside, and what is known about those."""
        design = self._design()
        inside, within, outside = (
            self.conditional(confidence),
            slice(0, design.n_inside),
            slice(design.n_inside, None),
        )
        _, high = share_limits(self.crashes[outside], self.tests[outside], 1.0 - confidence, self.failed[outside])
        crashes = int(self.crashes[outside].sum())
        worst_share = (self.crashes + self.failed) / np.maximum(self.tests, 1)
        return {
            "crash_rate": inside.rate,
            "ci_low": inside.low,
            "ci_high": inside.high,
            "rhw": inside.rhw,
            "rhw_from_pool": inside.rhw_from_pool,
            "rhw_from_pool_at_least": inside.rhw_from_pool_at_least,
            "n_episodes": int(self.tests[: design.n_inside].sum()),
            "n_crashes": int(self.crashes[: design.n_inside].sum()),
            "n_failed": int(self.failed[: design.n_inside].sum()),
            "crash_rate_if_failed_had_crashed": float(design.p[within] @ worst_share[within]),
            "n_episodes_outside": int(self.tests[outside].sum()),
            "n_crashes_outside": crashes,
            "n_failed_outside": int(self.failed[outside].sum()),
            "refuted": crashes > 0,
            "upper_bound_outside": float((design.p[outside] * high).sum()),
        }

    def _shells(self, confidence: float) -> list[dict[str, Any]]:
        design = self._design()
        low, high = share_limits(self.crashes, self.tests, (1.0 - confidence) / 2.0, self.failed)
        return [
            {
                "shell": name,
                "inside": s < design.n_inside,
                "p": float(design.p[s]),
                "n_episodes": int(self.tests[s]),
                "n_crashes": int(self.crashes[s]),
                "n_failed": int(self.failed[s]),
                "crash_share": float(self.crashes[s] / max(self.tests[s], 1)),
                "crash_share_low": float(low[s]),
                "crash_share_high": float(high[s]),
                "contribution": float(design.p[s] * self.crashes[s] / max(self.tests[s], 1)),
            }
            for s, name in enumerate(design.strata)
        ]

    def _warnings(self) -> list[str]:
        design = self._design()
        found = []
        if empty := [name for name, tests in zip(design.strata, self.tests, strict=True) if tests == 0]:
            found.append(f"no test in {', '.join(empty)}: the interval allows for any share of crashes there")
        used_up = [
            name
            for name, tests, kept in zip(design.strata, self.tests, design.available, strict=False)
            if tests >= kept
        ]
        if used_up:
            found.append(
                f"all cut-ins that the pool has kept of {', '.join(used_up)} were tested: for more precision raise "
                "pool.cut_ins_per_shell, and run into a new folder"
            )
        if crashes := int(self.crashes[design.n_inside :].sum()):
            found.append(
                f"{crashes} crashes where {design.boundary} does not crash: the conditional statement does not hold "
                "for this vehicle"
            )
        return found
