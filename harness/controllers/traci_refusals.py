"""What a TraCI script may not do here, and why it is told so."""

from __future__ import annotations

from typing import Any, ClassVar, NoReturn

WOULD_MOVE = "it would move vehicles past the harness and invalidate the likelihood ratios"
_STEPS = "the harness itself starts, steps and ends the simulation"
_EXACT = "it has no effect here: what the AV is told it does exactly, as under speed mode 32"
_WHY = {
    "setSpeedMode": _EXACT,
    "setLaneChangeMode": "it has no effect here: the AV stays on its lane",
    "addStepListener": "name the listener in the campaign: see StepListenerController",
    "changeLane": "the AV stays on its lane; " + WOULD_MOVE,
}
_REFUSED_BEGINNINGS = ("set", "add", "remove", "move", "change", "reroute", "openGap", "replace", "insert", "resume")
_REFUSED_OF_SIMULATION = (
    *("start", "init", "connect", "switch", "setOrder", "close"),
    *("load", "loadState", "saveState", "simulationStep", "step", "executeMove", "addStepListener"),
)


class TraCIException(Exception):  # noqa: N818 - TraCI's own name
    """A command or question that TraCI, or the harness, does not answer."""


class Domain:
    """Part of the facade: what it lacks is refused with the reason, or unknown with a list of what there is."""

    _path: ClassVar[str]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        why = _WHY.get(name)
        if why is None and name in _REFUSED_OF_SIMULATION:
            why = _STEPS
        if why is None and name.startswith(_REFUSED_BEGINNINGS):
            why = WOULD_MOVE
        if why is None:
            there = ", ".join(entry for entry in dir(self) if not entry.startswith("_") and entry != "see")
            raise AttributeError(f"{self._path} has no {name} here; it has {there}")

        def refused(*_arguments: Any, **_named: Any) -> NoReturn:
            raise TraCIException(f"{self._path}.{name} is refused: {why}.")

        return refused
