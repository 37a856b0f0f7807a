"""What estimators and stop rules say by codes, in words: a sentence or phrase for each kind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from string import Formatter
from typing import Any

from harness.estimators.estimate import BoundKind, CapKind, Estimate, IntervalKind, Note
from harness.numbers import number, share
from harness.vocabulary import EstimatorName

MOST_NAMED = 12
RATES: Mapping[EstimatorName | str, str] = {
    "nde": "share of crashes",
    "nade": "mean of weighted crashes",
    "mixture_cv": "mean of weighted crashes with the episode mixture's known-mean control variates",
    "dr": "mean of weighted crashes less the luck that a surrogate knows of (doubly robust)",
    "scv": "sparse control variates as published (Algorithm 1)",
    "shells": "crashes within shells of known probability",
}
INTERVALS: Mapping[IntervalKind, str] = {
    "clopper_pearson": "Clopper-Pearson interval",
    "normal": "normal interval",
    "skewed": "normal interval, widened for skewness (Hall)",
    "likelihood_ratio": "likelihood-ratio limits of their weighted sum",
}
BOUNDS: Mapping[BoundKind, str] = {
    "one_sided": "the same, one-sided",
    "two_sided": "the same, as an interval's upper limit",
    "hoeffding": "Hoeffding's for the mean of Y, with {cap}; without a crash Clopper-Pearson times that cap",
}
CAPS: Mapping[CapKind, str] = {
    "design": "the weight cap known by design",
    "tests": "the largest weight that the tests driven could have had",
    "none": "no cap",
}

_MAY_BE_ABOVE = "the true rate may lie far above this interval"
_DRAWN_BY = "; these were drawn by {method}"
NOTES = {
    "failed": "{n} of {of} tests failed; the rate and the lower limit count them as no crash, the upper limits as "
    "crashes",
    # cautions: why an interval may be wrong
    "contradicts_design": "the records contradict the campaign: a crash weighs {weight:.6g}, more than the design's "
    "{cap:.6g}",
    "unbounded": f"{_MAY_BE_ABOVE}: the weights of these tests are unbounded",
    "one_more_adds": _MAY_BE_ABOVE + ": one more crash might add {times:number} times it",
    "one_may_weigh": _MAY_BE_ABOVE + ": a crash may weigh {cap:number}, and all that were seen together weigh "
    "{seen:number}",
    "negative": "the rate is negative: too few crashes for control variates, use nade",
    "published_scv": "this interval is known to be too narrow; use nade's (docs/scv-defect.md). The published variance "
    "is not that of this estimator: columns centred by their sample means leave the estimate equal to nade's, and "
    "var(Z) leaves out the error of those means",
    "few_paths": "no interval: nearly all crashes lie on some {n:.0f} of the {of:,} paths that the vehicle was driven "
    "along, and {least:.0f} are needed; raise pool.shadow_paths, to some {needed:,} or more, and run into a new folder",
    # of weighted tests
    "few_crashes": "only {n} crashes were sampled (below {least}): the interval is rough",
    "few_effective": "effective sample size {n:.3g} is below {least:g}: few weights carry the estimate",
    "one_carries": "one crash carries {share:.0%} of the estimate",
    "bound_rests": "the upper bound rests on {cap:cap}, not on a cap guaranteed by design",
    "one_more_moves": "one more crash of the largest possible weight would raise the rate by {by:number}, farther than "
    "the interval reaches: only more tests can rule that out",
    "plain_width": "fewer than {least:.0f} effective crashes: the interval is as wide as that of the plain mean of "
    "weighted crashes",
    "due_not_drawn": "on some paths surrogates predict crashes of large weight that were not drawn: tests vary "
    "{times:.2g} times as much as their crashes show, and the rate of `nade` is too low, or its interval too narrow. "
    "Use shells",
    "saturated": "{n} of {of} strata are saturated (l = {levels:first}): with as many independent columns as tests, "
    "less one, any results are fitted. The gain claimed in all is {claimed:.3g}, and {corrected:.3g} with degrees of "
    "freedom",
    # of shells
    "untested": "no test in {shells}: the interval allows for any share of crashes there",
    "runs_leave_nothing": "the lower limit is 0 in spite of {n:,} crashes: {runs:,} baseline runs alone leave "
    "±{alone:share} of the rate, as far as these can tell",
    "used_up": "the pool has no further event of {shells}: for more raise pool.events_per_shell, in a new folder",
    "refuted": "{n:,} crashes outside the library, beyond {boundary}: none of its statements holds for this vehicle",
    "own": "an estimator of your own: nobody has measured how often its interval covers",
    # why an estimator has no value
    "needs_own": "is for tests drawn by {methods}, as it says itself" + _DRAWN_BY,
    "needs_nde": "a share of crashes needs naturalistic tests (method nde)" + _DRAWN_BY,
    "needs_nade": "shares of crashes within shells must be added by the shells' probabilities (estimator shells)"
    + _DRAWN_BY,
    "needs_mixture_cv": "needs the episode mixture: it alone has control variates of known means without heavy tails"
    + _DRAWN_BY,
    "needs_dr": "needs a mixture of surrogates' importance functions (step_mixture, episode_mixture)" + _DRAWN_BY,
    "needs_tests": "needs {least:,} tests, as with fewer ({n:,}) its intervals miss too often",
    "needs_scv": "is defined for the step mixture ([paper] section III-C)" + _DRAWN_BY,
    "needs_shells": "tests must be drawn from shells (testing.method shells)" + _DRAWN_BY,
    "needs_moments": "needs the control steps of every test: set records.moments to first_9 or all",
    # what a stop rule waits for
    "rhw": "stop.rhw ({target:g})",
    "rhw_of_difference": "stop.rhw ({target:g}, of the difference)",
    "one_more_crash": "stop.rhw ({target:g}) for one more crash of the largest possible weight",
    "min_crashes": "stop.min_crashes ({least:,})",
    "first_tests": "the first tests of each shell (testing.shells.first_tests)",
    "second_look": "the same at a second look",
    "below_reference": "stop.below_reference ({limit:g})",
    "accept": "accept.{asked} ({limit:g})",
    "sign": "who crashes less often",
    "margin": "--margin ({margin:g})",
}


class _Words(Formatter):
    """Specifications ``number`` and ``share`` are the functions of these names; ``cap`` and ``first`` are ours."""

    def format_field(self, value: Any, spec: str) -> str:
        match spec:
            case "number":
                return number(value)
            case "share":
                return share(value)
            case "cap":
                return CAPS[value]
            case "first":
                value = [*value[:MOST_NAMED], *["…"] * (len(value) > MOST_NAMED)]
        if isinstance(value, list | tuple):
            return ", ".join(map(str, value))
        return str(super().format_field(math.nan if value is None else value, spec))


def note_words(note: Note | Mapping[str, Any]) -> str:
    """A note, or one from JSON, in words."""
    note = note if isinstance(note, Note) else Note(**note)
    own = note.key.replace("{", "{{").replace("}", "}}")  # of an estimator of one's own: the sentence itself
    return _Words().vformat(NOTES.get(note.key, own), (), note.numbers)


def method_words(estimate: Estimate, estimator: str) -> str:
    """How rate, interval and upper bound of an estimate were made."""
    bound = BOUNDS[estimate.bound].format(cap=CAPS[estimate.cap])
    return f"{RATES.get(estimator, estimator)}; {INTERVALS[estimate.interval]}; upper bound: {bound}"
