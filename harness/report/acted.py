"""What a vehicle did before its events, or did not, in words: of answers, and of `harness.report.av_check`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from harness.estimators.answer import MANY
from harness.families import family_named
from harness.loop.cells import BRAKED_MPS2, FAR_BEHIND_S
from harness.numbers import plain, tests

NEVER_BRAKED = f"it never braked with {plain(BRAKED_MPS2)} m/s² or more (below 0): does it see the other vehicle?"
LONGEST_S = 1.0
"""Time that a script may do nothing without a word [assumed]."""
BRAKES_BEFORE = "in {} it braked with nobody ahead, which makes the event milder"
SPEEDS_UP_BEFORE = "in {} it asked to speed up before BV was in its lane, and its speed was held"


def late_words(scenario: str, n_early: int, n_events: int, *, script: bool) -> str:
    """That a vehicle does nothing before events are complete, as BV in its lane, and what would show it.

    Empty where it does something in many: one that follows may brake for another reason.
    """
    if not n_events or n_early > MANY * n_events:
        return ""
    what, seen, seen_by_script = family_named(scenario).words.late
    but = f"in all but {tests(n_early)} " * (n_early > 0)
    return f"{but}it did nothing before {what}; {seen_by_script if script else seen} shows it earlier"


def cruise_words(did: Sequence[str], *, script: bool) -> str:
    """What a vehicle did before anything happened, as one does whose own set speed is not that of the test."""
    speed = "getAllowedSpeed" if script else "set_speed_mps"
    return f"{'; '.join(did)}: let it cruise at {speed}, or set av.before_event=controller"


def script_words(tried: Mapping[str, float] | None) -> Iterator[str]:
    """What a TraCI script (`TriedScript`) leaves to others, a line each."""
    if tried is not None and (idle_s := tried["idle_s"]) > LONGEST_S:
        waits = f"the script looks at no vehicle in the first {idle_s:.1f} s of a test, in which a car may cut in"
        yield f"{waits}: leave out steps that only wait"
    elif tried is not None and (left_s := tried["left_s"]) > LONGEST_S:
        left = f"the script gives no command for {left_s:.1f} s behind a car that cuts in (tried for 15 s)"
        yield f"{left}: SUMO’s model would drive then, here it keeps its speed (docs/controllers.md)"
    if tried is not None and tried["safe_speeds"]:
        holds = "in the script’s speed mode SUMO’s safe speeds would hold the vehicle back; here they do not"
        yield f"{holds} (docs/controllers.md)"


def acted_words(scenario: str, before: Mapping[str, Any] | None) -> Iterator[str]:
    """What the vehicle did before the event, or did not after it (`before_event`), a line each."""
    if before is None:
        return
    yield from script_words(script := before.get("tried_script"))
    if before["n_events"] and not before["n_braked"] and not before["built_in"]:
        yield NEVER_BRAKED
    if (n := before["n_fell_behind"]) > MANY * before["n_events"] and not before["built_in"]:
        why = "which makes the event milder: let it keep up"
        yield f"in {tests(n)} it was over {FAR_BEHIND_S:g} s behind the vehicle ahead when the event began, {why}"
    follows, shown = family_named(scenario).follows, family_named(scenario).words
    if shown.late[0] and (before["waits"] or follows):
        if before["source"] in ("sumo", "traci"):
            sees = " ".join(shown.shows)
            yield f"SUMO changes lanes in one step: this vehicle cannot see that {sees}, as drivers can"
        else:
            n_early = min(before["n_braked_early"], before["n_took_over_early"])  # it may drive from the onset on
            yield from filter(None, [late_words(scenario, n_early, before["n_events"], script=script is not None)])
    if not before["waits"]:
        return
    did = [BRAKES_BEFORE.format(tests(n))] if (n := before["n_braked_before"]) else []
    if (n := before["n_asked_to_speed_up"]) and not before["built_in"]:  # our own models do, which is known
        did.append(SPEEDS_UP_BEFORE.format(tests(n)))
    if did:
        yield cruise_words(did, script=script is not None)
