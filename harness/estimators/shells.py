"""`shells`: crashes counted within shells of known probability p_s, and the two statements that they allow.

The assumption-free statement counts every shell, tested or empty. The conditional one holds for vehicles that crash
only where the boundary surrogate, or a more careful one, crashes too: it needs far fewer tests, and one crash outside
refutes it.

The rate is Σ p_s c_s. Each crash share c_s has its own exact (Clopper-Pearson) limits; they are combined by the method
of variance estimates recovery (MOVER; G. Y. Zou and A. Donner, Statistics in Medicine 27, 2008, 1693): the distance of
each limit of the sum is the root of the summed squares of the terms' distances, and the error of the p_s. A stratum
without a crash widens the upper limit only.

Tests that failed count as no crash in the rate and in every lower limit, as crashes in every upper one: the limits are
monotone in each stratum's crashes, so that [L(k), U(k + f)] holds whatever the f failed tests would have come to.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from harness.arrays import FloatArray, IntArray
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, require_episodes
from harness.estimators.intervals import clopper_pearson
from harness.strata import ShellDesign


class Limits(NamedTuple):
    """A rate with a lower and an upper limit, and the half-width that the error of the p_s would leave for itself.

    ``from_pool`` takes the shares as they were seen, ``from_pool_at_least`` their lower limits: one crash in a rarely
    tested stratum, where paths are few, can make the former large for a while.
    """

    rate: float
    low: float
    high: float
    from_pool: float
    from_pool_at_least: float

    @property
    def rhw(self) -> float:
        """Half of the interval's length over the rate; infinite at rate 0."""
        return (self.high - self.low) / 2.0 / self.rate if self.rate > 0.0 else math.inf

    def from_pool_relative(self) -> dict[str, float]:
        """The pool's part of `rhw`, and what of it more tests of the same pool will not take away; 0 at rate 0."""
        rate = self.rate if self.rate > 0.0 else math.inf
        return {"rhw_from_pool": self.from_pool / rate, "rhw_from_pool_at_least": self.from_pool_at_least / rate}


def pool_variance(share: FloatArray, moments: FloatArray, rate: float, n_paths: int) -> float:
    """Variance of Σ p_s c_s that comes from the pool's finite number of paths.

    A path contributes at most its whole probability in the part of the strata in which the vehicle crashes. If its
    crashes were spread over paths, the mean square would be Σ c_s c_t m_st; if they were the same paths in all strata,
    Σ min(c_s, c_t) m_st. The latter is taken: an upper bound for a vehicle whose crashes do not favour the paths of
    largest probability within a shell. A stratum in which no crash was seen adds nothing.
    """
    worst = float((np.minimum(share[:, None], share[None, :]) * moments).sum())
    return max(worst - rate * rate, 0.0) / n_paths


