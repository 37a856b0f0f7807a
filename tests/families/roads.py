"""Traffic of lead braking and cut-outs, made by hand: equal speeds, a headway, events of one's own."""

from __future__ import annotations

from functools import cache

import numpy as np

from harness.campaign.drivers import ConstantParameters, Reflexes
from harness.campaign.sections import EnvironmentSettings
from harness.families import family_named
from harness.families.following.approach import START_DTYPE
from harness.families.following.parameters import NO_EVENT
from harness.families.protocol import Paths
from harness.vehicles.drivers import Followers, driver_records

SETTINGS = EnvironmentSettings()
QUIET = {"free_driving__location_mps2": 0.0, "free_driving__log_scale": -20.0}
"""The vehicle ahead keeps its speed until the onset."""
SHORT = {**QUIET, "approach__duration_s": 1.0, "approach__after_s": 50.0}


@cache
def _parameters(family: str):
    return family_named(family).parameters(SETTINGS)


def traffic_of(family: str, values, events=None):
    """Traffic with other ``values``, and ``events`` (E,), each a dict of what is not as in `NO_EVENT`, as its grid."""
    found = family_named(family).traffic(SETTINGS, _parameters(family).with_values(values))
    if events is None:
        return found
    grid = np.repeat(NO_EVENT[None], len(events))
    for record, event in zip(grid, events, strict=True):
        for name, value in event.items():
            record[name] = value
    return found._replace(grid=grid, share=np.full(len(events), 1.0 / len(events)))


def paths_at(speeds):
    """Paths on which all begin at these speeds (m/s), at a natural headway of 1.5 s."""
    start = np.zeros(len(speeds), START_DTYPE)
    start["speed_mps"], start["natural_headway_s"] = speeds, 1.5
    return Paths(np.arange(len(speeds)), start)


def brakers(kinds, perceives_m=0.375):
    """Drivers (D,) who keep their speed, and brake with so many m/s² so many steps after they have perceived."""
    models = [ConstantParameters(acceleration_mps2=-b) for b, _ in kinds]
    late = [Reflexes(delay_s=late / 10.0, perceives_lateral_m=perceives_m) for _, late in kinds]
    return driver_records(models, late)


def crashes_of(family: str, traffic, paths, drivers, above_mps=0.0):
    """Who crashes on which event (n, E, D), and the events' probabilities (n, E)."""
    found = family_named(family).events(traffic, 1, paths, Followers(drivers, -1, above_mps))
    return (found.crashes[..., None] >> np.arange(len(drivers)) & 1).astype(bool), found.probability
