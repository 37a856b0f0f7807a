"""Failed tests counted both ways: as no crash in the rate and the lower limit, as crashes in every upper limit.

What a failed test would have come to is not known. Had all of them ended without a crash, the crash rate would be one
number, had all of them crashed, another, and the truth lies between. So an interval reaches from the lower limit of the
first to the upper limit of the second: it covers wherever each of the two does.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np

from harness.estimators.accumulator import Accumulator
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate


class BothWays:
    """An estimator that is fed twice from the first failed test on.

    Parameters
    ----------
    state : Accumulator
        Empty.

    Attributes
    ----------
    seen : Accumulator
        It, with failed tests as no crash.
    """

    def __init__(self, state: Accumulator) -> None:
        self.seen = state
        self._worst: Accumulator | None = None  # until a test fails it would be the same
        self._n_failed = 0

    def add(self, block: Block) -> None:
        """Add the episodes of one block."""
        if self._worst is None and block.failed.any():
            self._worst = deepcopy(self.seen)
        self._n_failed += int(np.count_nonzero(block.failed))
        self.seen.add(block)
        if self._worst is not None:
            self._worst.add(block.failed_as_crashes())

    def result(self, confidence: float) -> Estimate:
        """Rate and lower limit of what was seen, upper limits of the worst that it may have been.

        Raises
        ------
        ValueError
            If no episode was added.
        """
        seen = self.seen.result(confidence)
        worst = seen if self._worst is None else self._worst.result(confidence)
        details = {
            "n_failed": self._n_failed,
            "crash_rate_if_failed_had_crashed": worst.crash_rate,
            **seen.details,
        }
        if not self._n_failed:
            return replace(seen, details=details)
        high = max(seen.ci_high, worst.ci_high)
        return replace(
            seen,
            ci_high=high,
            upper_bound=max(seen.upper_bound, worst.upper_bound),
            rhw=(high - seen.ci_low) / 2.0 / seen.crash_rate if seen.crash_rate > 0.0 else math.inf,
            weight_cap=max(seen.weight_cap, worst.weight_cap),
            warnings=(
                *seen.warnings,
                f"{self._n_failed} of {seen.n_episodes} episodes failed; the rate and the lower limit count them as no "
                "crash, the upper limits as crashes",
            ),
            details=details,
        )
