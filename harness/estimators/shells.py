"""`shells`: crashes counted within shells of known probability p_s, and the two statements that they allow.

The assumption-free statement counts every shell, tested or empty. The conditional one holds for vehicles that crash
only where the boundary surrogate, or a more careful one, crashes too: it needs far fewer tests, and one crash outside
refutes it.

The rate is Σ p_s c_s, c_s being the share of a stratum's tests that crash. Its limits are those of the likelihood
ratio (`harness.estimators.likelihood_ratio`), with the error of the p_s in the same root. A stratum without a crash
widens the upper limit only.
Failed tests count against the vehicle (`harness.estimators.stratified`).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from harness.estimators.block import Block
from harness.estimators.crash_paths import FEWEST_PATHS, CrashPaths
from harness.estimators.estimate import Estimate, require_episodes
from harness.estimators.intervals import clopper_pearson
from harness.estimators.likelihood_ratio import Level, likelihood_limit
from harness.estimators.stratified import Limits, Tally, combined, empty_tally, pool_variance
from harness.strata import ShellDesign


@dataclass(frozen=True)
class Shell:
    """One shell: its probability per test, what was counted, and limits of the share of cut-ins that crash."""

    shell: str
    inside: bool
    p: float
    n_episodes: int
    n_crashes: int
    n_failed: int
    crash_share: float
    crash_share_low: float
    crash_share_high: float
    contribution: float

    @property
    def low(self) -> float:
        """Lower limit of the contribution to the crash rate."""
        return self.p * self.crash_share_low

    @property
    def high(self) -> float:
        """Upper limit of the contribution to the crash rate."""
        return self.p * self.crash_share_high

    @property
    def half_width(self) -> float:
        """What this shell alone leaves open of the crash rate."""
        return (self.high - self.low) / 2.0


@dataclass(frozen=True)
class Conditional:
    """The rate given that there are no crashes outside the boundary, and what is known about those."""

    crash_rate: float
    ci_low: float
    ci_high: float
    rhw: float | None
    rhw_from_pool: float
    rhw_from_pool_at_least: float
    n_episodes: int
    n_crashes: int
    n_failed: int
    crash_rate_if_failed_had_crashed: float
    n_episodes_outside: int
    n_crashes_outside: int
    n_failed_outside: int
    refuted: bool
    upper_bound_outside: float


@dataclass(frozen=True)
class ShellDetails:
    """``details`` of the estimate: shells from careful to careless, and the pool that they come from."""

    boundary: str
    pool: str
    rhw_from_pool: float
    rhw_from_pool_at_least: float
    p_cut_in: float
    p_impossible: float
    conditional: Conditional
    shells: tuple[Shell, ...]


class Shells:
    """Tests of a shells campaign, counted within strata.

    Attributes
    ----------
    tally : Tally
        Of no strata before the first block.
    """

    _design: ShellDesign  # of the first block

    def __init__(self) -> None:
        self.tally = empty_tally(0)
        self._paths = CrashPaths()

    @classmethod
    def of(cls, design: ShellDesign, tally: Tally) -> Shells:
        """From counts."""
        shells = cls()
        shells._design, shells.tally = design, tally
        return shells

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Shells must have been drawn from, and their probabilities be known."""
        if block.shells is None or block.stratum is None:
            return f"tests must be drawn from shells (testing.method shells), these were drawn by {block.method}"
        return None

    def add(self, block: Block) -> None:
        """Count one block."""
        if block.shells is None or block.stratum is None or block.cell_mass is None:
            raise ValueError("the block has no shells")
        if not self.tally.tests.size:
            self._design = block.shells
            self.tally = empty_tally(block.shells.p.size)
        tally, mass = self.tally, block.cell_mass @ block.shells.joined
        np.add.at(tally.tests, block.stratum, 1)
        for rows, counts, sums in (
            (block.crash, tally.crashes, tally.crash_mass),
            (block.failed, tally.failed, tally.failed_mass),
        ):
            np.add.at(counts, block.stratum[rows], 1)
            np.add.at(sums, block.stratum[rows], mass[rows])
        if block.shells.shadow_runs:
            crashed = block.crash
            self._paths.add(block.cell_mass[crashed], block.stratum[crashed], block.shells.p.size)

    def result(self, confidence: float) -> Estimate:
        """Assumption-free estimate; the conditional one is among its details."""
        tally, design = self.tally, self._design
        n = int(tally.tests.sum())
        require_episodes(n)
        free, share, y = self._limits(tally, Level.two_sided(confidence)), tally.share, design.p / tally.at_least_one
        squares = float((tally.crashes * y * y).sum())
        variance = float((design.p * y * share * (1.0 - share)).sum()) + pool_variance(design.p, tally, design.n_paths)
        return Estimate(
            crash_rate=free.rate,
            std_error=math.sqrt(variance),
            ci_low=free.low,
            ci_high=free.high,
            upper_bound=self._limits(tally, Level.one_sided(confidence, n)).high,
            confidence=confidence,
            rhw=free.rhw,
            n_episodes=n,
            n_crashes=int(tally.crashes.sum()),
            n_effective=free.rate**2 / squares if squares > 0.0 else 0.0,
            largest_weight_share=float(np.max(y[tally.crashes > 0], initial=0.0)) / free.rate if free.rate > 0 else 0.0,
            method="crashes within shells of known probability; likelihood-ratio limits of their weighted sum; upper "
            "bound: the same, one-sided",
            warnings=(*self._cautions(), *self._warnings()),
            cautions=tuple(self._cautions()),
            details=asdict(
                ShellDetails(
                    boundary=design.boundary,
                    pool=design.pool,
                    **free.from_pool_relative(),
                    p_cut_in=design.p_cut_in,
                    p_impossible=design.p_impossible,
                    conditional=self._conditional(confidence),
                    shells=self._shells((1.0 - confidence) / 2.0),
                )
            ),
        )

    def _limits(self, tally: Tally, level: Level) -> Limits:
        """Of the first strata, those of a tally; anything is possible where crashes lie on too few paths."""
        p = self._design.p[: tally.tests.size]
        if self._n_paths(tally) < FEWEST_PATHS:
            return Limits(float(p @ tally.share), 0.0, 1.0, math.inf, math.inf)
        return combined(p, tally, self._design.n_paths, level)

    def _n_paths(self, tally: Tally) -> float:
        """Number of paths that the crashes in the first strata, those of a tally, lie on, in effect."""
        weight = np.zeros_like(self._design.p)
        weight[: tally.tests.size] = self._design.p[: tally.tests.size] / tally.at_least_one
        return self._paths.number(weight)

    def _cautions(self) -> list[str]:
        if (n := self._n_paths(self.tally)) >= FEWEST_PATHS:
            return []
        return [
            f"no interval: nearly all crashes lie on some {max(n, 1.0):.0f} of the {self._design.n_paths:,} paths that "
            f"the vehicle was driven along, and {FEWEST_PATHS:.0f} are needed; raise pool.shadow_paths, and run into a "
            "new folder"
        ]

    def _conditional(self, confidence: float) -> Conditional:
        """The statement given that there are no crashes outside, and what is known about those."""
        design, inside = self._design, self.tally.part(slice(0, self._design.n_inside))
        outside = self.tally.part(slice(design.n_inside, None)).failed_as_crashes()
        limits, n_outside = self._limits(inside, Level.two_sided(confidence)), int(outside.tests.sum())
        p_outside, level = design.p[design.n_inside :], Level.one_sided(confidence, n_outside)
        n_failed_outside = int(self.tally.failed[design.n_inside :].sum())
        n_crashes_outside = int(outside.crashes.sum()) - n_failed_outside
        return Conditional(
            crash_rate=limits.rate,
            ci_low=limits.low,
            ci_high=limits.high,
            rhw=limits.rhw,
            **limits.from_pool_relative(),
            n_episodes=int(inside.tests.sum()),
            n_crashes=int(inside.crashes.sum()),
            n_failed=int(inside.failed.sum()),
            crash_rate_if_failed_had_crashed=float(design.p[: design.n_inside] @ inside.failed_as_crashes().share),
            n_episodes_outside=n_outside,
            n_crashes_outside=n_crashes_outside,
            n_failed_outside=n_failed_outside,
            refuted=n_crashes_outside > 0,
            upper_bound_outside=likelihood_limit(p_outside, outside.crashes, outside.tests, level, 1.0),
        )

    def _shells(self, tail: float) -> tuple[Shell, ...]:
        p, tally = self._design.p, self.tally
        low, high = clopper_pearson(tally.crashes, tally.tests, tail, tally.failed)
        return tuple(
            Shell(
                shell=name,
                inside=s < self._design.n_inside,
                p=float(p[s]),
                n_episodes=int(tally.tests[s]),
                n_crashes=int(tally.crashes[s]),
                n_failed=int(tally.failed[s]),
                crash_share=float(tally.share[s]),
                crash_share_low=float(low[s]),
                crash_share_high=float(high[s]),
                contribution=float(p[s] * tally.share[s]),
            )
            for s, name in enumerate(self._design.strata)
        )

    def _warnings(self) -> list[str]:
        design, found = self._design, []
        if empty := ", ".join(name for name, n in zip(design.strata, self.tally.tests, strict=True) if n == 0):
            found.append(f"no test in {empty}: the interval allows for any share of crashes there")
        kept = zip(design.strata, self.tally.tests, design.available, strict=False)
        if used_up := ", ".join(name for name, n, available in kept if n >= available > 0):
            found.append(
                f"all cut-ins that the pool has kept of {used_up} were tested: for more precision raise "
                "pool.cut_ins_per_shell, and run into a new folder"
            )
        if crashes := int(self.tally.crashes[design.n_inside :].sum()):
            found.append(
                f"{crashes} crashes where {design.boundary} does not crash: the conditional statement does not hold "
                "for this vehicle"
            )
        return found
