"""What replicates of the traffic leave open of an answer, in words: rows below rate and ratio, and a warning."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from harness.estimators.traffic import TrafficError, Uncertain
from harness.numbers import MISSING, interval, number, ratio, share
from harness.report.rows import Row

LEAST_REPLICATES = 100
"""With fewer, quantiles far out in the tails change with their number [assumed]."""
CLOSE = 0.1
"""Factors closer to 1 than so much on a logarithmic scale are told with three digits."""


def with_traffic(rows: list[Row], found: TrafficError | None) -> list[Row]:
    """Rows of an answer with those of its traffic below rate and ratio.

    Where no lane change was seen the rate has but an upper limit, and stands behind the ratio.
    """
    if found is None:
        return rows
    if found.unseen is not None and not found.is_open:
        limit, why = f"< {number(found.rate.both[1])} per test", f"none seen at {found.unseen.where}"
        for i, row in enumerate(rows):
            if row.key == "rate":
                seen = f"as fitted {number(found.rate.value)}" if found.rate.value else row.interval
                rows[i] = replace(row, value=limit, interval=seen, remark=why)
        rows = sorted(rows, key=lambda row: {"verdict": 0, "ratio": 1}.get(row.key, 2))
    place = 1 + max((i for i, row in enumerate(rows) if row.key in ("verdict", "rate", "ratio")), default=-1)
    return [*rows[:place], *traffic_rows(found), *rows[place:]]


def traffic_rows(found: TrafficError) -> Iterator[Row]:
    """Lines of the short answer: of the rate, and of its ratio to the first of the others."""
    why = "with sampling error" if found.unseen is None else f"none seen at {found.unseen.where}"
    both, ends = found.rate.both, MISSING
    if found.is_open:
        why = f"{found.n_refused} of {found.n_replicates} replicates unlike what was tested"
    else:
        ends = interval(*both) if found.rate.times[0] > 0.0 else f"< {number(both[1])}"
    yield Row("traffic", "error of the fit", _times(found.rate), ends, why)
    for name, each in list(found.ratios.items())[: 0 if found.is_open else 1]:
        yield Row("traffic_ratio", "the same, ratio", _times(each), _of_ratio(each), f"the ratio to {name}")


def _of_ratio(of: Uncertain) -> str:
    low, high = of.both
    if math.isfinite(high):
        return f"{ratio(low)} to {ratio(high)}" if low > 0.0 else f"< {ratio(high)}"
    return f"at least {ratio(low)}" if low > 0.0 else "no limit"


def _times(of: Uncertain) -> str:
    """``0.6 to 2.1 times``, or ``up to 27 times``."""
    low, high = (number(end, 2 if end > 0.0 and abs(math.log(end)) > CLOSE else 3) for end in of.times)
    if of.times[0] > 0.0:
        return f"{low} to {high} times"
    return f"up to {high} times" if math.isfinite(of.times[1]) else "no limit"


def bar_note(bar: Mapping[str, Any]) -> str:
    """Why the tests do not answer some of the environments of a `Bar`."""
    why = {"laws that give no probabilities": bar["no_laws"], "unlike what was tested": bar["unlike"]}
    note = " and ".join(reason for reason, n in why.items() if n)
    return f"{sum(why.values())} of {bar['n']}: {note}" if note and bar["values"] is None else note


def too_few(n_replicates: int, confidence: float) -> tuple[str, ...]:
    """A warning of limits from few replicates; nothing where there are enough."""
    if n_replicates >= LEAST_REPLICATES:
        return ()
    least = math.ceil(2.0 / (1.0 - confidence) - 1e-9)
    none = f" (a {share(confidence)} interval needs at least {least})" if n_replicates < least else ""
    return (f"only {n_replicates} replicates{none}: the error of the fit is rough below {LEAST_REPLICATES}",)
