"""What a run answers, ``estimates.json``; why it ended, and what would have led further."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from harness.campaign.campaign import Campaign
from harness.campaign.sections import LEAST_POOL_ERROR, MOST_EVENTS
from harness.estimators.block import ACTS, Block
from harness.estimators.estimate import Estimate, Note, Number, Point, Unavailable, finite_json
from harness.estimators.likelihood import Level
from harness.estimators.one_pass import AnyEstimator, headline_of, one_pass
from harness.estimators.severity import Severity
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import Rule
from harness.estimators.traffic import LEAST_SHARE, TrafficError, mean_share
from harness.families import family_named
from harness.numbers import two_digits_up
from harness.strata import Assumed, weight_of_a_test
from harness.vocabulary import ESTIMATORS, StoppedBy

ROOM = 1.25
"""Tests go in steps, and not to all shells alike: beyond those that would just do [measured: 1.15 at most]."""
MOVES = 1.25
"""Factor from which it is said by how much assumed numbers move a ratio [assumed]."""
CARRIES = 0.05
"""Share of a rate from which on there is an upper limit alone, where nothing was seen of it [assumed]."""


@dataclass(frozen=True)
class AssumedOfRate:
    """What is assumed of the traffic, see `Assumed`.

    ``times`` are the factors of the rate at both ends, ``ratio_times`` those of its ratio to the reference driver.
    """

    where: str
    highest: float | None
    times: tuple[float, float] | None
    share: float | None = None
    ratio_times: tuple[float, float] | None = None

    @property
    def most(self) -> float:
        """The factor by which the rate may be higher; NaN where it is not known."""
        return math.nan if self.times is None else self.times[1]

    @property
    def moves_ratio(self) -> bool:
        """Whether the ratio depends notably on how many drivers do not look."""
        return self.highest is not None and any(not 1.0 / MOVES < times < MOVES for times in self.ratio_times or ())

    @property
    def no_lower_limit(self) -> bool:
        """Whether a notable part of the rate comes from lane changes of which none was seen."""
        return bool(self.where) and self.times is not None and self.times[1] - self.times[0] >= CARRIES


@dataclass(frozen=True)
class Elsewhere:
    """Tests of one traffic that answer for another; ``off`` is by how much rates of ``drivers`` come out wrong then."""

    tested_in: str
    answered_for: str
    drivers: tuple[str, ...]
    off: float


@dataclass(frozen=True)
class Estimates:
    """Content of ``estimates.json``, as it is written here and the page reads it; without a crash no severity.

    ``unmet`` are the conditions of the stop rule that were met last, or not at all; ``traffic`` is what replicates
    leave open, ``milder`` see `harness.sampling.paths.milder_of`; ``cut_off`` is the rate of tests that ended with
    the AV about to crash (`Block`), ``cut_off_test`` the first of them.
    """

    campaign: str
    campaign_hash: str
    lane_change_level: float
    confidence: float
    n_episodes: int
    n_crashes: int
    headline: str
    distance_per_test_km: float | None
    crash_rate_per_1e6_km: dict[str, Number] | None
    estimates: dict[str, Estimate | Unavailable]
    diagnostics: dict[str, Any]
    convergence: tuple[Point, ...]
    severity: Severity | None = None
    cut_off: float = 0.0
    cut_off_test: int | None = None
    assumed: AssumedOfRate | None = None
    stopped_by: StoppedBy | None = None
    unmet: tuple[Note, ...] = ()
    decision: dict[str, Any] | None = None
    traffic: TrafficError | None = None
    elsewhere: Elsewhere | None = None
    milder: dict[str, Any] | None = None

    @property
    def best(self) -> Estimate:
        """The estimate that answers the campaign's question."""
        estimate = self.estimates[self.headline]
        assert isinstance(estimate, Estimate)
        return estimate


STORED_ESTIMATES = TypeAdapter(Estimates)


def estimate_blocks(
    blocks: Iterable[Block],
    campaign: Campaign,
    manifest: Mapping[str, Any],
    *,
    estimators: Collection[AnyEstimator] | None = None,
    confidence: float | None = None,
) -> dict[str, Any]:
    """Estimates of blocks that cover a campaign's episodes, as JSON content.

    Blocks are contiguous and in index order; ``manifest`` is the run's, of which nothing but ``campaign_hash`` need be
    known. Without its ``distance_per_test_m``, the mean distance of the AV in a naturalistic test, nothing is said per
    km. ``estimators`` are reported beside the campaign's own, all by default; ``confidence`` replaces the campaign's.
    """
    confidence = confidence or campaign.stop.confidence
    own = headline_of(campaign)
    done = one_pass(blocks, estimators or ESTIMATORS, own, confidence, manifest.get("onset_step"))
    best = done.headline_estimate
    level = campaign.environment.lane_change_level
    distance_m = manifest.get("distance_per_test_m")
    distance_km = None if distance_m is None else distance_m / 1000.0
    rates = ("rate", best.crash_rate), ("ci_low", best.ci_low), ("ci_high", best.ci_high)
    estimates = Estimates(
        campaign=campaign.name, campaign_hash=manifest["campaign_hash"], lane_change_level=level,
        confidence=best.confidence, n_episodes=best.n_episodes, n_crashes=best.n_crashes, headline=done.headline,
        distance_per_test_km=distance_km,
        crash_rate_per_1e6_km=None if distance_km is None else {key: 1e6 / distance_km * rate for key, rate in rates},
        estimates={name: each.shown if isinstance(each, Estimate) else each for name, each in done.estimates.items()},
        diagnostics=done.diagnostics.result(), convergence=tuple(done.convergence),
        severity=done.severity, cut_off=done.cut_off, cut_off_test=done.cut_off_test,
        assumed=_of_rate(Assumed(**manifest["assumed"]), best) if manifest.get("assumed") else None,
        stopped_by=manifest.get("stopped_by"), unmet=tuple(Note(**each) for each in manifest.get("unmet", ())),
        decision=manifest.get("decision"), milder=manifest.get("milder"),
    )  # fmt: skip
    return finite_json(estimates)


