"""What a look at a vehicle (`harness.runner.look`) has found, as numbers and in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from harness.errors import EXIT_DONE, EXIT_TOO_MANY_FAILED
from harness.estimators.estimate import finite_json
from harness.estimators.limits import clopper_pearson
from harness.families import family_named
from harness.loop.cells import BRAKED_MPS2, FAR_BEHIND_S
from harness.numbers import tests
from harness.report.acted import BRAKES_BEFORE, NEVER_BRAKED, SPEEDS_UP_BEFORE, cruise_words, late_words, script_words
from harness.shown import ShownInPython

SLOW_S = 0.1
"""Time of a constructor that is worth a word."""
Cause = Literal["process", "clock", "random", "remembers", "shares"]
"""Why a test is not the same again: which process it is in, what a clock says, nothing that is known (as random numbers
of its own), another test before it, or beside it."""
MOVES_MPS2 = 0.5
"""Change of a first answer that says: the warm-up leaves something behind."""
IN_WORDS = {
    "mean_acceleration_mps2": "mean acceleration, m/s²",
    "min_acceleration_mps2": "hardest braking, m/s²",
    "max_acceleration_mps2": "hardest acceleration, m/s²",
    "share_at_min": "share of steps at its hardest allowed braking",
    "share_at_max": "share of steps at its hardest allowed acceleration",
    "reaction_s": "from the onset to the first braking, median, s",
    "braking_share": "share of {events} after which it braked",
    "n_events": "{events}",
    "n_crashes": "crashes (no rate: {events} are forced)",
    "us_per_step": "time per step, µs",
    "episodes_per_s": "tests per second",
}
FOLLOWING = {
    "headway_s": "headway at the onset, median, s",
    "smallest_gap_m": "smallest gap before it, m",
    "speed_mps": "faster than the vehicle ahead at the onset, median, m/s",
    "n_hit": "tests in which it hit the vehicle ahead before",
}
CAUSES: dict[Cause, str] = {
    "remembers": "It differs after another test: it remembers the last one. Set all its state in start.",
    "shares": "It differs beside other vehicles: they share something. Keep state in self, not in the class or module.",
    "random": "It differs although all else is equal: random numbers of its own (random, numpy.random), or a variable "
    "of its module or class that outlives the object. Draw from episode.random in start (a script: from `random`, "
    "which has a new stream in each test); keep state in self.",
    "process": "It differs from process to process: random numbers of its own (random, numpy.random), the number of "
    "the process, hash() of a text (the order of a set), an id(), or what earlier tests have left in a variable of its "
    "module or class. Draw from episode.random in start; keep state in self.",
    "clock": "It depends on the clock ({}): a test may run at any speed. Use time_s of what it sees, or step_s.",
}


@dataclass(frozen=True)
class Behaviour:
    """What the AV did in all steps in which it acted, and after the events.

    ``reaction_s`` is the median time from the onset of the event to the first braking beyond 0.1 m/s², over the
    episodes that braked at all; their share is ``braking_share``. ``n_took_over_early`` did something before
    the event was complete (where it follows: braked), ``n_braked_before`` asked to brake before the onset, and
    ``n_asked_to_speed_up`` to speed up before the overlap.
    """

    mean_acceleration_mps2: float
    min_acceleration_mps2: float
    max_acceleration_mps2: float
    share_at_min: float
    share_at_max: float
    reaction_s: float
    braking_share: float
    n_events: int
    n_crashes: int
    n_took_over_early: int
    n_braked_before: int
    n_asked_to_speed_up: int


@dataclass(frozen=True)
class Follows:
    """How the AV follows before the onset, in scenarios in which it does: of tests, the median and the least.

    ``headway_s`` is that at the onset, ``smallest_gap_m`` the least gap of the approach, ``speed_mps`` the AV's speed
    at the onset less the leader's. ``n_hit`` tests ended before it in a crash.
    """

    headway_s: float
    smallest_gap_m: float
    speed_mps: float
    n_hit: int


@dataclass(frozen=True)
class Speed:
    """Time per episode step, episodes per second, and what a worker of a run constructs before its cells are full."""

    us_per_step: float
    episodes_per_s: float
    construction_s: float
    constructions: int


@dataclass(frozen=True, repr=False)
class AvCheck(ShownInPython):
    """What a few dozen episodes say about an AV, run on an engine with events that a method brought about.

    ``failures`` are numbers of failed episodes by cause, where causes that differ in digits alone are one;
    ``differing`` are episodes whose motion was not the same bits in two layouts, with their ``likely_cause`` and where
    a clock was read; ``limits_mps2`` are the accelerations that count as its limits; ``moved_mps2`` is by how much
    first answers move at most if the warm-up takes so many seconds (key) instead of ``av.warm_up_s``. The built-in IDM
    drives the same episodes. A vehicle that acts before the event meets cut-ins of one step also where those of the
    campaign take time (``shows``), as a look makes no baseline runs. ``follows`` says how the AV follows from the
    start.
    """

    source: str
    engine: str
    method: str
    shows: bool
    n_episodes: int
    failures: dict[str, int]
    differing: tuple[int, ...]
    likely_cause: Cause | None
    clock_read_at: Sequence[str]
    limits_mps2: tuple[float, float]
    moved_mps2: dict[float, float]
    behaviour: Behaviour
    idm_behaviour: Behaviour
    speed: Speed
    idm_speed: Speed
    scenario: str
    follows: Follows | None = None
    idm_follows: Follows | None = None
    script: Mapping[str, float] | None = None

    @property
    def events(self) -> str:
        """What its tests are about."""
        return family_named(self.scenario).words.events

    @property
    def exit_code(self) -> int:
        """0 when all is well, 3 when episodes failed or were not reproduced."""
        return EXIT_TOO_MANY_FAILED if self.failures or self.differing else EXIT_DONE

    def _lines(self) -> list[str]:
        return [verdict(self)]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON content; undefined numbers become null."""
        return finite_json({**asdict(self), "deterministic": not self.differing, "exit_code": self.exit_code})


