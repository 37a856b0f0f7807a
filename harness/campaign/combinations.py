"""What does not go with what: one table of methods, vehicles, cut-ins, engines and commands.

It is asked while a campaign is read, so that the error names file and line, and once more where it is resolved for a
command, and is known whether its cut-ins take time (`lateral` of the environment).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, NamedTuple

from harness.errors import CampaignError
from harness.strata import ASSUMPTION_FREE, LIBRARY_STATEMENT
from harness.vocabulary import METHODS, SAMPLING

if TYPE_CHECKING:
    from harness.campaign.campaign import Campaign

Command = Literal["run", "compare", "av-check"]
MOST_SUMO_CELLS = 256
"""Roads of the largest committed network."""


class Use(NamedTuple):
    """What a campaign is for (no command while it is read), and whether its cut-ins are known to take time."""

    command: Command | None = None
    takes_time: bool = False


WHILE_READ = Use()


class Combination(NamedTuple):
    """What is refused: where to put the blame, when, and the words, with values of the campaign in braces."""

    where: str
    is_asked: Callable[[Campaign, Use], bool]
    found: str
    expected: str
    mend: str


_COMPARED = ASSUMPTION_FREE, LIBRARY_STATEMENT
_TAKES_TIME = "where cut-ins take time (`lateral` of the environment)"

REFUSED = (
    # -- limits --
    Combination(
        "accept",
        lambda c, _: c.accept is not None and not c.sampling.strata,
        "a limit, with testing.method {testing.method}",
        "testing.method shells: how often decisions are wrong is known for its intervals alone",
        "Choose shells, or delete the section and compare the interval with the limit yourself.",
    ),
    Combination(
        "accept.statement",
        lambda c, _: c.accept is not None and c.accept.statement not in (None, c.testing.shells.statement),
        "{accept.statement}, and {testing.shells.statement} in testing.shells.statement",
        "the same statement, or one of the two keys alone",
        "Delete one of them.",
    ),
    # -- vehicles that act before the cut-in --
    Combination(
        "av.before_cut_in",
        lambda c, _: c.av.acts_before_cut_in and c.sampling.holds_speed,
        "controller, with testing.method {testing.method}",
        "hold_speed: the method draws LV's and BV's path ahead, which needs to know the AV's",
        "Choose hold_speed, or testing.method shells (or forced), which drives the AV along its paths first.",
    ),
    Combination(
        "av.before_cut_in",
        lambda c, _: c.av.acts_before_cut_in and c.av.model is not None,
        "controller, with the built-in model {av.model}",
        "hold_speed: a built-in model has nothing to follow before the cut-in",
        "Delete the key, or bring a controller of your own.",
    ),
    # -- where tests are simulated --
    Combination(
        "world.engine",
        lambda c, _: c.world.engine == "twin" and c.av.source in ("sumo", "traci"),
        "twin, with an AV that SUMO moves (av.{av.source})",
        "sumo",
        "Write engine: sumo.",
    ),
    Combination(
        "world.cells",
        lambda c, _: c.world.engine == "sumo" and c.world.cells > MOST_SUMO_CELLS,
        "{world.cells}, with engine sumo",
        f"at most {MOST_SUMO_CELLS}: so many roads has the largest network",
        "Lower it; about 64 is fastest. It never changes a result.",
    ),
    # -- what methods need and allow --
    Combination(
        "surrogates",
        lambda c, _: not c.surrogates and c.sampling.mixes,
        "none",
        "at least one surrogate for testing.method {testing.method}",
        "Leave surrogates out for the three of the paper, or choose method forced or nde.",
    ),
    Combination(
        "stop.rhw",
        lambda c, _: c.stop.rhw is not None and not c.sampling.bounded,
        "{stop.rhw:g}, with testing.method {testing.method}",
        "no precision to stop at: nothing bounds the weights of the step mixture, and while the large ones are missing "
        "its interval looks narrow",
        "Set it to null for a fixed number of tests (stop.episodes), or choose shells, forced or episode_mixture.",
    ),
    Combination(
        "stop.estimator",
        lambda c, _: c.stop.estimator == "scv" and c.records.moments == "none",
        "scv, with records.moments none",
        "records.moments first_9 or all, whose control steps it is computed from",
        "Change one of the two, or leave stop.estimator out for the method's own.",
    ),
    Combination(
        "stop.estimator",
        lambda c, _: c.stop.estimator is not None and c.stop.estimator not in c.sampling.estimators,
        "{stop.estimator}, with testing.method {testing.method}",
        "testing.method {allowing}",
        "Change one of the two, or leave stop.estimator out for the method's own.",
    ),
    # -- cut-ins that take time --
    Combination(
        "av.before_cut_in",
        lambda c, use: use.takes_time and c.av.acts_before_cut_in and use.command == "av-check",
        "controller, " + _TAKES_TIME,
        "hold_speed, or cut-ins of one step: a look at a vehicle makes no baseline runs, without which nobody knows "
        "the onset in time",
        "Add --set av.before_cut_in=hold_speed, or --set environment.parameters=ndd-overtaking-1.",
    ),
    Combination(
        "testing.method",
        lambda c, use: use.takes_time and c.sampling.mixes,
        "{testing.method}, " + _TAKES_TIME,
        "shells, forced or nde: the tables of criticality are for cut-ins of one step, and would aim at those that an "
        "attentive vehicle avoids",
        "Choose shells, or an environment without that section.",
    ),
    Combination(
        "av.before_cut_in",
        lambda c, use: use.takes_time and c.av.acts_before_cut_in and not c.sampling.baseline_runs,
        "controller, with testing.method {testing.method}, " + _TAKES_TIME,
        "a method that drives the AV along its paths first: only then the onset is known in time",
        "Choose testing.method shells or forced, or hold_speed.",
    ),
    # -- comparisons --
    Combination(
        "testing.method",
        lambda c, use: use.command == "compare" and not c.sampling.strata,
        "{testing.method}, in a comparison",
        "shells, under which both vehicles meet the same cut-ins",
        "Write --set testing.method=shells; or run both by themselves and put their intervals side by side.",
    ),
    Combination(
        "accept",
        lambda c, use: use.command == "compare" and c.accept is not None,
        "a limit of one crash rate",
        "none in a comparison",
        "Write --set accept=null, and --margin if something is to be decided.",
    ),
    Combination(
        "av.before_cut_in",
        lambda c, use: use.command == "compare" and c.has_baseline_runs,
        "controller: a vehicle that acts before the cut-in has cut-ins of its own",
        "hold_speed in A and B: pairs need the same cut-ins",
        "Run both campaigns by themselves and put their intervals side by side, or write hold_speed.",
    ),
    Combination(
        "testing.shells.statement",
        lambda c, use: (
            use.command == "compare" and c.testing.shells.statement not in (ASSUMPTION_FREE, LIBRARY_STATEMENT)
        ),
        "{testing.shells.statement}",
        f"{' or '.join(_COMPARED)}: a comparison has these two",
        "Choose one of them.",
    ),
)
"""All that is refused, in the order in which it is told."""


def refusal(campaign: Campaign, use: Use = WHILE_READ) -> tuple[str, str, str, str] | None:
    """Where, found, expected and mend of the first combination that is refused; None if the campaign may go on."""
    allowing = (name for name in METHODS if campaign.stop.estimator in SAMPLING[name].estimators)
    values = {**dict(campaign), "allowing": " or ".join(allowing)}
    for row in REFUSED:
        # A command may change a campaign that has been read: what it was allowed with then is not asked again.
        if row.is_asked(campaign, use) and not (use != WHILE_READ and row.is_asked(campaign, WHILE_READ)):
            return row.where, row.found.format(**values), row.expected.format(**values), row.mend
    return None


def require_combination(campaign: Campaign, command: Command, *, takes_time: bool) -> None:
    """Refuse (`CampaignError`) a campaign that does not go with the command that it is for, or with its cut-ins."""
    if (words := refusal(campaign, Use(command, takes_time))) is not None:
        raise CampaignError(*words)
