"""Worlds in which SUMO's own car-following model drives the AV from the step after the event, and its vehicle type.

Until then the AV is commanded and compared like LV and BV. Then it is released (``setSpeed`` -1) under SUMO's default
speed mode: its position and speed are read, not compared. LV and BV stay commanded and compared in every bit.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import sumo_data

from harness.errors import CampaignError
from harness.problems import did_you_mean
from harness.processes import SharedFile
from harness.random_stream import controller_random
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import VEHICLES, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds.sumo import OBEY, SumoWorld

SUMO_DECIDES = 31
"""Speed mode in which all of SUMO's own checks hold: its default."""
RELEASE = -1.0
"""The speed that, commanded, gives a vehicle back to its model."""

DEFAULTS: dict[str, str | float] = {
    "carFollowModel": "Krauss",
    "minGap": 2.0,
    "accel": 2.0,
    "decel": 4.0,
    "emergencyDecel": 9.0,
    "tau": 1.0,
    "sigma": 0.0,
    "maxSpeed": 40.0,
    "speedFactor": 1.0,
    "speedDev": 0.0,
    "actionStepLength": STEP_S,
    "lcOvertakeRight": 1.0,
}
"""Limits and headway of the default AV [assumed]; ``emergencyDecel`` is what SUMO gives a passenger car.

``lcOvertakeRight`` 1: the AV looks at its own lane alone. SUMO would otherwise brake it so that it does not pass a
slower vehicle on the left, which is what the whole scenario is about.
"""

MODELS = (
    "Krauss", "KraussOrig1", "KraussPS", "KraussX", "SmartSK", "Daniel1", "IDM", "IDMM", "EIDM", "PWagner2009",
    "BKerner", "Wiedemann", "W99", "ACC", "CACC",
)  # fmt: skip

RECYCLABLE_MODELS = ("Krauss", "IDM", "ACC", "CACC")
"""Models measured to keep nothing of an episode for the next: bit-equal to a fresh simulation (tests/worlds)."""
_RECYCLABLE_ATTRIBUTES = frozenset(
    {"carFollowModel", "length", "minGap", "maxSpeed", "desiredMaxSpeed", "speedFactor", "accel", "decel",
     "emergencyDecel", "apparentDecel", "tau", "delta", "stepping", "lcOvertakeRight", "vClass", "color",
     "emissionClass"}
)  # fmt: skip
_RECYCLABLE_ONLY_AS: dict[str, float] = {"sigma": 0.0, "speedDev": 0.0, "actionStepLength": STEP_S}


@cache
def attributes_of_sumo() -> list[str]:
    """Attributes of a vType, as SUMO's schema has them: SUMO ignores names that it does not know without a word."""
    schema = ElementTree.parse(Path(sumo_data.__path__[0]) / "data/xsd/types/route.xsd")  # noqa: S314 - SUMO's own
    return [each.get("name", "") for each in schema.iterfind(".//*[@name='vTypeBaseType']/{*}attribute")]


def av_type(sumo: Mapping[str, str | float]) -> dict[str, str | float]:
    """All vType attributes of an AV (``av.sumo``), defaults filled in.

    Refuses attributes and models that SUMO does not have, and lengths that the crash criterion does not know.
    """
    for name, value in sumo.items():
        if name not in attributes_of_sumo():
            mend = did_you_mean(name, attributes_of_sumo()) or "SUMO's documentation of vType lists them."
            raise _wrong(name, f"the unknown attribute '{name}'", "an attribute of SUMO's vType", mend)
        if isinstance(value, bool) or str(value).lower().lstrip("+-") in ("nan", "inf", "infinity"):
            raise _wrong(name, value, "a finite number or a text", "SUMO writes true and false as 1 and 0.")
    model = sumo.get("carFollowModel", DEFAULTS["carFollowModel"])
    if model not in MODELS:
        mend = did_you_mean(model, MODELS) or "Choose one of them."
        raise _wrong("carFollowModel", model, f"one of {', '.join(MODELS)}", mend)
    length = sumo.get("length", VEHICLE_LENGTH_M)
    if length != VEHICLE_LENGTH_M:
        raise _wrong("length", length, f"{VEHICLE_LENGTH_M:g} m, as everywhere in the scenario", "Delete the key.")
    return {**DEFAULTS, **sumo, "length": VEHICLE_LENGTH_M}