def verdict(check: AvCheck) -> str:
    """What is to be done next, in a sentence."""
    n, behaviour, speed = check.n_episodes, check.behaviour, check.speed
    if check.failures:
        return f"NOT READY: {sum(check.failures.values())} of {n} tests failed: {next(iter(check.failures))}."
    if check.differing:
        return f"NOT REPRODUCIBLE: {len(check.differing)} of {n} tests differed when run again. {cause(check)}"
    if doubt := next(_doubts(check), None):
        return f"LOOK AGAIN: {doubt}"
    advice = "."
    if speed.us_per_step > 100.0:  # which slows a run; in Python it is some 15
        advice = f", {speed.us_per_step / check.idm_speed.us_per_step:.0f} times as long as IDM’s."
    if speed.construction_s > SLOW_S and speed.constructions > 1:
        advice += (
            f" Its constructor takes {speed.construction_s:.1f} s, and each worker of a run calls it "
            f"{speed.constructions} times: what all may share, load once (`load`, see docs/controllers.md)."
        )
    hides = family_named(check.scenario).words.late[0] and (check.shows or check.follows is not None)
    seen = check.scenario, behaviour.n_took_over_early, behaviour.n_events
    late = late_words(*seen, script=bool(check.script)) if hides and check.source == "controller" else ""
    if late:
        advice += f" But {late}."
    if check.shows and check.source != "model" and behaviour.n_asked_to_speed_up:
        asked = SPEEDS_UP_BEFORE.format(tests(behaviour.n_asked_to_speed_up))
        advice += f" But {cruise_words([asked], script=check.script is not None)}."
    shows = int(1.0 / clopper_pearson(0, n, 0.1)[1])  # with 90 % confidence
    unseen = f" (a fault in fewer than 1 of {shows}, or only on the rare, hard {check.events} of a run, may not show)"
    rare = "" if check.source == "model" else unseen
    return (
        f"READY: {n} tests twice, the same bits{rare}; it braked after {behaviour.braking_share:.0%} of "
        f"{behaviour.n_events} {check.events}, {behaviour.reaction_s:.1f} s after they began (median; some leave time "
        f"to wait); it takes {speed.us_per_step:.1f} µs a step{advice}"
    )


def _doubts(check: AvCheck) -> Iterator[str]:
    """What makes tests of the vehicle say little, the worst first."""
    behaviour, follows = check.behaviour, check.follows
    if not (behaviour.n_events and behaviour.braking_share > 0.0 and behaviour.min_acceleration_mps2 <= -BRAKED_MPS2):
        yield NEVER_BRAKED
    yield from script_words(check.script)
    if follows is not None and follows.n_hit:
        yield f"in {follows.n_hit} of {check.n_episodes} tests it hit the vehicle ahead before anything happened."
    if check.shows and behaviour.n_braked_before:
        braked = BRAKES_BEFORE.format(tests(behaviour.n_braked_before))
        yield f"{cruise_words([braked], script=check.script is not None)}."
    if follows is not None and follows.headway_s > FAR_BEHIND_S:
        behind = f"{follows.headway_s:.1f} s behind the vehicle ahead"
        yield f"when the event begins it is {behind}, which makes that milder: let it keep up."
    longest, moved = max(check.moved_mps2.items(), default=(0.0, 0.0))
    if longest and moved > MOVES_MPS2:
        yield (
            f"its first answer moves by up to {moved:.1f} m/s² where the warm-up takes {longest:g} s. "
            "State winds up while its answers are not used, as an integral does: limit it (anti-windup), or begin "
            "it when BV comes; then av.warm_up_s need be no longer than its filters."
        )


def cause(check: AvCheck) -> str:
    """Why tests came out otherwise; empty if none did."""
    if check.likely_cause is None:
        return ""
    return CAUSES[check.likely_cause].format("; ".join(check.clock_read_at[:3]) or "in a library")


def rows(check: AvCheck) -> list[dict[str, Any]]:
    """A table: what was found, beside the built-in IDM."""
    content = check.to_json()
    own, idm = ({**content[f"{who}behaviour"], **content[f"{who}speed"]} for who in ("", "idm_"))
    source = "TraCI script" if check.script else check.source
    follows = check.follows is not None
    kind = check.events if follows else f"{check.events} {'that take time' if check.shows else 'of one step'}"
    where = "twin (the motion that SUMO would compute)" if check.engine == "twin" else "SUMO"
    shown = [
        ("kind of vehicle; where tested; on what", f"{source}; {where}; {kind}, {check.method}", ""),
        ("tests", check.n_episodes, ""),
        *([(f"failed: {why}", n, "") for why, n in content["failures"].items()] or [("tests that failed", "none", "")]),
        ("tests that differed when run again", content["differing"] or "none", ""),
        ("accelerations allowed, m/s²", [*content["limits_mps2"]], ""),
        *((text.format(events=check.events), own[name], idm[name]) for name, text in IN_WORDS.items()),
        *((FOLLOWING[name], value, content["idm_follows"][name]) for name, value in (content["follows"] or {}).items()),
        *(
            (f"how much its first answer moves with a warm-up of {s:g} s, at most, m/s²", moved, "")
            for s, moved in check.moved_mps2.items()
        ),
    ]
    return [dict(zip(("what", "found", "built-in IDM"), row, strict=True)) for row in shown]
