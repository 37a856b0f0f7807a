"""Whether a crash rate lies below a limit, by an interval that is looked at after each round.

Looks inflate errors, and limits by the likelihood ratio are wider than a level needs where crashes are few. What is
left is measured: decisions are wrong in at most 1 % where 5 % are allowed (docs/gate.md).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from harness.strata import ASSUMPTION_FREE

Verdict = Literal["accepted", "rejected", "undecided"]


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
        That the crash rate lies on the side which is said: an interval leaves out half as much there as at both sides.
    low, high : float
        The interval.
    contradicted : bool
        Whether a test has shown that the vehicle does not do what the statement assumes. Its upper limit then says
        nothing, while what crashed, crashed.
    """

    crash_rate_below: float
    statement: str
    confidence: float
    low: float
    high: float
    contradicted: bool = False

    @property
    def verdict(self) -> Verdict:
        """On which side of the limit the interval lies, if that can be said."""
        if self.low > self.crash_rate_below:
            return "rejected"
        return "accepted" if self.high < self.crash_rate_below and not self.contradicted else "undecided"

    @property
    def is_final(self) -> bool:
        """Whether further tests would change nothing."""
        return self.verdict != "undecided" or self.high < self.crash_rate_below

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        given = "" if self.statement == ASSUMPTION_FREE else f", given statement {self.statement},"
        level, limit = f"{self.confidence:.3g}", f"{self.crash_rate_below:.3g}"
        if self.contradicted and self.verdict == "undecided":
            return (
                f"UNDECIDED: whether the crash rate is below {limit} per test is not known: the vehicle does not do "
                f"what statement {self.statement} assumes. Ask for accept.statement: {ASSUMPTION_FREE}, and use a new "
                "folder."
            )
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
