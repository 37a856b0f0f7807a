"""What a family says of itself to people: nouns and phrases, and the axes of its maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from harness.vocabulary import FloatArray

EXCLUDED = "the fitted data exclude it"
"""Marks the note of an exposure that a fit has kept, although the few events that it counted exclude it."""
ELSEWHERE = "in other trajectories than this traffic’s"
"""Marks the source of an exposure that is not of the trajectories which the traffic was fitted to."""


class Words(NamedTuple):
    """Nouns and phrases of pages and terminals.

    ``called`` names the scenario, ``test`` what rates are per, ``event`` and ``events`` what happens in it, ``since``
    the moment from which times are counted, ``such`` the driving of a rate per million km, ``same`` events that two
    vehicles meet alike. ``kicker`` says what pages are about, ``none`` that nothing happened, ``strikes`` what the AV
    does in a crash, ``who`` the vehicles are, ``unlikely`` why probabilities of events do not add up to 1. ``shows``
    and ``happens`` are a vehicle and what it does, at the onset and at the event; equal where these are one. ``tests``
    says what tests are like, by whether events show themselves, and ``rests`` what a rate scales with, by the traffic
    (None if it is not known) and the level of lane changing. ``late`` is what one that does not look waits for, and
    what shows it earlier, to a controller and to a script; empty where nothing does.
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
    late: tuple[str, str, str] = ("", "", "")


def words_of(*, event: str, of: str, **own: Any) -> Words:
    """General words for an event ``of`` a vehicle; a family replaces some by its ``own``."""
    defaults = {
        "called": event, "test": event, "events": f"{event}s", "since": f"the {event}", "such": "",
        "same": f"{event}s",
        "kicker": f"How often an automated vehicle (AV) crashes when there is a {event}, on a motorway",
        "none": f"There was no {event}.", "strikes": "", "who": f"{of} the one that the {event} is about",
        "shows": (of, f"begins the {event}"), "happens": (of, f"does the {event}"), "unlikely": "",
        "tests": lambda _: f"a {event} on a straight road",
        "rests": lambda *_: f"the probabilities of {event}s, for which nothing else vouches",
    }  # fmt: skip
    return Words(event=event, **{**defaults, **own})


class Shown(NamedTuple):
    """A quantity of events that maps and tables show.

    ``words``, ``unit`` name it on axes, ``head`` are the lines over a column. ``of`` computes it (n,) from columns of
    tests. A map reaches ``beyond`` times as far as nearly all crashes. Its cells lie between ``edges`` (E + 1,), if the
    quantity is on a grid; events are compared in cells ``cell`` wide.
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
        """Label of an axis."""
        return f"{self.words}, {self.unit}"


GAP = Shown("gap at the event", "m", ("Gap at", "event"), lambda tests: tests["event_gap_m"], beyond=1.4, cell=1.0)
CLOSING = Shown(
    "closing speed", "m/s", ("Closing", "speed"),
    lambda tests: np.asarray(-tests["event_rate_mps"]), beyond=1.15, cell=0.5,
)  # fmt: skip
"""Gap and closing speed to the vehicle that events are about, at the event: in any family."""
