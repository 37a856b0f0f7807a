"""What a TraCI script may not do here: refused, with the reason."""

from __future__ import annotations

import difflib
from typing import Any, ClassVar, NoReturn

from harness.problems import did_you_mean

WOULD_MOVE = "it would change vehicles unknown to the harness, and the crash rate would be wrong"
_STEPS = "the harness itself starts, steps and ends the simulation"
_REFUSED = {
    **dict.fromkeys(("start", "init", "connect", "switch", "setOrder", "close", "load", "loadState"), _STEPS),
    **dict.fromkeys(("saveState", "simulationStep", "step", "executeMove"), _STEPS),
    "addStepListener": "name the listener in the campaign, as av.controller",
    "changeLane": "the AV stays on its lane",
    "setMaxSpeed": "each test says how fast the AV cruises (getAllowedSpeed): delete the line",
}
_NO_MODEL = "no model of SUMO's drives the AV: setSpeed, setAcceleration, slowDown do, bounded by setAccel and setDecel"
_REFUSED_BEGINNINGS = ("set", "add", "remove", "move", "change", "reroute", "openGap", "replace", "insert", "resume")

_MISSPELT = 0.9
"""Similarity to what there is from which a name is a typing error: TraCI's own names differ by more."""
_NOT_TRACIS = ("see", "leave", "end", "next_acceleration", "require_unfinished", "over", "n_steps", "step_s", "time_s")


class TraCIException(Exception):  # noqa: N818 - TraCI's own name
    """A command or question that TraCI, or the harness, does not answer."""


class FatalTraCIError(Exception):
    """The simulation has ended."""


class RefusedError(TraCIException):
    """What the harness cannot do: the ``last`` of a turn, or what it lacks, fails its test also where it is caught."""

    last: ClassVar[Exception | None] = None

    def __init__(self, text: str) -> None:
        super().__init__(text)
        RefusedError.last = self


class Domain:
    """Part of the facade: what it lacks is refused with the reason, or unknown."""

    _path: ClassVar[str]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        public = [entry for entry in dir(type(self)) if entry[0] != "_" and entry not in _NOT_TRACIS]
        why = _REFUSED.get(name)
        if why is None and not difflib.get_close_matches(name, public, 1, _MISSPELT):
            moves = WOULD_MOVE if name.startswith(_REFUSED_BEGINNINGS) else None
            why = _NO_MODEL if name.startswith("set") else moves
        if why is None:
            domains = [entry for entry in vars(self) if isinstance(getattr(self, entry), Domain) and entry[0] != "_"]
            there = f"; it has {', '.join(domains)}" if domains else ": delete the line, or put in a value of your own"
            there = "" if did_you_mean(name, domains or public) else there
            RefusedError.last = AttributeError(f"{self._path} has no {name} here{there}", name=name, obj=self)
            raise RefusedError.last

        def refused(*_arguments: Any, **_named: Any) -> NoReturn:
            raise RefusedError(f"{self._path}.{name} is refused: {why}.")

        return refused