def _of_rate(assumed: Assumed, best: Estimate) -> AssumedOfRate:
    """The factors by which the rate moves over what is assumed; without a crash, those of its upper limit.

    Where a vehicle crashes on few events of the shells that it crashes in, these may all be of drivers who do not look.
    """
    times, of_ratio, shells = None, None, best.details.get("shells")
    if assumed.times is not None and shells:
        p, n, share = np.array([(shell["p"], shell["n_episodes"], shell["crash_share"]) for shell in shells]).T
        masses = p * np.vstack([np.ones_like(p), *map(np.array, assumed.times)])
        # Without a crash the upper limit comes from one stratum: that in which a crash would weigh most.
        rates = masses @ share if best.n_crashes else weight_of_a_test(masses, n.astype(np.int64)).max(1)
        times = float(rates[1] / rates[0]), float(rates[2] / rates[0])
        if mean_share(p, share) < LEAST_SHARE:
            times = times[0], max(times[1], assumed.at_most)
        elif best.n_crashes and assumed.reference_times is not None:
            of_ratio = times[0] / assumed.reference_times[0], times[1] / assumed.reference_times[1]
    return AssumedOfRate(assumed.where, assumed.highest, times, assumed.share, of_ratio)


def before_event(campaign: Campaign, manifest: Mapping[str, Any], counts: Mapping[str, int]) -> dict[str, Any]:
    """In how many tests a vehicle did each of `ACTS`; ``waits`` says whether it holds its speed while BV comes."""
    waits = bool(manifest.get("events_show")) and not campaign.av.acts_before_event
    acts = {name: counts.get(name, 0) for name in ("n_events", *(f"n_{act}" for act in ACTS))}
    own = {"source": campaign.av.source, "built_in": campaign.av.model is not None}
    return {**own, "tried_script": manifest.get("tried_script"), "waits": waits, **acts}


MANY = 0.1
"""Share of tests from which on a vehicle itself makes events milder [assumed]."""


def n_softened(acts: Mapping[str, Any]) -> int:
    """Tests whose event a vehicle (`before_event`) made milder, by falling behind or braking before; 0 if few."""
    n = max(acts["n_fell_behind"], acts["n_braked_before"] if acts["waits"] else 0)
    return n if n > MANY * acts["n_events"] and not acts["built_in"] else 0


def ended_by(campaign: Campaign, rule: Rule, n_episodes: int) -> StoppedBy:
    """Why a campaign ended after so many tests."""
    look = rule.look
    if look.ended is not None:
        return look.ended
    if look.pool_error_above_target:  # whatever else is spent: more of it would not help
        return "pool_error"
    return "episodes" if n_episodes >= campaign.stop.episodes else "pool"


def pool_remedy(rule: Rule, campaign: Campaign, stopped_by: StoppedBy) -> dict[str, float | None] | None:
    """Which settings of the pool to change after it ended a run, and to what; None where the value is not known.

    None if it was not the pool that ended the run, empty if no pool would lead further. Paths are to leave 1/√2 of the
    asked precision, and the shells to keep as many events as the tests then take, see `expected_for`.
    """
    if stopped_by not in ("pool", "pool_error"):
        return None
    pool, target, seen = campaign.pool, campaign.stop.rhw, rule.seen
    if campaign.has_baseline_runs or target is None or not isinstance(seen, SeenShells) or math.isinf(rule.look.rhw):
        paths = "pool.shadow_paths" if campaign.has_baseline_runs else "pool.relative_error"
        return {paths if stopped_by == "pool_error" else "pool.events_per_shell": None}
    finer = max(2.0 * (rule.look.rhw_from_pool / target) ** 2, 1.0)
    level = Level.two_sided(campaign.stop.confidence)
    times = seen.events_for(seen.more_tests(campaign.testing.shells.statement, level, target, finer) * ROOM)
    own_error = target / math.sqrt(2.0) / level.z  # a pool has some paths in any case
    error = min((pool.relative_error or family_named(campaign.scenario).pool_error) / math.sqrt(finer), own_error)
    events = two_digits_up(min(pool.events_per_shell * times, 1e9))
    if error < LEAST_POOL_ERROR or events > MOST_EVENTS:
        return {}
    changes: dict[str, float | None] = {"pool.relative_error": math.floor(error * 1e4) / 1e4} if finer > 1.0 else {}
    return changes | ({"pool.events_per_shell": events} if times > 1.0 else {})


def expected_for(rule: Rule, campaign: Campaign, n_tests: int) -> dict[str, int] | None:
    """How many baseline ``runs`` and ``tests`` in all the asked precision may take; None where nobody can tell."""
    target, from_pool, seen = campaign.stop.rhw, rule.look.rhw_from_pool, rule.seen
    if not (campaign.has_baseline_runs and isinstance(seen, SeenShells) and target and 0.0 < from_pool < math.inf):
        return None
    n_runs, level = campaign.pool.shadow_paths, Level.two_sided(campaign.stop.confidence)
    more_runs = max(2.0 * (from_pool / target) ** 2, 1.0)
    if math.isinf(more_tests := seen.more_tests(campaign.testing.shells.statement, level, target, more_runs)):
        return None  # a stratum that cannot be tested: nothing will do
    runs, tests = two_digits_up(n_runs * more_runs), two_digits_up(n_tests * more_tests)
    return {"runs": n_runs if more_runs == 1.0 else runs, "tests": n_tests if more_tests <= 1.0 else tests}
