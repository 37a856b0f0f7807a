"""The surrogate library: drivers from conservative to aggressive, in one YAML file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, PrivateAttr, model_validator

from harness.campaign.drivers import NATURAL, Surrogate
from harness.campaign.models import read_model, shipped_or_own
from harness.campaign.sections import Section, SurrogateName
from harness.errors import CampaignError
from harness.problems import broken_rule, did_you_mean, listed
from harness.vehicles.drivers import MOST_FOLLOWERS, Followers, driver_records
from harness.vocabulary import RecordArray

SHIPPED_FOLDER = Path(__file__).parent
DEFAULT = "ladder-2"


def library_records(models: Sequence[Surrogate], see_onset: bool) -> RecordArray:
    """Drivers of a library as kernels read them, shape (D,); ``see_onset`` says that cut-ins take time."""
    parameters, reactions = [model.parameters for model in models], [model.reaction for model in models]
    return driver_records(parameters, reactions, see_onset=see_onset)


class Library(Section):
    """Surrogates that shells are made of.

    The order in the file does not matter: they are put in the order of their crash rates when the pool is built.
    """

    format: Literal["surrogate-library"]
    version: Literal[1]
    description: str = ""
    boundary: SurrogateName = Field(
        description="the most careless driver that the vehicle under test is assumed to be more careful than, "
        "where a campaign asks for testing.shells.statement: library"
    )
    assumes: str = Field(
        "", description='what that assumes, as the end of a sentence that begins with "If this vehicle"'
    )
    envelope: SurrogateName | None
    """a driver at constant full throttle: it crashes wherever any vehicle within its acceleration does; none: every
    event may be a crash"""
    surrogates: dict[SurrogateName, Surrogate] = Field(description="drivers by name")
    references: dict[SurrogateName, Surrogate] = Field(default_factory=dict)
    """drivers that the vehicle is compared with; no shell is made of them"""

    _counts_above_mps: float = PrivateAttr(0.0)

    def counting_above(self, speed_mps: float) -> Library:
        """The library of a campaign in which crashes count only with an impact above a speed, also those of drivers."""
        library = self.model_copy()
        library._counts_above_mps = speed_mps
        return library

    def followers(self, see_onset: bool) -> Followers:
        """The surrogates and then the references as kernels read them, in the order of the file, D + R of them."""
        drivers = library_records([*self.surrogates.values(), *self.references.values()], see_onset)
        place = -1 if self.envelope is None else list(self.surrogates).index(self.envelope)
        return Followers(drivers, place, self._counts_above_mps)

    @property
    def n_drivers(self) -> int:
        """Number of surrogates and references."""
        return len(self.surrogates) + len(self.references)

    @property
    def envelope_mps2(self) -> float:
        """Acceleration of the envelope (m/s²); negative infinity without one, as then no vehicle is within it."""
        if self.envelope is None:
            return -math.inf
        return self.surrogates[self.envelope].parameters.max_acceleration_mps2

    def require_drivers(self, *, follows: bool) -> None:
        """Refuse (`CampaignError`) drivers who cannot drive in a family in which the AV ``follows``, or does not."""
        for name, each in (self.surrogates | self.references).items():
            natural = getattr(each.parameters, "time_headway_s", None) == NATURAL
            if follows and each.model == "r157-fsm":
                found, expected = "r157-fsm", "a driver who has been tried where the AV follows from the start"
            elif natural and not follows:
                found, expected = "a natural headway", "seconds: nobody follows before the event"
            else:
                continue
            mend = "Choose the scenario's own library (pool.library: null), or delete the driver from yours."
            raise CampaignError(f"pool.library, {name}", found, expected, mend)

    def require_reference(self, name: str) -> None:
        """Refuse (`CampaignError`) a limit by a reference driver that the library does not have."""
        if name not in self.references:
            expected = f"a reference driver of the surrogate library: {listed(self.references)}"
            mend = did_you_mean(name, list(self.references)) or "Name one of them, or add it to a library of your own."
            raise CampaignError("accept.times_reference.driver", f"'{name}'", expected, mend)

    @model_validator(mode="after")
    def _names_are_known(self) -> Self:
        for key, name in {"boundary": self.boundary, "envelope": self.envelope}.items():
            if name is not None and name not in self.surrogates:
                expected = f"one of the surrogates: {', '.join(self.surrogates)}"
                mend = did_you_mean(name, list(self.surrogates)) or "Add it to surrogates, or name another."
                raise broken_rule(key, f"'{name}'", expected, mend)
        if (n := self.n_drivers) > MOST_FOLLOWERS:
            mend = "Every shell costs tests: keep those that differ in crash rate by a quarter or more."
            raise broken_rule("surrogates", f"{n} of them, with the references", f"at most {MOST_FOLLOWERS}", mend)
        return self

    @model_validator(mode="after")
    def _envelope_encloses(self) -> Self:
        if self.envelope is None:
            return self
        envelope, most = self.surrogates[self.envelope], self.envelope_mps2
        place = f"surrogates.{self.envelope}"
        if envelope.model != "constant":
            mend = "Write {model: constant, parameters: {acceleration_mps2: 2.0}}."
            expected = "constant: the envelope is a vehicle at full throttle"
            raise broken_rule(f"{place}.model", envelope.model, expected, mend)
        for name, driver in (self.surrogates | self.references).items():
            if (fastest := driver.parameters.max_acceleration_mps2) > most:
                found = f"{most:g} m/s², less than {name}'s {fastest:g}"
                mend = f"Raise it to {fastest:g}, or limit {name}."
                expected = "an envelope that accelerates at least as hard as every surrogate"
                raise broken_rule(f"{place}.parameters.acceleration_mps2", found, expected, mend)
        return self


@cache
def shipped_drivers() -> dict[str, Surrogate]:
    """Surrogates and references of all shipped libraries, by name."""
    libraries = [read_model(file, Library) for file in sorted(SHIPPED_FOLDER.glob("*.yaml"))]
    return {name: each for one in libraries for name, each in (one.surrogates | one.references).items()}


def load_library(name: str | None) -> Library:
    """Read a shipped library by name, or a file by its path; without a name that for cut-ins of one step.

    Raises `CampaignError`: names every place that is wrong.
    """
    return read_model(shipped_or_own(name or DEFAULT, SHIPPED_FOLDER, "pool.library"), Library)