def recyclable(sumo: Mapping[str, str | float]) -> bool:
    """Whether a vehicle of this type moves, episode after episode, exactly as in a fresh simulation.

    If not, hidden state or random numbers carry over, and every episode needs a simulation of its own.
    """
    attributes = av_type(sumo)
    if attributes["carFollowModel"] not in RECYCLABLE_MODELS:
        return False
    return all(
        float(value) == _RECYCLABLE_ONLY_AS[name]
        if name in _RECYCLABLE_ONLY_AS
        else name in _RECYCLABLE_ATTRIBUTES or ("Gain" in name and name[:2] != "lc")
        for name, value in attributes.items()
    )


def _wrong(name: str, found: str | float, expected: str, mend: str) -> CampaignError:
    return CampaignError(f"av.sumo.{name}", str(found), expected, mend)


class SumoAvWorld(SumoWorld):
    """`SumoWorld` whose AVs (see `av_type`) are driven by SUMO after the event, or from the start of an episode."""

    drives_av, _av_type = True, "av"

    def __init__(self, n_cells: int, av: Mapping[str, str | float], vehicles: Sequence[str] = VEHICLES) -> None:
        self._released: BoolArray = np.zeros(n_cells, np.bool_)
        self._wanted: FloatArray = np.zeros((n_cells, len(vehicles)))
        attributes = av_type(av)
        text = " ".join(f"{name}={quoteattr(str(value))}" for name, value in attributes.items())
        xml = f'<additional>\n    <vType id="{self._av_type}" {text}/>\n</additional>\n'
        self._more_types = (SharedFile(xml.encode()),)
        stderr = SharedFile()
        try:
            with _stderr_to(stderr.path):
                super().__init__(n_cells, vehicles)
        except Exception as error:
            lines = stderr.path.read_text(encoding="utf-8").splitlines()
            messages = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
            if not messages:
                raise
            attribute = max((name for name in attributes if name.lower() in messages[0].lower()), key=len, default="")
            where, values = (f"av.sumo.{attribute}", attributes[attribute]) if attribute else ("av.sumo", "values")
            found, mend = f"{values}, which SUMO refuses", f"SUMO says: {messages[0]}"
            raise CampaignError(where, found, "a vType that SUMO accepts", mend) from error

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray, lane: Int8Array) -> None:
        """Take the AVs of these cells back under command."""
        for k in cells.tolist():
            self._api.vehicle.setSpeedMode(self._names[k][-1], OBEY)
        super().place(cells, x, v, lane)
        self._released[cells] = False
        if self.acts_before_event:
            self._let_go(cells)

    def step(self, speed: FloatArray, lane: Int8Array) -> BoolArray:
        """Speeds of released AVs are ignored."""
        self._wanted[:] = speed
        self._wanted[self._released, -1] = RELEASE
        meets = (lane != self.lane).any(1)
        contact = super().step(self._wanted, lane)
        if meets.any():
            self._let_go(np.flatnonzero(meets & ~self._released))
        return contact

    def _let_go(self, cells: IntArray) -> None:
        """From the next step on SUMO decides."""
        for k in cells.tolist():
            self._api.vehicle.setSpeedMode(self._names[k][-1], SUMO_DECIDES)
        self._released[cells] = True

    def _read_released(self) -> None:
        for k in np.flatnonzero(self._released).tolist():
            name = self._names[k][-1]
            self.x[k, -1], self.v[k, -1] = self._get_position(name), self._get_speed(name)


class FreshWorld(SumoAvWorld):
    """One cell, and for every episode a simulation of its own, seeded with the campaign's seed and the episode.

    For types whose vehicles keep hidden state or draw random numbers: slower, and the same again in any order.
    """

    def __init__(
        self, av: Mapping[str, str | float], seed: int, vehicles: Sequence[str] = VEHICLES, *, acts_before_event: bool
    ) -> None:
        self.acts_before_event, self._seed, self._sumo_seed = acts_before_event, seed, 0
        super().__init__(1, av, vehicles)

    def announce(self, cells: IntArray, episodes: IntArray) -> None:  # noqa: ARG002 - there is one cell
        """Load a new simulation for the coming episode."""
        self._sumo_seed = sumo_seed(self._seed, int(episodes[0]))
        self.load_again()

    def _arguments(self) -> list[str]:
        return [*super()._arguments(), "--seed", str(self._sumo_seed)]


def sumo_seed(seed: int, episode: int) -> int:
    """SUMO's seed (31 bits) for an episode: from the AV's own stream of random numbers."""
    return int(controller_random(seed, episode).integers(2**31))


@contextmanager
def _stderr_to(path: Path) -> Iterator[None]:
    """Write SUMO's messages to a file: libsumo's exception says no more than 'Process Error'."""
    sys.stderr.flush()
    original = os.dup(2)
    try:
        with path.open("wb") as file:
            os.dup2(file.fileno(), 2)
            yield
    finally:
        os.dup2(original, 2)
        os.close(original)
