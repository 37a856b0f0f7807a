"""What a run answers: ``estimates.json``, and the sentences that are functions of estimates and decisions."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from harness.campaign.campaign import Campaign
from harness.campaign.sections import LEAST_POOL_ERROR, MOST_CUT_INS
from harness.estimators.block import CUT_OFF_STEPS, DANGER_TTC_S, Block
from harness.estimators.estimate import WIDE_RHW, Estimate, Number, Point, Unavailable, finite_json
from harness.estimators.likelihood import Level
from harness.estimators.one_pass import one_pass
from harness.estimators.severity import Severity
from harness.estimators.short_answer import ShortAnswer, assumed_times, no_lower_limit, short_answer
from harness.estimators.stopping import RoundRule, Rule, limit_words
from harness.estimators.traffic import TrafficError
from harness.importance.functions import importance_names
from harness.numbers import interval, number, plain, ratio, share, two_digits_up
from harness.records.folder import StoppedBy
from harness.strata import LIBRARY_STATEMENT
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import ESTIMATORS, RUN_FOLDER, EstimatorName

_PER_KM = 1e6
SCOPE = "The interval is about sampling error in this environment, not about how well the environment matches the road."
MENDS: dict[str, str] = {
    "episodes": "stop.episodes was spent; raise it and go on with --resume",
    "pool": "all cut-ins that the pool keeps of a shell were tested",
    "pool_error": "the pool's own error alone is wider",
}
"""Why a campaign ended before its precision, and the mend; of a pool it is `pool_remedy`."""
ROOM = 1.25
"""Tests go in steps, and not to all shells alike: beyond those that would just do [measured: 1.15 at most]."""
TOO_WIDE = (
    f" A relative half-width above {WIDE_RHW:g} is reached by chance: stopping at the first such interval makes "
    "rates too high on the mean. Ask for a smaller stop.rhw."
)


@dataclass(frozen=True)
class Estimates:
    """Content of ``estimates.json``, as it is written here and the page reads it; without a crash no severity."""

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
    statement: str
    statements: dict[str, str]
    reference_statements: tuple[str, ...]
    boundary_statements: dict[str, str]
    scope: str
    answer: ShortAnswer
    severity: Severity | None = None
    ending: str | None = None
    decision: dict[str, Any] | None = None
    traffic: TrafficError | None = None


def estimate_blocks(
    blocks: Iterable[Block],
    campaign: Campaign,
    manifest: Mapping[str, Any],
    *,
    estimators: Collection[EstimatorName] | None = None,
    confidence: float | None = None,
) -> dict[str, Any]:
    """Estimates of blocks that cover a campaign's episodes, as JSON content.

    Blocks are contiguous and in index order; ``manifest`` is the run's, of which nothing but ``campaign_hash`` need be
    known. Nothing is said per km where it has no ``distance_per_test_m``, the mean distance that the AV drives in a
    naturalistic test. ``estimators`` are reported beside the method's own, all by default; ``confidence`` is the level
    of the intervals, by default the campaign's.
    """
    done = one_pass(blocks, estimators or ESTIMATORS, confidence=confidence or campaign.stop.confidence)
    best = done.headline_estimate
    estimates = {done.headline: best, **done.estimates}
    level, distance_m = campaign.environment.lane_change_level, manifest.get("distance_per_test_m")
    distance_km = None if distance_m is None else distance_m / 1000.0
    repeated = manifest.get("repeated")
    about = level, distance_km, campaign.crash.counts_above_mps
    statements: dict[str, str] = {name: _answer(of, repeated, *about) for name, of in estimates.items()}
    cut_off = 0.0 if done.severity is None else done.severity.cut_off
    statements[done.headline] = _answer(best, repeated, *about, cut_off)
    return finite_json(
        Estimates(
            campaign=campaign.name,
            campaign_hash=manifest["campaign_hash"],
            lane_change_level=level,
            confidence=best.confidence,
            n_episodes=best.n_episodes,
            n_crashes=best.n_crashes,
            headline=done.headline,
            distance_per_test_km=distance_km,
            crash_rate_per_1e6_km=None if distance_km is None else per_distance(best, distance_km),
            estimates={name: of.shown if isinstance(of, Estimate) else of for name, of in estimates.items()},
            diagnostics=done.diagnostics.result(importance_names(campaign)),
            convergence=tuple(done.convergence),
            statement=statements[done.headline],
            statements=statements,
            reference_statements=tuple(reference_statements(best)),
            boundary_statements=boundary_statements(best),
            scope=" ".join([*_assumed(best, manifest), SCOPE]),
            answer=short_answer(campaign, best, done.severity, manifest, distance_km, done.diagnostics.counts),
            severity=done.severity,
            ending=manifest.get("ending"),
            decision=manifest.get("decision"),
        )
    )


def _assumed(best: Estimate, manifest: Mapping[str, Any]) -> list[str]:
    if (times := assumed_times(best, manifest)) is None:
        return []
    given, what = manifest["assumed"], "rate" if best.n_crashes else "limit"
    if "where" in given:
        told = f"In the data of this traffic no lane change was seen at {given['where']}: the {what} may be"
        carries = no_lower_limit(best, manifest) is not None
        return [f"{told} {ratio(times[0])} to {ratio(times[1])} times this one."] if carries else []
    low, high = (plain(end) for end in given["ends"])
    return [
        f"If as few or as many drivers do not look as data allow ({given['name']} {low} or {high}, not "
        f"{plain(given['value'])}), the {what} is {ratio(times[0])} or {ratio(times[1])} times this one."
    ]


def _answer(
    found: Estimate | Unavailable,
    repeated: Mapping[str, Any] | None,
    level: float,
    distance_km: float | None,
    counts_above_mps: float,
    cut_off: float = 0.0,
) -> str:
    """What an estimator says, led by what it must be warned of and the first reference driver; or why it cannot.

    ``repeated`` is what tests that ran twice have come to, where some did; ``cut_off`` the rate of those that ended too
    soon.
    """
    if isinstance(found, Unavailable):
        return f"No crash rate from these records: {found.reason.rstrip('.')}."
    text = " ".join([*reference_statements(found)[:1], statement(found, level, distance_km, counts_above_mps)])
    text += failed_statement(found.details)
    if cut_off > 0.0:
        text += (
            f" Tests that ended within {STEP_S * CUT_OFF_STEPS:g} s of a cut-in, less than {DANGER_TTC_S:g} s from a "
            "collision, count as no crash: had they all crashed, the rate would be "
            f"{number(found.crash_rate + cut_off)}."
        )
    if learned := found.details.get("learned"):
        text += f" The stratum learned is where a surrogate of this vehicle crashes, learned from {learned}."
    if repeated is None or not (n := repeated["n_episodes"]):
        return text
    if not (n_differing := len(repeated["differing"])):
        return f"{text} {n:,} of these tests were run a second time: same bits."
    different = (
        f"{n_differing:,} of {n:,} tests that were run a second time DIFFERED: this vehicle is not reproducible; its "
        "tests cannot be replayed, and depend on what ran beside and before them"
    )
    return warned([different], text)


def warned(cautions: Iterable[str], text: str) -> str:
    """The text, with what may be wrong about it first."""
    return " ".join([*(f"WARNING: {caution.rstrip('.')}." for caution in cautions), text])


def per_distance(estimate: Estimate, distance_per_test_km: float) -> dict[str, float]:
    """Crash rate and interval per 1e6 km of such overtaking driving."""
    scale = _PER_KM / distance_per_test_km
    return {"rate": estimate.crash_rate * scale, "ci_low": estimate.ci_low * scale, "ci_high": estimate.ci_high * scale}


def statement(
    estimate: Estimate, lane_change_level: float, distance_per_test_km: float | None, counts_above_mps: float = 0.0
) -> str:
    """Why the interval may be wrong, if it may; then rate, interval, number of tests and level, in words."""
    tests = (
        f"{estimate.n_episodes:,} overtaking tests at lane-change level {plain(lane_change_level)} "
        f"({estimate.n_crashes:,} sampled crashes)"
    )
    level, per_km, what = share(estimate.confidence), "", "The crash rate"
    if counts_above_mps:
        what = f"The rate of crashes above {plain(counts_above_mps)} m/s"
    if estimate.n_crashes == 0:
        upper = estimate.upper_bound
        if distance_per_test_km:
            per_km = f", or {number(upper * _PER_KM / distance_per_test_km)} per million km of such driving"
        text = f"No crash was sampled in {tests}: with {level} confidence the rate is below {number(upper)} per test"
    else:
        side, end = ("above", "ci_low") if estimate.is_open_above else ("below", "ci_high")
        if distance_per_test_km:
            scaled = per_distance(estimate, distance_per_test_km)
            per_million_km = interval(scaled["ci_low"], scaled["ci_high"], scaled["rate"])
            if estimate.is_wide:
                per_million_km = f"{side} {number(scaled[end])}"
            per_km = f"; that is {per_million_km} crashes per million km of such overtaking driving"
        rate, within = number(estimate.crash_rate), interval(estimate.ci_low, estimate.ci_high)
        also = "" if estimate.cautions else f", relative half-width {share(estimate.rhw)}"
        if estimate.is_wide:
            rate, also = f"{side} {number(getattr(estimate, end))}", f"; {rate} was seen"
        text = f"{what} is {rate} per test ({level} interval {within}{also}), estimated from {tests}"
    return warned(estimate.cautions, f"{text}{per_km}.")


def failed_statement(found: Mapping[str, Any]) -> str:
    """What failed tests (``details``) would change, as a sentence to follow the answer; empty without any."""
    if not found["n_failed"]:
        return ""
    return (
        f" Of these tests {found['n_failed']:,} FAILED: they count as no crash in the rate and as crashes in the upper "
        f"limit. Had they all crashed, the rate would be {number(found['crash_rate_if_failed_had_crashed'])}."
    )


def reference_statements(estimate: Estimate) -> list[str]:
    """How the vehicle compares with each reference driver, a sentence each; none unless drawn from shells."""
    references, level = estimate.details.get("references", ()), share(estimate.confidence)
    return [_beside(found, level, wide=estimate.is_wide) for found in references if found["crash_rate"] > 0.0]


def _beside(found: Mapping[str, Any], level: str, *, wide: bool) -> str:
    who = f"{found['described']} ({found['reference']})"
    if found["ratio"] == 0.0 or (wide and found["ratio_high"] < 1.0):
        seen = "no crash was sampled"
        if found["ratio"] > 0.0:
            seen = f"{ratio(found['ratio'])} times was seen, and {ratio(found['ratio_low'])} is the lower end"
        return (
            f"In the same traffic this vehicle crashes less than {ratio(found['ratio_high'])} times as often as {who} "
            f"would (upper end of the {level} interval): {seen}."
        )
    low, high = found["preventable_low"], found["preventable_high"]
    return (
        f"This vehicle crashes {ratio(found['ratio'])} times as often as {who} would in the same traffic ({level} "
        f"interval {ratio(found['ratio_low'])} to {ratio(found['ratio_high'])}); {share(found['preventable'])} of its "
        f"crashes such a driver would have avoided ({share(low)} to {share(high)})."
    )


def boundary_statements(estimate: Estimate) -> dict[str, str]:
    """What holds for vehicles that crash only within the boundary; none unless drawn from shells."""
    details, level = estimate.details, share(estimate.confidence)
    found = details.get("within")
    return {} if found is None else {LIBRARY_STATEMENT: _within(found, len(details["shells"]), level)}


def _within(found: Mapping[str, Any], n_shells: int, level: str) -> str:
    if found["refuted"]:
        return (
            f"It is NOT so that this vehicle {found['assumes']}: it crashed in "
            f"{found['n_crashes_outside']:,} of {found['n_episodes_outside']:,} tests beyond {found['boundary']}, "
            f"first in {_replayed(found['refuted_by'])}."
        )
    if math.isinf(found["rhw_from_pool"]):
        return "Under an assumption about where it crashes nothing more can be said: its crashes lie on too few paths."
    text = (
        f"If this vehicle {found['assumes']}, its crash rate is {number(found['crash_rate'])} per test "
        f"({level} interval {interval(found['ci_low'], found['ci_high'])}), estimated from "
        f"{found['n_episodes']:,} tests ({found['n_crashes']:,} sampled crashes).{failed_statement(found)}"
    )
    return f"{text} {_outside(found, n_shells, level)}"


def _outside(found: Mapping[str, Any], n_shells: int, level: str) -> str:
    if found["n_shells"] == n_shells:
        return "Nothing lies outside."
    if not found["n_episodes_outside"]:
        return "Nothing was tested outside: whether the assumption holds is not known."
    failed = found["n_failed_outside"]
    counted = f", but {failed:,} of them FAILED and are counted as crashes here" if failed else ""
    return (
        f"There was no crash in {found['n_episodes_outside']:,} tests outside{counted}: with {level} confidence "
        f"fewer than {number(found['upper_bound_outside'])} crashes per test lie there."
    )


def _replayed(episodes: Sequence[int]) -> str:
    """The first of some tests, and how to see it."""
    return f"episode {episodes[0]} (harness replay {RUN_FOLDER} {episodes[0]})"


def conclusion(campaign: Campaign, rule: Rule, n_episodes: int) -> tuple[StoppedBy, str]:
    """Why a campaign ended after so many tests, also in a sentence."""
    look, budget = rule.look, campaign.stop.episodes
    stopped_by: StoppedBy = "pool"
    if look.stopped:
        stopped_by = "accept" if look.decision is not None else "rhw" if look.below is None else "below_reference"
        stopped_by = getattr(rule, "ended", None) or stopped_by
    elif look.pool_error_above_target:  # whatever else is spent: more of it would not help
        stopped_by = "pool_error"
    elif n_episodes >= budget:
        stopped_by = "episodes"
    after, unmet = f"Stopped after {n_episodes:,} tests", " and ".join(look.unmet)
    mend = MENDS.get(stopped_by, "")
    if remedy := pool_remedy(rule, campaign, stopped_by):
        mend += f"; {remedy}, and use a new folder"
    if look.below is not None:
        limit = limit_words(look.below.limit, look.below.driver)
        why = f"with confidence {plain(look.below.confidence)} the crash rate is below {limit} (stop.below_reference)"
    elif look.stopped:
        why = f"the last condition to be met was {unmet}" if unmet else "every condition was met at the first look"
    elif campaign.stop.rhw is not None or look.unmet:
        after, why = f"{after} without {unmet}", mend
        if campaign.has_baseline_runs and stopped_by in ("episodes", "pool_error"):
            why = _runs_or_tests(rule, campaign, n_episodes) or why
    else:
        why = "stop.episodes was all that was asked for" if stopped_by == "episodes" else mend
    wide = stopped_by == "rhw" and campaign.sampling.strata and (campaign.stop.rhw or 0.0) > WIDE_RHW
    return stopped_by, f"{after}: {why}." + (TOO_WIDE if wide else "")


def pool_remedy(rule: Rule, campaign: Campaign, stopped_by: StoppedBy) -> str:
    """What is to be changed of a pool that ended a run, and to what where that is known; empty where none has.

    Paths leave 1/√2 of the asked precision, and the shells keep what the tests then take, as `expected_for` has it.
    """
    if stopped_by not in ("pool", "pool_error"):
        return ""
    pool, target, from_pool = campaign.pool, campaign.stop.rhw, rule.look.rhw_from_pool
    if campaign.has_baseline_runs or target is None or not isinstance(rule, RoundRule) or math.isinf(rule.look.rhw):
        paths = "raise pool.shadow_paths" if campaign.has_baseline_runs else "lower pool.relative_error"
        return paths if stopped_by == "pool_error" else "raise pool.cut_ins_per_shell"
    finer = max(2.0 * (from_pool / target) ** 2, 1.0)
    times = rule.seen.cut_ins_for(rule.more_tests(target, finer) * ROOM)
    own = target / math.sqrt(2.0) / Level.two_sided(campaign.stop.confidence).z  # a pool has some paths in any case
    error = min(pool.relative_error / math.sqrt(finer), own)
    kept = two_digits_up(min(pool.cut_ins_per_shell * times, 1e9))
    if error < LEAST_POOL_ERROR or kept > MOST_CUT_INS:
        return "no pool gives as much: ask for a wider stop.rhw"
    changes = [f"lower pool.relative_error to {math.floor(error * 1e4) / 1e4:g}"] if finer > 1.0 else []
    return " and ".join(changes + [f"raise pool.cut_ins_per_shell to {kept:,}"] * (times > 1.0))


def _runs_or_tests(rule: Rule, campaign: Campaign, n_tests: int) -> str | None:
    """Which of baseline runs and tests are too few for the precision that is asked, and how many of both it may take.

    What the runs leave may be all that is asked over √2; what the tests then do is expected from their limits.
    """
    n_runs, pool = campaign.pool.shadow_paths, rule.look.rhw_from_pool
    if (needed := expected_for(rule, campaign, n_tests)) is None:
        return None
    runs, tests = needed["runs"], needed["tests"]
    found = f"{n_runs:,} baseline runs alone leave ±{share(pool)} of the rate, of ±{share(rule.look.rhw)} in all"
    if runs == n_runs:
        return f"{found}: tests are too few; raise stop.episodes to about {tests:,} and go on with --resume"
    what = "baseline runs" if tests == n_tests else "both"
    return f"{found}: {what} are too few; some {runs:,} (pool.shadow_paths) and {tests:,} tests may do, in a new folder"


def expected_for(rule: Rule, campaign: Campaign, n_tests: int) -> dict[str, int] | None:
    """How many baseline ``runs`` and ``tests`` in all the asked precision may take; None where nobody can tell."""
    target, n_runs, pool = campaign.stop.rhw, campaign.pool.shadow_paths, rule.look.rhw_from_pool
    if not campaign.has_baseline_runs or not isinstance(rule, RoundRule) or target is None or not 0.0 < pool < math.inf:
        return None
    more_runs = max(2.0 * (pool / target) ** 2, 1.0)
    if math.isinf(more_tests := rule.more_tests(target, more_runs)):
        return None  # a stratum that cannot be tested: nothing will do
    runs, tests = two_digits_up(n_runs * more_runs), two_digits_up(n_tests * more_tests)
    return {"runs": n_runs if more_runs == 1.0 else runs, "tests": n_tests if more_tests <= 1.0 else tests}
