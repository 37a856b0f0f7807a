"""Vehicles that act before the cut-in: `av: {controller: "examples.acting:Speeds", before_event: controller}`.

After the cut-in all are the intelligent driver model of `examples.idm_batch`.
"""

from typing import Any

import numpy as np

from examples.idm_batch import IDM

_LENGTH_M = 5.0
_LONGEST_STEPS = 400


class Holds(IDM):
    """Keeps its speed, as a vehicle that is only asked from the cut-in on."""

    def step_batch(self, seen: Any) -> Any:
        """Accelerations (m/s²)."""
        return np.where(np.isinf(seen.gap_m), self.before(seen), self.after(seen))

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        return np.zeros(seen.cell.size)

    def after(self, seen: Any) -> Any:
        """What it does from the cut-in on (m/s²)."""
        return IDM.step_batch(self, seen)


class DrivesFreely(Holds):
    """Makes for the speed that the intelligent driver model wants, with nothing ahead of it."""

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        return 2.0 * (1.0 - (seen.speed_mps / 40.0) ** 4)


class Speeds(Holds):
    """Drives freely to so many times its set speed."""

    def __init__(self, times: float = 1.2, acceleration_mps2: float = 0.8) -> None:
        self._times, self._acceleration = times, acceleration_mps2

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        return np.where(seen.speed_mps < self._times * seen.set_speed_mps, self._acceleration, 0.0)


class Beside(Holds):
    """Speeds up once BV's rear bumper is near, to get past it."""

    def __init__(self, from_m: float = 20.0, acceleration_mps2: float = 1.5) -> None:
        self._from, self._acceleration = from_m, acceleration_mps2

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        return np.where(seen.bv_position_m - _LENGTH_M - seen.position_m < self._from, self._acceleration, 0.0)


class Noisy(Holds):
    """Holds its speed with noise, drawn from the stream that it is given."""

    def __init__(self, noise_mps2: float = 0.5) -> None:
        self._noise = noise_mps2
        self._drawn = np.zeros((0, _LONGEST_STEPS))

    def start_batch(self, cells: Any, episodes: Any, random: Any) -> None:
        """Draw the noise of whole episodes at once."""
        self._drawn = _with_room(self._drawn, cells)
        for cell, stream in zip(cells, random, strict=True):
            self._drawn[cell] = stream.uniform(-self._noise, self._noise, _LONGEST_STEPS)

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        return self._drawn[seen.cell, np.rint(seen.time_s / 0.1).astype(np.int64)]


class PartlyYields(Holds):
    """Brakes gently while BV's rear bumper is a little ahead, to make room for it."""

    def __init__(self, within_m: float = 15.0, deceleration_mps2: float = 0.5) -> None:
        self._within, self._deceleration = within_m, deceleration_mps2

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        gap = seen.bv_position_m - _LENGTH_M - seen.position_m
        return np.where((gap > 0.0) & (gap < self._within), -self._deceleration, 0.0)


class Careful(Holds):
    """Makes room: slows down to a little above BV's speed while that is near, and brakes hard after the cut-in.

    What it does comes by a dead time late.
    """

    braking_mps2 = 6.0

    def __init__(self, deceleration_mps2: float = 1.5, dead_time_s: float = 0.0) -> None:
        self._deceleration, self._steps = deceleration_mps2, round(dead_time_s / 0.1)
        self._waiting = np.zeros((0, self._steps))

    def start_batch(self, cells: Any, episodes: Any, random: Any) -> None:
        """Nothing is on its way yet."""
        self._waiting = _with_room(self._waiting, cells)
        self._waiting[cells] = 0.0

    def step_batch(self, seen: Any) -> Any:
        """Accelerations (m/s²)."""
        asked = np.column_stack([self._waiting[seen.cell], super().step_batch(seen)])
        self._waiting[seen.cell] = asked[:, 1:]
        return asked[:, 0]

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        gap = seen.bv_position_m - _LENGTH_M - seen.position_m
        near = (gap > -10.0) & (gap < 40.0) & (seen.speed_mps > seen.bv_speed_mps + 3.0)
        return np.where(near, -self._deceleration, 0.0)


class Yields(Holds):
    """Follows BV by the intelligent driver model while that is still on the other lane, braking gently."""

    def __init__(self, deceleration_mps2: float = 1.0) -> None:
        self._deceleration = deceleration_mps2

    def before(self, seen: Any) -> Any:
        """What it does until the cut-in (m/s²)."""
        gap = seen.bv_position_m - _LENGTH_M - seen.position_m
        behind = seen._replace(gap_m=np.maximum(gap, 0.1), lead_speed_mps=seen.bv_speed_mps)
        return np.where(gap > 0.0, np.maximum(IDM.step_batch(self, behind), -self._deceleration), 0.0)


class AsNeeded(Holds):
    """After the cut-in brakes as hard as it takes to come to rest one metre behind BV: mild ones it brakes for late."""

    def after(self, seen: Any) -> Any:
        """What it does from the cut-in on (m/s²)."""
        closing = np.fmax(seen.speed_mps - seen.lead_speed_mps, 0.0)
        return -np.minimum(closing * closing / (2.0 * np.maximum(seen.gap_m - 1.0, 0.1)), 6.0)


class CarefulAsNeeded(AsNeeded, Careful):
    """Makes room, and brakes as needed."""


class YieldsAsNeeded(AsNeeded, Yields):
    """Follows BV while that is still on the other lane, and brakes as needed."""


def _with_room(values: Any, cells: Any) -> Any:
    """The array, with rows for cells of these numbers."""
    missing = int(np.max(cells, initial=-1)) + 1 - len(values)
    return values if missing <= 0 else np.concatenate([values, np.zeros((missing, *values.shape[1:]))])
