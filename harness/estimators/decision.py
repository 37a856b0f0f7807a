"""Whether a crash rate lies below a limit, by an interval that is looked at after each round."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from harness.strata import ASSUMPTION_FREE

Verdict = Literal["accepted", "rejected", "undecided"]
LOOKS = 1.0
"""A limit is decided at a level that leaves out so many times less than the campaign's, as it is looked at after each
round."""


def decision_confidence(confidence: float) -> float:
    """Level of the interval that has to lie on one side of the limit."""
    return 1.0 - (1.0 - confidence) / LOOKS


@dataclass(frozen=True)
class Decision:
    """What is known about a limit.

    Attributes
    ----------
    crash_rate_below : float
        The limit, per test.
    statement : str
        Which statement decides.
    confidence : float
        That the crash rate lies on the side which is said: half of what the campaign's intervals leave out is missing.
    low, high : float
        The interval that was looked at.
    """

    crash_rate_below: float
    statement: str
    confidence: float
    low: float
    high: float

    @property
    def verdict(self) -> Verdict:
        """On which side of the limit the interval lies."""
        if self.high < self.crash_rate_below:
            return "accepted"
        return "rejected" if self.low > self.crash_rate_below else "undecided"

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        given = "" if self.statement == ASSUMPTION_FREE else f", given statement {self.statement},"
        level, limit = f"{self.confidence:.3g}", f"{self.crash_rate_below:.3g}"
        if self.verdict == "undecided":
            between = f"it may be {self.low:.3g} as well as {self.high:.3g}"
            return f"UNDECIDED: whether the crash rate{given} is below {limit} per test is not known; {between}."
        side, shown = ("below", self.high) if self.verdict == "accepted" else ("above", self.low)
        word = "upper" if side == "below" else "lower"
        return (
            f"{self.verdict.upper()}: with confidence {level} the crash rate{given} is {side} {limit} per test "
            f"({word} limit {shown:.3g})."
        )

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        return {"verdict": self.verdict, **asdict(self), "sentence": self.sentence}
