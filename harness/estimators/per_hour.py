"""Several families of events in one answer: crashes per hour of driving, by one sum over the strata of all.

R = Σ_f e_f/p_f Σ_s p_fs θ_fs, e_f being how many events of a family there are in an hour, and p_f the probability of
one in a test. Strata of all families stand side by side, so that limits are those of one likelihood ratio, and narrower
than any sum of the families' own; pools are independent, so that their variances add. Exposures e_f are taken as they
are: what is counted and what assumed is said beside the answer, and by what the ratio moves over the assumed ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from harness.estimators.beside import limits_over, path_errors
from harness.estimators.likelihood import Counts, Level, likelihood_limit
from harness.estimators.shells import SeenShells
from harness.estimators.tally import FEWEST_PATHS, RateLimits, Tally, paths_that_count, pool_variance
from harness.estimators.traffic import LEAST_SHARE, mean_share
from harness.families.protocol import Exposure
from harness.strata import ASSUMPTION_FREE, Assumed
from harness.vocabulary import FloatArray

_GRID = 13
"""Places of each counted exposure at which the search for the outermost limit looks first; the middle is as counted."""


class FamilyTests(NamedTuple):
    """Tests of one family, how often its events are met, and by which ``reading`` the competent driver acts.

    A reading is a reference driver of the library by name; where it has none so called, its first one. ``assumed`` is
    what is assumed of who cuts in, which moves the probabilities of strata.
    """

    family: str
    exposure: Exposure
    seen: SeenShells
    reading: str = ""
    assumed: Assumed | None = None

    @property
    def per_hour(self) -> float:
        """Tests that an hour of driving stands for."""
        return self.exposure.per_hour / self.seen.design.p_counted

    @property
    def p(self) -> FloatArray:
        """Events of each stratum per hour, (S,)."""
        return self.per_hour * self.seen.design.p

    @property
    def tally(self) -> Tally:
        """Counts by stratum; of no test before the first."""
        return self.seen.tally

    @property
    def rate(self) -> float:
        """Crashes per hour."""
        return float(self.p @ self.tally.share)

    @property
    def reference(self) -> int:
        """Place of its reading among the library's references."""
        names = [each.name for each in self.seen.design.references]
        return names.index(self.reading) if self.reading in names else 0

    @property
    def reference_rate(self) -> float:
        """Crashes per hour of the competent driver; 0 where the library has none."""
        rates = self.seen.design.reference_rate
        return self.per_hour * float(rates[self.reference]) if rates.size else 0.0

    def over_assumed(self) -> list[tuple[float, float]]:
        """Rates per hour of the vehicle and of the competent driver, at all ends of what is assumed."""
        design, exposure = self.seen.design, self.exposure
        rates = [(self.rate, self.reference_rate)]
        if self.assumed is not None and self.assumed.highest is not None and self.assumed.times is not None:
            cells = design.cell_p * design.crashes_too(self.reference) if design.references else np.zeros(0)
            least = np.zeros(2)
            if mean_share(self.p, self.tally.share) < LEAST_SHARE:  # all of these may be of drivers who do not look
                least[1] = self.assumed.at_most * self.rate / self.events_moved[1]
            for times, at_least in zip(np.array(self.assumed.times) / self.events_moved[:, None], least, strict=True):
                theirs = self.reference_rate
                if cells.any():
                    theirs *= float(cells @ times[np.array(design.cell_stratum)] / cells.sum())
                rates.append((max(float(self.p * times @ self.tally.share), float(at_least)), theirs))
        ends = [1.0] if exposure.counted else [exposure.low / exposure.per_hour, exposure.high / exposure.per_hour]
        return [(end * mine, end * theirs) for end in ends for mine, theirs in rates]

    @property
    def events_moved(self) -> FloatArray:
        """Factors on the probability of an event at both ends of what is assumed (2,); an hour's events stay."""
        times = None if self.assumed is None else self.assumed.times
        return np.ones(2) if times is None else np.array(times) @ self.seen.design.p / self.seen.design.p.sum()

    def limits(self, level: Level) -> RateLimits:
        """Rate per hour of the family alone, with the error of ``p_counted``: at most a crash in every test."""
        limits = PerHour([self]).limits(level)
        return limits._replace(high=min(limits.high, self.per_hour))


