"""Events that are milder than those that count: some are driven, so that it is seen where the vehicle crashes there.

They enter no rate. A vehicle that crashes on them crashes more often than its rate says.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from harness.loop.repeat import Traffic
from harness.progress import Progress
from harness.resolved import Resolved
from harness.sampling.forced import Forced

N_TESTS = 36
"""One that crashes on a tenth of them is found out 98 times in 100."""


@dataclass(frozen=True)
class Milder:
    """What milder events have come to, of which there are so many in an hour of driving."""

    n_tests: int
    n_crashes: int
    n_failed: int
    per_hour: float


def milder_tests(resolved: Resolved) -> Traffic | None:
    """The milder events that are driven, (`N_TESTS`,); None where there are none."""
    if (environment := resolved.family.milder(resolved.environment)) is None:
        return None
    return Forced(replace(resolved, environment=environment), Progress()).tests(0, N_TESTS)


def milder_of(resolved: Resolved, table: pa.Table) -> dict[str, Any]:
    """What their tests, a table of episodes, have come to, as JSON content of `Milder`."""
    outcome, impact = table.column("outcome").cast(pa.string()), pc.fill_null(table.column("impact_speed_mps"), 0.0)
    counts = pc.or_(pc.greater(impact, above := resolved.campaign.crash.counts_above_mps), above == 0.0)
    crashes = pc.sum(pc.and_(pc.equal(outcome, "crash"), counts)).as_py()
    family = resolved.family
    exposure = family.exposure(family.milder(resolved.environment), resolved.parameters)
    failed = len(table) - table.column("failure").null_count
    return asdict(Milder(len(table), crashes, failed, exposure.per_hour))
