"""Who is driven in the AV's place behind a vehicle, and what families of that kind say alike."""

from __future__ import annotations

from types import MappingProxyType

from harness.campaign.drivers import Surrogate

STAND_INS = MappingProxyType(
    {
        "r157-cc": (
            "a careful and competent driver, at a headway that people keep",
            Surrogate.model_validate({"model": "r157-cc", "parameters": {"time_headway_s": "natural"}}),
        ),
        "brakes-8": (
            "at a headway of 1 s, braking at once, at up to 8 m/s²",
            Surrogate.model_validate({"model": "idm", "parameters": {"min_acceleration_mps2": -8.0}}),
        ),
    }
)
