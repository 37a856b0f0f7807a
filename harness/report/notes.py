"""What estimators note beside a rate (`harness.estimators.estimate.Note`), in words: one sentence for each kind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from string import Formatter
from typing import Any

from harness.estimators.estimate import Note
from harness.numbers import number, share

_MAY_BE_ABOVE = "the true rate may lie far above this interval"
NOTES = {
    "failed": "{n} of {of} episodes failed; the rate and the lower limit count them as no crash, the upper limits as "
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
    "bound_rests": "the upper bound rests on {origin}, not on a cap guaranteed by design",
    "one_more_moves": "one more crash of the largest weight that the design allows ({cap:.3g}) would move the estimate "
    "by {by:.3g}, farther than the interval reaches: only more tests can rule that out",
    "plain_width": "fewer than {least:.0f} effective crashes: the interval is as wide as that of the plain mean of "
    "weighted crashes",
    "saturated": "{n} of {of} strata are saturated (l = {levels}): with as many independent columns as tests, less "
    "one, any results are fitted. The gain claimed in all is {claimed:.3g}, and {corrected:.3g} with degrees of "
    "freedom",
    # of shells
    "untested": "no test in {shells}: the interval allows for any share of crashes there",
    "runs_leave_nothing": "the lower limit is 0 in spite of {n:,} crashes: {runs:,} baseline runs alone leave "
    "±{alone:share} of the rate, as far as these can tell",
    "used_up": "all cut-ins that the pool has kept of {shells} were tested",
    "refuted": "{n:,} crashes beyond {boundary}: statement library does not hold for this vehicle",
}


class _Words(Formatter):
    """Format specifications ``number`` and ``share`` are the functions of these names."""

    def format_field(self, value: Any, spec: str) -> str:
        if isinstance(value, list | tuple):
            return ", ".join(map(str, value))
        if spec in ("number", "share"):
            return number(value) if spec == "number" else share(value)
        return str(super().format_field(math.nan if value is None else value, spec))


def note_words(note: Note | Mapping[str, Any]) -> str:
    """A note, or one from JSON, as a sentence."""
    of = note if isinstance(note, Note) else Note(**note)
    return _Words().vformat(NOTES.get(of.key, of.key.replace("{", "{{").replace("}", "}}")), (), of.numbers)