def combined(
    p: FloatArray,
    crashes: IntArray,
    tests: IntArray,
    moments: FloatArray,
    n_paths: int,
    tail: float,
    failed: IntArray | int = 0,
) -> Limits:
    """Rate Σ p_s c_s with limits that leave out ``tail`` at each end.

    Parameters
    ----------
    p : ndarray, shape (S,)
        Probabilities of the strata.
    crashes, tests, failed : ndarray of int64, shape (S,)
    moments, n_paths
        Of the pool, see `pool_variance`.
    """
    if np.any(failed):
        worst = combined(p, crashes + failed, tests, moments, n_paths, tail)
        return combined(p, crashes, tests, moments, n_paths, tail)._replace(high=worst.high)
    share = crashes / np.maximum(tests, 1)
    low, high = clopper_pearson(crashes, tests, tail)
    rate = float(p @ share)
    z = -float(ndtri(tail))
    pool = z * z * pool_variance(share, moments, rate, n_paths)
    down = math.sqrt(((p * (share - low)) ** 2).sum() + pool)
    up = math.sqrt(((p * (high - share)) ** 2).sum() + pool)
    at_least = z * math.sqrt(pool_variance(low, moments, float(p @ low), n_paths))
    return Limits(rate, max(rate - down, 0.0), min(rate + up, 1.0), math.sqrt(pool), at_least)


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
    """Tests, crashes and failed tests of each stratum, arrays of shape (S,)."""

    _design: ShellDesign  # of the first block

    def __init__(self) -> None:
        self.tests = self.crashes = self.failed = np.zeros(0, np.int64)

    @classmethod
    def refusal(cls, block: Block) -> str | None:
        """Shells must have been drawn from, and their probabilities be known."""
        if block.shells is None or block.stratum is None:
            return f"tests must be drawn from shells (testing.method shells), these were drawn by {block.method}"
        return None

    def add(self, block: Block) -> None:
        """Count one block."""
        if block.shells is None or block.stratum is None:
            raise ValueError("the block has no shells")
        n_strata = block.shells.p.size
        if not self.tests.size:
            self._design = block.shells
            self.tests, self.crashes, self.failed = np.zeros((3, n_strata), np.int64)
        self.tests += np.bincount(block.stratum, minlength=n_strata)
        self.crashes += np.bincount(block.stratum[block.crash], minlength=n_strata)
        self.failed += np.bincount(block.stratum[block.failed], minlength=n_strata)

    def result(self, confidence: float) -> Estimate:
        """Assumption-free estimate; the conditional one is among its details."""
        n = int(self.tests.sum())
        require_episodes(n)
        design, tail = self._design, (1.0 - confidence) / 2.0
        free, tests = self._limits(slice(None), tail), np.maximum(self.tests, 1)
        share = self.crashes / tests
        y = design.p / tests  # contribution of one crash, up to the factor n
        squares = float((self.crashes * y * y).sum())
        variance = float((design.p**2 * share * (1.0 - share) / tests).sum())
        variance += pool_variance(share, design.moments, free.rate, design.n_paths)
        return Estimate(
            crash_rate=free.rate,
            std_error=math.sqrt(variance),
            ci_low=free.low,
            ci_high=free.high,
            upper_bound=self._limits(slice(None), 1.0 - confidence).high,
            confidence=confidence,
            rhw=free.rhw,
            n_episodes=n,
            n_crashes=int(self.crashes.sum()),
            n_effective=free.rate**2 / squares if squares > 0.0 else 0.0,
            largest_weight_share=float(np.max(y[self.crashes > 0], initial=0.0)) / free.rate if free.rate > 0 else 0.0,
            method="crashes within shells of known probability; Clopper-Pearson limits per shell, combined (MOVER); "
            "upper bound: the same, one-sided",
            warnings=tuple(self._warnings()),
            details=asdict(
                ShellDetails(
                    boundary=design.boundary,
                    pool=design.pool,
                    **free.from_pool_relative(),
                    p_cut_in=design.p_cut_in,
                    p_impossible=design.p_impossible,
                    conditional=self._conditional(confidence),
                    shells=self._shells(tail),
                )
            ),
        )

    def _limits(self, strata: slice, tail: float) -> Limits:
        design, crashes, tests, failed = self._design, self.crashes[strata], self.tests[strata], self.failed[strata]
        return combined(design.p[strata], crashes, tests, design.moments[strata, strata], design.n_paths, tail, failed)

    def _conditional(self, confidence: float) -> Conditional:
        """The statement given that there are no crashes outside, and what is known about those."""
        p, within, outside = self._design.p, slice(0, self._design.n_inside), slice(self._design.n_inside, None)
        inside = self._limits(within, (1.0 - confidence) / 2.0)
        _, high = clopper_pearson(self.crashes[outside], self.tests[outside], 1.0 - confidence, self.failed[outside])
        worst_share = (self.crashes + self.failed) / np.maximum(self.tests, 1)
        crashes_outside = int(self.crashes[outside].sum())
        return Conditional(
            crash_rate=inside.rate,
            ci_low=inside.low,
            ci_high=inside.high,
            rhw=inside.rhw,
            **inside.from_pool_relative(),
            n_episodes=int(self.tests[within].sum()),
            n_crashes=int(self.crashes[within].sum()),
            n_failed=int(self.failed[within].sum()),
            crash_rate_if_failed_had_crashed=float(p[within] @ worst_share[within]),
            n_episodes_outside=int(self.tests[outside].sum()),
            n_crashes_outside=crashes_outside,
            n_failed_outside=int(self.failed[outside].sum()),
            refuted=crashes_outside > 0,
            upper_bound_outside=float((p[outside] * high).sum()),
        )

    def _shells(self, tail: float) -> tuple[Shell, ...]:
        p, share = self._design.p, self.crashes / np.maximum(self.tests, 1)
        low, high = clopper_pearson(self.crashes, self.tests, tail, self.failed)
        return tuple(
            Shell(
                shell=name,
                inside=s < self._design.n_inside,
                p=float(p[s]),
                n_episodes=int(self.tests[s]),
                n_crashes=int(self.crashes[s]),
                n_failed=int(self.failed[s]),
                crash_share=float(share[s]),
                crash_share_low=float(low[s]),
                crash_share_high=float(high[s]),
                contribution=float(p[s] * self.crashes[s] / max(self.tests[s], 1)),
            )
            for s, name in enumerate(self._design.strata)
        )

    def _warnings(self) -> list[str]:
        design, found = self._design, []
        if empty := ", ".join(name for name, n in zip(design.strata, self.tests, strict=True) if n == 0):
            found.append(f"no test in {empty}: the interval allows for any share of crashes there")
        kept = zip(design.strata, self.tests, design.available, strict=False)
        if used_up := ", ".join(name for name, n, available in kept if n >= available > 0):
            found.append(
                f"all cut-ins that the pool has kept of {used_up} were tested: for more precision raise "
                "pool.cut_ins_per_shell, and run into a new folder"
            )
        if crashes := int(self.crashes[design.n_inside :].sum()):
            found.append(
                f"{crashes} crashes where {design.boundary} does not crash: the conditional statement does not hold "
                "for this vehicle"
            )
        return found
