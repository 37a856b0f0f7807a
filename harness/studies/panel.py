"""Vehicles and library as the drivers of one enumeration: all are asked about the same cut-ins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from harness.arrays import FloatArray, RecordArray
from harness.campaign.models import AutomatedVehicle, BuiltInParameters, Reflexes
from harness.errors import CampaignError
from harness.pool.library import Library
from harness.pool.shells import acceleration_limit
from harness.studies.super_population import SuperPopulation
from harness.vehicles.models import driver_records

MOST_DRIVERS = 62
NO_ENVELOPE = -1


@dataclass(frozen=True)
class Mixed:
    """A vehicle as drivers of the enumeration, each with the share of episodes in which it is that one."""

    drivers: tuple[int, ...]
    shares: tuple[float, ...]

    def crash_mass(self, population: SuperPopulation) -> FloatArray:
        """Probability that a cut-in happens and the vehicle crashes on it, shape (m,)."""
        crashing = sum(
            (share * population.crashes(driver) for driver, share in zip(self.drivers, self.shares, strict=True)),
            start=np.zeros(population.mass.size),
        )
        return np.asarray(crashing * population.mass)


class Drivers:
    """All drivers of an experiment: the library's first, in the order of its file.

    Parameters
    ----------
    library : Library
    avs : mapping of AutomatedVehicle
        Of built-in models.

    Attributes
    ----------
    records : structured ndarray, shape (D,)
    envelope : int
        The library's, if it crashes wherever another driver does; -1 if a vehicle accelerates harder.
    vehicles : dict of Mixed
        By name.
    """

    def __init__(self, library: Library, avs: Mapping[str, AutomatedVehicle]) -> None:
        models = list(library.surrogates.values())
        parameters: list[BuiltInParameters] = [model.parameters for model in models]
        reactions: list[Reflexes] = [model.reaction for model in models]
        self.vehicles: dict[str, Mixed] = {}
        for name, av in avs.items():
            first = len(parameters)
            late = _reactions(av)
            parameters += [_built_in(av)] * len(late)
            reactions += [reflexes for reflexes, _ in late]
            self.vehicles[name] = Mixed(tuple(range(first, len(parameters))), tuple(share for _, share in late))
        if len(parameters) > MOST_DRIVERS:
            raise CampaignError(
                "avs",
                found=f"{len(parameters)} drivers with the library's {len(models)}",
                expected=f"at most {MOST_DRIVERS}",
                mend="Divide the experiment; an inattentive vehicle counts as two.",
            )
        self.records: RecordArray = driver_records(parameters, reactions)
        enclosed = all(acceleration_limit(av) <= library.envelope_mps2 for av in avs.values())
        self.envelope = list(library.surrogates).index(library.envelope) if enclosed else NO_ENVELOPE


def _built_in(av: AutomatedVehicle) -> BuiltInParameters:
    if not isinstance(av.parameters, BuiltInParameters):  # the experiment's validator has seen to it
        raise TypeError(av.source)
    return av.parameters


def _reactions(av: AutomatedVehicle) -> list[tuple[Reflexes, float]]:
    """The reflexes that a vehicle can have in an episode, and how probable each is."""
    own = av.reaction
    reflexes = Reflexes(delay_s=own.delay_s, max_jerk_mps3=own.max_jerk_mps3)
    if own.inattention_probability == 0.0 or own.inattention_delay_s == 0.0:
        return [(reflexes, 1.0)]
    late = reflexes.model_copy(update={"delay_s": own.delay_s + own.inattention_delay_s})
    return [(reflexes, 1.0 - own.inattention_probability), (late, own.inattention_probability)]
