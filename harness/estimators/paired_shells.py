"""What pairs of tests of two vehicles say: rates, difference and ratio, without an assumption and given the library."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from harness.estimators.difference import apart_statement, failed_pairs_statement, rates_statement
from harness.estimators.estimate import BothWays, Estimate, finite_json
from harness.estimators.limit_search import Level
from harness.estimators.pairs import Interval, PairCounts, Verdict
from harness.estimators.shells import Shells


@dataclass(frozen=True)
class Contrast:
    """What lies between A and B, difference A - B and ratio A/B; rates are crashes per test.

    ``rhw`` is the half-width of the difference over the larger of the two rates, ``rhw_from_pool`` what the pool's own
    error alone would leave of it; ``only_a`` and ``only_b`` are rates of cut-ins on which only one of the two crashes.
    """

    difference: float
    ci_low: float
    ci_high: float
    rhw: float
    rhw_from_pool: float
    ratio: float
    ratio_low: float
    ratio_high: float
    only_a: Interval
    only_b: Interval
    n_pairs: int
    n_differing: int

    @classmethod
    def of(cls, pairs: PairCounts, level: Level) -> Contrast:
        """Of the strata that ``pairs`` holds."""
        widths, alone = (pairs.rhw(level), pairs.rhw_from_pool(level)), (pairs.alone(0, level), pairs.alone(1, level))
        n_pairs = int(pairs.tests.sum())
        return cls(*pairs.difference(level), *widths, *pairs.ratio(level), *alone, n_pairs, pairs.n_differing)

    def to_json(self) -> dict[str, Any]:
        """Plain content."""
        of_one = {"only_a": self.only_a._asdict(), "only_b": self.only_b._asdict()}
        return finite_json(asdict(self) | of_one)


@dataclass(frozen=True)
class PairedEstimate:
    """Two vehicles compared: each by itself, and what lies between them.

    ``free`` is over all strata, ``conditional`` over those inside: if neither vehicle crashes beyond the boundary,
    ``refuted`` once one has.
    """

    a: Estimate
    b: Estimate
    free: Contrast
    conditional: Contrast
    refuted: bool
    pairs: PairCounts

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is to be known of the tests of either vehicle."""
        return tuple(f"{name}: {text}" for name, of in (("A", self.a), ("B", self.b)) for text in of.warnings)

    def to_json(self) -> dict[str, Any]:
        """Content of ``compare.json``, as far as it comes from counts."""
        return {
            "a": self.a.to_json(),
            "b": self.b.to_json(),
            **self.free.to_json(),
            "confidence": self.a.confidence,
            "conditional": {
                **self.conditional.to_json(),
                "boundary": self.pairs.design.library.boundary,
                "n_pairs_outside": self.free.n_pairs - self.conditional.n_pairs,
                "refuted": self.refuted,
            },
            "shells": _shells(self.pairs),
            "warnings": list(self.warnings),
        }


def paired_estimate(pairs: PairCounts, confidence: float) -> PairedEstimate:
    """Everything that pairs of tests say, at one level of confidence.

    Raises
    ------
    ValueError
        There is no pair.
    """
    level, n_inside = Level.two_sided(confidence), pairs.design.library.n_inside
    return PairedEstimate(
        a=_own(pairs, 0, confidence),
        b=_own(pairs, 1, confidence),
        free=Contrast.of(pairs, level),
        conditional=Contrast.of(pairs.inside(), level),
        refuted=any(pairs.tally(side).crashes[n_inside:].any() for side in (0, 1)),
        pairs=pairs,
    )


def _own(pairs: PairCounts, side: int, confidence: float) -> Estimate:
    tally = pairs.tally(side)
    worst = Shells.of(pairs.design, tally.failed_as_crashes())
    return BothWays(Shells.of(pairs.design, tally), worst, int(tally.failed.sum())).result(confidence)


def _shells(pairs: PairCounts) -> list[dict[str, Any]]:
    design, columns = pairs.design, ("n_both", "n_only_a", "n_only_b", "n_neither")
    failed = pairs.tally(0).failed + pairs.tally(1).failed
    return [
        {
            "shell": design.strata[s],
            "inside": s < design.library.n_inside,
            "p": float(design.p[s]),
            "n_pairs": int(pairs.tests[s]),
            **dict(zip(columns, row.tolist(), strict=True)),
            "n_failed_tests": int(failed[s]),
        }
        for s, row in enumerate(pairs.outcomes())
    ]


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
