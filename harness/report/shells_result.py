"""What a run with `testing.method: shells` found in each shell, as ``estimates.json`` has it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from harness.errors import RunFolderError

SHOWN_IN_SECTION = frozenset(
    ("shells", "conditional", "boundary", "pool", "p_cut_in", "p_impossible", "rhw_from_pool", "rhw_from_pool_at_least")
)
"""Details of the estimate that have a place of their own on the page."""
NEGLIGIBLE = 1e-9
"""Differences of this share, of P(cut-in) or of a squared width, come from rounding."""


@dataclass(frozen=True)
class Shell:
    """One shell: its probability per test, what was counted, and limits of the share of cut-ins that crash."""

    name: str
    inside: bool
    p: float
    n_tests: int
    n_crashes: int
    n_failed: int
    share: float
    share_low: float
    share_high: float
    contribution: float

    @property
    def low(self) -> float:
        """Lower limit of the contribution to the crash rate."""
        return self.p * self.share_low

    @property
    def high(self) -> float:
        """Upper limit of the contribution to the crash rate."""
        return self.p * self.share_high

    @property
    def half_width(self) -> float:
        """Half of the distance of the limits: what this shell alone leaves open of the crash rate."""
        return (self.high - self.low) / 2.0


@dataclass(frozen=True)
class Conditional:
    """The rate if nothing crashes outside the boundary, and what is known about outside."""

    rate: float
    low: float
    high: float
    rhw: float | None
    n_tests: int
    n_tests_outside: int
    n_crashes_outside: int
    n_failed_outside: int
    refuted: bool
    upper_bound_outside: float


@dataclass(frozen=True)
class ShellsResult:
    """Shells from careful to careless, and the pool that they come from."""

    shells: tuple[Shell, ...]
    conditional: Conditional
    rate: float
    rhw_from_pool: float
    boundary: str
    pool: str
    p_cut_in: float
    p_impossible: float

    @property
    def p_tested(self) -> float:
        """Probability of a cut-in that belongs to a shell."""
        return math.fsum(shell.p for shell in self.shells)

    @property
    def nothing_left_out(self) -> bool:
        """Whether every cut-in belongs to a shell; rounding may leave a trace of nothing."""
        return self.p_impossible <= NEGLIGIBLE * self.p_cut_in

    @property
    def n_failed(self) -> int:
        """Number of tests that failed."""
        return sum(shell.n_failed for shell in self.shells)

    @property
    def has_outside(self) -> bool:
        """Whether there are cut-ins beyond the boundary."""
        return any(not shell.inside for shell in self.shells)

    @property
    def pool_half_width(self) -> float:
        """What the pool's own error leaves open."""
        return self.rhw_from_pool * self.rate

    def share_of_uncertainty(self, half_width: float) -> float:
        """Share in the sum of squared half-widths, which is what makes the interval of the rate."""
        squares = math.fsum(s.half_width**2 for s in self.shells) + self.pool_half_width**2
        return half_width**2 / squares if squares > 0.0 else math.nan


def shells_result(estimates: dict[str, Any]) -> ShellsResult | None:
    """Read what the headline estimate says about shells; None where tests were drawn otherwise.

    Raises
    ------
    RunFolderError
        If a part of it is missing.
    """
    head = estimates["estimates"][estimates["headline"]]
    details = head.get("details") or {}
    if "shells" not in details:
        return None
    try:
        return ShellsResult(
            shells=tuple(_shell(content) for content in details["shells"]),
            conditional=_conditional(details["conditional"]),
            rate=float(head["crash_rate"]),
            rhw_from_pool=float(details["rhw_from_pool"]),
            boundary=str(details["boundary"]),
            pool=str(details["pool"]),
            p_cut_in=float(details["p_cut_in"]),
            p_impossible=float(details["p_impossible"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RunFolderError(
            "estimates.json",
            found=f"no complete description of shells ({error!r})",
            expected="what `harness estimate` writes for a run with testing.method shells",
            mend="Make it again with `harness estimate DIR --write`.",
        ) from error


def _shell(content: dict[str, Any]) -> Shell:
    return Shell(
        name=str(content["shell"]),
        inside=bool(content["inside"]),
        p=float(content["p"]),
        n_tests=int(content["n_episodes"]),
        n_crashes=int(content["n_crashes"]),
        n_failed=int(content["n_failed"]),
        share=float(content["crash_share"]),
        share_low=float(content["crash_share_low"]),
        share_high=float(content["crash_share_high"]),
        contribution=float(content["contribution"]),
    )


def _conditional(content: dict[str, Any]) -> Conditional:
    return Conditional(
        rate=float(content["crash_rate"]),
        low=float(content["ci_low"]),
        high=float(content["ci_high"]),
        rhw=content["rhw"],
        n_tests=int(content["n_episodes"]),
        n_tests_outside=int(content["n_episodes_outside"]),
        n_crashes_outside=int(content["n_crashes_outside"]),
        n_failed_outside=int(content["n_failed_outside"]),
        refuted=bool(content["refuted"]),
        upper_bound_outside=float(content["upper_bound_outside"]),
    )
