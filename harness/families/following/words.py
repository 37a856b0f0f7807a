"""Drivers put in the AV's place behind a vehicle, and words that families of that kind have in common."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

from harness.campaign.drivers import Surrogate
from harness.families.words import Words

STAND_INS = MappingProxyType(
    {
        "r157-cc": (
            "a careful and competent driver, at a headway that people keep",
            Surrogate.model_validate({"model": "r157-cc", "parameters": {"time_headway_s": "natural"}}),
        ),
        "brakes-8": (
            "braking as soon as it sees the danger, at up to 8 m/s²",
            Surrogate.model_validate({"model": "idm", "parameters": {"min_acceleration_mps2": -8.0}}),
        ),
    }
)


def words_of_following(*, event: str, then: str, depend: str, strikes: str, **own: Any) -> Words:
    """Words of pages; ``then`` is what the vehicle ahead does, ``depend`` the assumed numbers that rates depend on."""
    return Words(
        test=own.pop("test", f"{event} as in this traffic"),
        event=event,
        events=f"{event}s",
        such=" following",
        strikes=f"In every crash the AV strikes {strikes} from behind.",
        tests=lambda _: (
            "the vehicle follows another one on a straight road, at the distance that it chooses; then the one ahead "
            + then
        ),
        rests=lambda *_: (
            f"{depend}, which is assumed, and it is per {event}: how many there are in an hour of driving is assumed, "
            "too"
        ),
        **own,
    )
