"""What a comparison on the same cut-ins says, in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator

from harness.estimators.difference import (
    apart_statement,
    failed_pairs_statement,
    rates_statement,
)
from harness.estimators.paired_shells import Contrast, PairedEstimate
from harness.estimators.pairs import Interval, Verdict


def paired_statement(found: PairedEstimate, name_a: str, name_b: str) -> str:
    """Without an assumption: both rates, what lies between them, and where only one of the two crashes."""
    free = found.free
    return (
        f"{rates_statement(found.a, found.b, name_a, name_b)}: {_apart(free, found.a.confidence)}, from "
        f"{free.n_pairs:,} pairs of tests. Alone, where the other one does not, "
        f"A crashes {_alone(free.only_a)} times per test, B {_alone(free.only_b)}."
        f"{failed_pairs_statement(found.a, found.b)}"
    )


def conditional_paired_statement(found: PairedEstimate) -> str:
    """If both crash only where the boundary surrogate or a more careful one does."""
    boundary, inside = found.pairs.design.library.boundary, found.conditional
    if found.refuted:
        who = " and ".join(_crashed_outside(found))
        return (
            f"{who} crashed where the surrogate {boundary} does not crash: nothing can be said under the assumption "
            f"that they crash only where {boundary} does."
        )
    text = (
        f"If A and B crash only where the surrogate {boundary} or a more careful one crashes: "
        f"{_apart(inside, found.a.confidence)}, from {inside.n_pairs:,} pairs of tests."
    )
    if inside.n_pairs == found.free.n_pairs:
        return f"{text} Nothing was tested outside: whether the assumption holds is not known."
    return f"{text} In {found.free.n_pairs - inside.n_pairs:,} pairs of tests outside neither crashed."


def margin_statement(verdict: Verdict, margin: float, level: float, *, conditional: bool) -> str:
    """Whether B is worse than A by more than a margin."""
    answer = {
        "proven": "B is not worse than A by more than",
        "refuted": "B IS WORSE than A by more than",
        "open": "It is open whether B is worse than A by more than",
    }[verdict]
    given = ", given the library" if conditional else ""
    looks = f" (decided at {level:.1%}, which allows for a look after each round)"
    return f"{answer} {margin:.3g} times A's rate{given}{looks}."


def _apart(found: Contrast, confidence: float) -> str:
    differs = found.n_differing > 0
    apart = apart_statement(found.difference, found.ci_low, found.ci_high, confidence, differs=differs)
    if not math.isfinite(found.ratio):
        return apart
    high = f"{found.ratio_high:.3g}" if math.isfinite(found.ratio_high) else "no limit"
    return f"{apart}, A/B = {found.ratio:.3g} ({found.ratio_low:.3g} to {high})"


def _alone(found: Interval) -> str:
    return f"{found.value:.3g} ({found.ci_low:.3g} to {found.ci_high:.3g})"


def _crashed_outside(found: PairedEstimate) -> Iterator[str]:
    for side, name in enumerate("AB"):
        if n := int(found.pairs.tally(side).crashes[found.pairs.design.library.n_inside :].sum()):
            yield f"{name} has {n:,} times"
