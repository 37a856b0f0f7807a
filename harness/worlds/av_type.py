"""The vehicle type of an AV that SUMO drives: ``av.sumo`` with the harness's defaults, checked, as SUMO's own XML."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

from harness.errors import CampaignError
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

TYPE_NAME = "av"

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

_VEHICLE = (
    "carFollowModel", "length", "minGap", "maxSpeed", "desiredMaxSpeed", "speedFactor", "speedDev", "accel", "decel",
    "emergencyDecel", "apparentDecel", "maxAccelProfile", "desAccelProfile", "tau", "sigma", "sigmaStep",
    "startupDelay", "actionStepLength", "collisionMinGapFactor", "applyDriverState", "vClass", "emissionClass", "color",
    "width", "height", "mass", "impatience", "speedFactorPremature",
)  # fmt: skip
_MODEL = (
    "delta", "stepping", "adaptTime", "adaptFactor", "security", "estimation", "k", "phi",
    "tmp1", "tmp2", "tmp3", "tmp4", "tmp5",
    "cc1", "cc2", "cc3", "cc4", "cc5", "cc6", "cc7", "cc8", "cc9",
    "tpreview", "tPersDrive", "treaction", "tPersEstimate", "ccoolness", "sigmaleader", "sigmagap", "sigmaerror",
    "jerkmax", "epsilonacc", "taccmax", "Mflatness", "Mbegin", "maxvehpreview",
    "speedControlGain", "gapClosingControlGainSpeed", "gapClosingControlGainSpace", "gapControlGainSpeed",
    "gapControlGainSpace", "collisionAvoidanceGainSpeed", "collisionAvoidanceGainSpace", "collisionAvoidanceOverride",
    "speedControlGainCACC", "gapClosingControlGainGap", "gapClosingControlGainGapDot", "gapControlGainGap",
    "gapControlGainGapDot", "collisionAvoidanceGainGap", "collisionAvoidanceGainGapDot", "tauCACCToACC",
    "speedControlMinGap",
)  # fmt: skip
_LANE_CHANGE = (
    "laneChangeModel", "lcStrategic", "lcCooperative", "lcSpeedGain", "lcKeepRight", "lcOvertakeRight",
    "lcSpeedGainRight", "lcOvertakeDeltaSpeedFactor", "lcAssertive", "lcLookaheadLeft", "lcSigma",
)  # fmt: skip
ATTRIBUTES = (*_VEHICLE, *_MODEL, *_LANE_CHANGE)
"""Those that can matter to a vehicle on a straight road. SUMO ignores names that it does not know without a word."""

RECYCLABLE_MODELS = ("Krauss", "IDM", "ACC", "CACC")
"""Models measured to keep nothing of an episode for the next: bit-equal to a fresh simulation (tests/sumo_av)."""
_RECYCLABLE_ATTRIBUTES = frozenset(
    {"carFollowModel", "length", "minGap", "maxSpeed", "desiredMaxSpeed", "speedFactor", "accel", "decel",
     "emergencyDecel", "apparentDecel", "tau", "delta", "stepping", "lcOvertakeRight", "vClass", "color",
     "emissionClass"}
    | {name for name in _MODEL if "Gain" in name}
)  # fmt: skip
_RECYCLABLE_ONLY_AS: dict[str, float] = {"sigma": 0.0, "speedDev": 0.0, "actionStepLength": STEP_S}


def av_type(sumo: Mapping[str, str | float]) -> dict[str, str | float]:
    """All vType attributes of an AV, defaults filled in.

    Raises `CampaignError`: an attribute or model that SUMO does not have, or a length that the crash criterion does not
    know.
    """
    for name, value in sumo.items():
        if name not in ATTRIBUTES:
            close = difflib.get_close_matches(name, ATTRIBUTES, n=1, cutoff=0.5)
            mend = f"Did you mean '{close[0]}'?" if close else "SUMO's documentation of vType lists them."
            expected = "an attribute of SUMO's vType that matters to a vehicle on a straight road"
            raise _wrong(name, f"the unknown attribute '{name}'", expected, mend)
        if isinstance(value, bool):
            raise _wrong(name, value, "a number or a text", "SUMO writes 1 and 0.")
    model = sumo.get("carFollowModel", DEFAULTS["carFollowModel"])
    if model not in MODELS:
        close = difflib.get_close_matches(str(model), MODELS, n=1, cutoff=0.3)
        mend = f"Did you mean '{close[0]}'?" if close else "Choose one of them."
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
        float(value) == _RECYCLABLE_ONLY_AS[name] if name in _RECYCLABLE_ONLY_AS else name in _RECYCLABLE_ATTRIBUTES
        for name, value in attributes.items()
    )


def type_xml(sumo: Mapping[str, str | float]) -> str:
    """An additional file with the type."""
    written = " ".join(f"{name}={quoteattr(str(value))}" for name, value in av_type(sumo).items())
    return f'<additional>\n    <vType id="{TYPE_NAME}" {written}/>\n</additional>\n'


def refused(sumo: Mapping[str, str | float], message: str) -> CampaignError:
    """The error for a type that SUMO itself refuses, naming the attribute that SUMO's message names."""
    attributes = av_type(sumo)
    named = max((name for name in attributes if name.lower() in message.lower()), key=len, default="")
    return CampaignError(
        f"av.sumo.{named}" if named else "av.sumo",
        f"{attributes[named]}, which SUMO refuses" if named else "values which SUMO refuses",
        "a vType that SUMO accepts",
        f"SUMO says: {message}",
    )


def _wrong(name: str, found: str | float, expected: str, mend: str) -> CampaignError:
    return CampaignError(f"av.sumo.{name}", str(found), expected, mend)