class PerHour:
    """The sum over families; all of their strata, or those inside each library's boundary."""

    def __init__(self, families: Sequence[FamilyTests]) -> None:
        self.families = tuple(families)

    @property
    def rate(self) -> float:
        """Crashes per hour."""
        return math.fsum(family.rate for family in self.families)

    @property
    def reference_rate(self) -> float:
        """Crashes per hour of the competent driver."""
        return math.fsum(family.reference_rate for family in self.families)

    @property
    def totals(self) -> tuple[int, int, int]:
        """Tests, crashes and failed tests."""
        n, crashes, failed = map(sum, zip(*(family.tally.totals for family in self.families), strict=True))
        return n, crashes, failed

    def limits(self, level: Level, statement: str = ASSUMPTION_FREE) -> RateLimits:
        """Rate per hour with limits; these are 0 and infinity where crashes lie on too few paths of a pool."""
        parts = [(family, slice(0, family.seen.design.n_within(statement))) for family in self.families]
        tallies = [family.tally.part(strata) for family, strata in parts]
        events = [family.p[strata] for family, strata in parts]
        p = np.concatenate(events)
        rate = math.fsum(float(own @ tally.share) for own, tally in zip(events, tallies, strict=True))

        def limit(side: float, *, worst: bool) -> tuple[float, float]:
            counted = [tally.failed_as_crashes() if worst else tally for tally in tallies]
            variance = 0.0
            for (family, strata), tally in zip(parts, counted, strict=True):
                design = family.seen.design
                masses = design.p[strata]  # per test, as those of the tally
                if paths_that_count(masses, tally) < FEWEST_PATHS:
                    return math.inf, math.inf
                pool = pool_variance(masses, tally, design.n_independent)
                variance += family.per_hour**2 * pool + (design.p_event_error * family.rate) ** 2
            crashes = np.concatenate([tally.crashes for tally in counted])
            tests = np.concatenate([tally.tests for tally in counted])
            return likelihood_limit(p, crashes, tests, level, side, variance), variance

        (low, variance), (high, _) = limit(-1.0, worst=False), limit(1.0, worst=True)
        if math.isinf(variance):
            return RateLimits(rate, 0.0, math.inf, math.inf, 0.0)
        from_pool = level.z * math.sqrt(variance)
        return RateLimits(rate, max(low, 0.0), high, from_pool, from_pool)

    def limits_with_counts(
        self,
        level: Level,
        limits: Callable[[PerHour, Level], tuple[float, float]] = lambda hour, at: hour.limits(at)[1:3],
    ) -> tuple[float, float]:
        """Limits of the rate, or of something else, where counted exposures are as uncertain as their counts.

        After k events an exposure of x times the counted one costs k (x - 1 - ln x) of the threshold, the Poisson law's
        likelihood ratio. A limit is the outermost over all x of the limit at the rest of the threshold, which is that
        for few events, however many crashes there are. It may have several local extremes, one for each family without
        a crash, so that the search begins at the best place of a grid.
        """
        from scipy.optimize import minimize  # noqa: PLC0415 - slow to import, and seldom asked for

        counted = [family.exposure.counted[0] if family.exposure.counted else 0.0 for family in self.families]
        free = np.flatnonzero(counted)

        def limit(log_x: FloatArray, side: int) -> float:
            x = np.ones(len(self.families))
            x[free] = np.exp(log_x)
            lost = float(np.array(counted) @ (x - 1.0 - np.log(x)))
            if lost >= level.threshold:
                return math.inf
            rest = Level(level.threshold - lost, level.z * math.sqrt(1.0 - lost / level.threshold))
            scaled = zip(self.families, x.tolist(), strict=True)
            exposures = {family.family: family.exposure.per_hour * factor for family, factor in scaled}
            low, high = limits(self.with_exposures(exposures), rest)
            return low if side < 0 else -high

        if not free.size:
            return limits(self, level)
        scale = level.threshold / np.array(counted)[free]
        farthest = np.sqrt(2.0 * scale) + scale  # beyond, x alone costs more than the threshold
        grid = [farthest * at for at in product(np.linspace(-1.0, 1.0, _GRID), repeat=free.size)]

        def outermost(side: int) -> float:
            best = min(grid, key=lambda log_x: limit(log_x, side))
            simplex = best + np.vstack([np.zeros(free.size), np.diag(farthest / _GRID)])
            return float(minimize(limit, best, (side,), "Nelder-Mead", options={"initial_simplex": simplex}).fun)

        return outermost(-1), -outermost(1)

    def ratio(self, level: Level) -> tuple[float, float, float]:
        """Rate over that of the competent driver, with limits; NaN and any where that never crashes."""
        reference = self.reference_rate
        if reference <= 0.0 or math.isinf(self.limits(level).high):
            return (self.rate / reference if reference > 0.0 else math.nan), 0.0, math.inf
        low = self._ratio_limits(level, worst=False)[0]
        return self.rate / reference, low, self._ratio_limits(level, worst=True)[1]

    def _ratio_limits(self, level: Level, *, worst: bool) -> tuple[float, float]:
        errors = np.zeros(3)
        outcomes: list[Counts] = []
        for family in self.families:
            design, cells = family.seen.design, family.seen.cells
            cells = cells.failed_as_crashes() if worst else cells
            outcomes.append(cells.joined(design.joined).outcomes)
            errors_of_paths = path_errors(design, cells, family.reference if design.references else None)
            mine, theirs = family.rate, family.reference_rate
            errors += family.per_hour**2 * np.array(errors_of_paths)
            errors += design.p_event_error**2 * np.array((mine * mine, mine * theirs, theirs * theirs))
        p = np.concatenate([family.p for family in self.families])
        counts = np.concatenate(outcomes)
        return limits_over(self.reference_rate, p, counts.astype(np.float64), errors.tolist(), level)

    @property
    def first_reference(self) -> tuple[str, float] | None:
        """The competent driver of all, and its rate; None where that never crashes."""
        return ("", self.reference_rate) if self.reference_rate > 0.0 else None

    def expected(self, limit: float, driver: str | None, _statement: str) -> float:
        """Crashes that these tests would have brought at a limit per hour, or of a ``driver``; see `SeenShells`."""
        events = math.fsum(float(family.p.sum()) for family in self.families)
        return limit * (1.0 if driver is None else self.reference_rate) * self.totals[0] / events

    def beside(self, _driver: str, _statement: str, level: Level) -> tuple[float, float]:
        """Limits of `ratio`."""
        return self.ratio(level)[1:]

    def over_assumed(self) -> tuple[float, float] | None:
        """The least and the largest ratio over all ends of what is assumed.

        None where that driver never crashes, or in some family no test has: the rate there, and so the range, is open.
        """
        if not all(family.rate for family in self.families):
            return None
        ends = product(*(family.over_assumed() for family in self.families))
        sums = [[math.fsum(column) for column in zip(*rates, strict=True)] for rates in ends]
        ratios = [mine / theirs for mine, theirs in sums if theirs > 0.0]
        return (min(ratios), max(ratios)) if len(ratios) == len(sums) else None

    def rates_over_assumed(self) -> tuple[float, float] | None:
        """The least and the largest rate over all ends of what is assumed; None as in `over_assumed`."""
        if not all(family.rate for family in self.families):
            return None
        rates = [[mine for mine, _ in family.over_assumed()] for family in self.families]
        return math.fsum(map(min, rates)), math.fsum(map(max, rates))

    def limits_over_assumed(self, level: Level, *, ratio: bool) -> tuple[float, float]:
        """The outermost limits of the rate, or of `ratio`, over both ends of each assumed exposure."""
        exposures = {family.family: family.exposure for family in self.families}
        ends = ({family.per_hour} if family.counted else {family.low, family.high} for family in exposures.values())
        others = (self.with_exposures(dict(zip(exposures, chosen, strict=True))) for chosen in product(*ends))
        limits = [family.ratio(level)[1:] if ratio else family.limits(level)[1:3] for family in others]
        return min(low for low, _ in limits), max(high for _, high in limits)

    def with_exposures(self, exposures: Mapping[str, float]) -> PerHour:
        """The same tests with other exposures (events per hour), by family."""
        own = [own_exposure(family.exposure, exposures.get(family.family)) for family in self.families]
        return PerHour([family._replace(exposure=e) for family, e in zip(self.families, own, strict=True)])

    def to_json(self, confidence: float, speed_mps: float, *, counts: bool = False) -> dict[str, Any]:
        """All of it, as plain content; with ``counts`` those of counted exposures are in the interval of the sum."""
        level, (n, n_crashes, n_failed) = Level.two_sided(confidence), self.totals
        counts = counts and any(family.exposure.counted for family in self.families)
        limits = self.limits(level)
        if counts:
            limits = limits._replace(**dict(zip(("low", "high"), self.limits_with_counts(level), strict=True)))
        of_bound = Level.of_bound(confidence, n)
        bound = self.limits_with_counts(of_bound)[1] if counts else self.limits(of_bound).high
        per_km = 1e6 / (3.6 * speed_mps)  # of a million km, per hour
        names = dict.fromkeys(name for family in self.families for name in family.seen.design.readings) or [""]
        beside, *readings = (
            PerHour([family._replace(reading=name) for family in self.families])._beside(name, level, counts=counts)
            for name in names
        )
        return {
            "confidence": confidence, "n_episodes": n, "n_crashes": n_crashes, "n_failed": n_failed,
            "per_hour": {"rate": limits.rate, "ci_low": limits.low, "ci_high": limits.high, "upper_bound": bound,
                         "rhw": limits.rhw, "over_assumed": self.rates_over_assumed()},
            "counts_in_interval": counts, "mean_speed_mps": speed_mps, "per_1e6_km": limits.rate * per_km,
            "beside": beside, "readings": readings,
            "families": dict(self._families(confidence)),
        }  # fmt: skip

    def _beside(self, reference: str, level: Level, *, counts: bool) -> dict[str, Any]:
        ratio, low, high = self.ratio(level)
        if counts and math.isfinite(high):
            low, high = self.limits_with_counts(level, lambda hour, at: hour.ratio(at)[1:])
        over = self.over_assumed()
        limits = None if over or math.isnan(ratio) else self.limits_over_assumed(level, ratio=True)
        return {
            "reference": reference, "rate_per_hour": self.reference_rate, "ratio": ratio, "ratio_low": low,
            "ratio_high": high, "over_assumed": over, "limits_over_assumed": limits,
        }  # fmt: skip

    def _families(self, confidence: float) -> Iterator[tuple[str, dict[str, Any]]]:
        level, total = Level.two_sided(confidence), self.rate
        for family in self.families:
            limits, (n, n_crashes, n_failed) = family.limits(level), family.tally.totals
            ratio, low, high = PerHour([family]).ratio(level)
            yield family.family, {
                "exposure": {**family.exposure._asdict()}, "p_event": family.seen.design.p_counted,
                "n_episodes": n, "n_crashes": n_crashes, "n_failed": n_failed,
                "rate_per_hour": limits.rate, "ci_low": limits.low, "ci_high": limits.high,
                "upper_bound": family.limits(Level.of_bound(confidence, n)).high,
                "share": limits.rate / total if total > 0.0 else math.nan,
                "reference_rate_per_hour": family.reference_rate, "ratio": ratio, "ratio_low": low, "ratio_high": high,
            }  # fmt: skip


def own_exposure(shipped: Exposure, per_hour: float | None) -> Exposure:
    """The shipped exposure, or the user's own, which is taken to be known."""
    if per_hour is None:
        return shipped
    return Exposure(per_hour, per_hour, per_hour, None, "given")
