"""A run says which condition decided when it ended."""

from __future__ import annotations

from dataclasses import replace

import pytest

from harness.campaign.sections import Stop
from harness.estimators import StopRule
from harness.estimators.answer import ending
from tests.estimators.test_stopping import passing


def looked_at(looks: list[dict], **stop) -> StopRule:
    rule = StopRule(Stop(episodes=200 * len(looks), rhw=0.3, **stop), "forced", range(200, 10_000, 200))
    for n, changes in zip(rule.looks, looks, strict=True):
        if rule.observe(n, replace(passing(n), **changes)):
            break
    return rule


FEW, WIDE, HEAVY = {"n_crashes": 5}, {"rhw": 0.4}, {"weight_cap": 1e9}
WRONG = {"cautions": ("unbounded",)}


@pytest.mark.parametrize(
    ("looks", "reached", "unmet"),
    [
        ([{}, {}], True, ()),
        ([WIDE, FEW, {}, {}], True, ("stop.min_crashes (50)",)),
        ([FEW, WIDE, {}, {}], True, ("stop.rhw (0.3)",)),
        ([HEAVY, {}, {}], True, ("stop.rhw (0.3) for one more crash of the largest possible weight",)),
        ([WIDE | FEW, WIDE | FEW], False, ("stop.rhw (0.3)", "stop.min_crashes (50)")),
        ([WIDE, {}], False, ("the same at a second look",)),
        ([WRONG, WRONG, WRONG], False, ("stop.rhw (0.3)",)),
    ],
)
def test_the_rule_remembers_what_was_missing(looks, reached, unmet):
    rule = looked_at(looks, min_crashes=50)
    assert (rule.look.stopped, rule.look.unmet) == (reached, unmet)


POOL_SPENT = "all cut-ins that the pool keeps of a shell were tested; raise pool.cut_ins_per_shell and use a new folder"
BOTH = ("stop.rhw (0.1)", "stop.min_crashes (50)")


@pytest.mark.parametrize(
    ("stopped_by", "unmet", "sentence"),
    [
        ("rhw", BOTH[1:], ": the last condition to be met was stop.min_crashes (50)."),
        ("rhw", (), ": every condition was met at the first look."),
        ("episodes", None, ": stop.episodes was all that was asked for."),
        (
            "episodes",
            BOTH,
            " without stop.rhw (0.1) and stop.min_crashes (50): stop.episodes was spent; raise it and go on with "
            "--resume.",
        ),
        (
            "pool_error",
            BOTH[:1],
            " without stop.rhw (0.1): the pool's own error alone is wider; lower pool.relative_error (or raise "
            "pool.shadow_paths, of a vehicle that acts before the cut-in) and use a new folder.",
        ),
        ("pool", None, f": {POOL_SPENT}."),
    ],
)
def test_every_end_has_its_sentence(stopped_by, unmet, sentence):
    said = ending(stopped_by, 46_735, unmet or (), precision_asked=unmet is not None)
    assert said == "Stopped after 46,735 tests" + sentence
