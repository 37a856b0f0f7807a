"""What a family says of itself to people: nouns and phrases, the axes of its maps, and who is driven beside the AV."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from harness.vocabulary import FloatArray

EXCLUDED = "the fitted data exclude it"
"""In the note of an exposure that was kept although too few events were counted for one."""


class Words(NamedTuple):
    """Nouns and phrases of pages and terminals.

    ``called`` is the scenario, ``test`` what a rate per test is of; ``event``, ``events`` what happens in it, ``since``
    the moment that times are counted from. ``kicker`` says what pages are about, ``such`` what a rate per million km is
    of, ``same`` what two vehicles meet alike, ``none`` that nothing happened, ``strikes`` what the AV does in a crash,
    ``who`` the vehicles are, and ``unlikely`` why probabilities of events do not add up to 1. ``shows`` and ``happens``
    are a vehicle each and what it does at the onset and at the event; the same where they are one. ``tests`` says of
    which kind tests are, by whether events show themselves, and ``rests`` what a rate scales with, by the traffic (None
    where it is not known) and the level of lane changing.
    """

    called: str
    test: str
    event: str
    events: str
    since: str
    kicker: str
    such: str
    same: str
    none: str
    strikes: str
    who: str
    shows: tuple[str, str]
    happens: tuple[str, str]
    unlikely: str
    tests: Callable[[bool], str]
    rests: Callable[[Any, str], str]


def words_of(*, event: str, of: str, **own: Any) -> Words:
    """What can be said of an event ``of`` a vehicle that has a name, and whatever a family has of its ``own``."""
    said = {
        "called": event, "test": f"one {event}", "events": f"{event}s", "since": f"the {event}", "such": "",
        "same": f"{event}s",
        "kicker": f"How often an automated vehicle (AV) crashes when there is a {event}, on a motorway",
        "none": f"There was no {event}.", "strikes": "", "who": f"{of} the one that the {event} is about",
        "shows": (of, f"begins the {event}"), "happens": (of, f"does the {event}"), "unlikely": "",
        "tests": lambda _: f"a {event} on a straight road",
        "rests": lambda *_: f"the probabilities of {event}s, for which nothing else vouches",
    }  # fmt: skip
    return Words(event=event, **{**said, **own})


class Shown(NamedTuple):
    """A number of events that maps and tables show.

    ``words``, ``unit`` name it on axes, ``head`` are the lines over a column. ``of`` makes it (n,) of columns of tests.
    A map goes ``beyond`` times as far as nearly all crashes do; its cells are between ``edges`` where there are some
    (E + 1,), as of numbers of a grid, and those of events compared are ``cell`` wide.
    """

    words: str
    unit: str
    head: tuple[str, ...]
    of: Callable[[Mapping[str, FloatArray]], FloatArray]
    beyond: float
    cell: float
    edges: FloatArray = np.zeros(0)

    @property
    def axis(self) -> str:
        """What stands beside an axis."""
        return f"{self.words}, {self.unit}"


GAP = Shown("gap at the event", "m", ("Gap at", "event"), lambda of: of["event_gap_m"], beyond=1.4, cell=1.0)
CLOSING = Shown(
    "closing speed", "m/s", ("Closing", "speed"), lambda of: np.asarray(-of["event_rate_mps"]), beyond=1.15, cell=0.5
)
"""To the vehicle that events are about, at the event: of any family."""
