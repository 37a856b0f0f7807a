"""What a family of events brings: paths on which nothing happens, events on them, and the motion that they are.

All that the harness does is: walk the others' motion without the event → list the events on it, each with its exact
probability → ask which drivers crash on each → repeat some of them → count. A family is a package that answers the
questions of `Family`, each once per batch; its kernels are its own, and what it says is arrays. The core repeats its
scripts, judges, counts and shows them, and knows nothing else of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import pyarrow as pa

from harness import elementary
from harness.campaign.drivers import Surrogate
from harness.campaign.models import read_model, shipped_or_own
from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError
from harness.families.numbers import ParameterFile
from harness.families.script import Script
from harness.families.words import CLOSING, GAP, Shown, Words, words_of
from harness.random_stream import INITIAL, uniforms
from harness.vehicles.drivers import Followers
from harness.vehicles.sideways import TO_OVERLAP_M
from harness.vocabulary import BoolArray, FloatArray, IntArray, Method, RecordArray

Environment: TypeAlias = Any
"""All that a family's kernels need of its traffic; what is in it the family alone knows."""
Parameters: TypeAlias = ParameterFile
"""Its numbers, each with its provenance."""


class Column(NamedTuple):
    """A fact of each test that records keep: a field of the family's facts, and of the table of tests.

    Of a fact with a length, ``length`` names the field that says how many of its entries are used.
    """

    name: str
    kind: pa.DataType
    unit: str
    doc: str
    length: str = ""


class Recorded(NamedTuple):
    """What vehicles did without an event, on paths (n,); for one that keeps its speed, `HOLDING` (0,).

    ``n_steps``, ``failed`` (n,): steps that are on record, and whether the vehicle failed then. ``x_m``, ``v_mps``
    (n, steps + 1) are its positions and speeds, undefined beyond.
    """

    n_steps: IntArray
    failed: BoolArray
    x_m: FloatArray
    v_mps: FloatArray

    def mean_distance_m(self, weight: FloatArray) -> float:
        """Mean distance that the vehicle drives where nothing happens; paths have the ``weight`` (n,)."""
        whole, rows = ~self.failed, np.arange(len(self.n_steps))
        distance = self.x_m[rows, self.n_steps] - self.x_m[:, 0]
        return float((weight * distance)[whole].sum() / weight[whole].sum())

    def digest(self) -> str:
        """Hash of what is on record."""
        digest = hashlib.sha256(self.n_steps.tobytes() + self.failed.tobytes())
        known = np.arange(self.x_m.shape[1]) <= self.n_steps[:, None]
        for values in (self.x_m, self.v_mps):
            digest.update(values[known].tobytes())
        return digest.hexdigest()


HOLDING = Recorded(np.zeros(0, np.int64), np.zeros(0, np.bool_), np.zeros((0, 1)), np.zeros((0, 1)))


class Paths(NamedTuple):
    """Paths (n,): the ``number`` of each, by which all that is drawn on it follows, and how it begins.

    ``start`` (n,) is a record of the family's own, made from uniforms: also of what drivers are told of the path, such
    as the headway that people keep on it.
    """

    number: IntArray
    start: RecordArray


class Events(NamedTuple):
    """All events that are asked of paths: rows are paths, columns the family's grid of E events.

    ``probability`` (n, E) is ``stride`` · P(event | path) where it is asked, else 0: with uniform offsets the sum over
    any set of events has its probability as mean. ``crashes`` (n, E) has one bit per driver. ``log_any`` (n,) is the
    log probability that there is an event on the path. ``after_failure`` (n,) is the most that the probability of an
    event after a failure of a recorded AV can be, wherever it may be then.
    """

    probability: FloatArray
    crashes: IntArray
    log_any: FloatArray
    after_failure: FloatArray


def every_event(probability: FloatArray, crashes: IntArray, stride: int = 1, offset: IntArray | None = None) -> Events:
    """Every ``stride``-th of events that no AV makes more or less probable, given the ``probability`` of all (n, E)."""
    n, n_events = probability.shape
    asked = np.arange(n_events) % stride == (np.zeros(n, np.int64) if offset is None else offset)[:, None]
    total = probability.sum(axis=1)
    return Events(np.where(asked, stride * probability, 0.0), np.where(asked, crashes, 0), elementary.log(total), total)


class Chosen(NamedTuple):
    """Events (m,) that were chosen: what has to be known to repeat them.

    ``facts`` (m,) are the family's; the event is in step ``at`` (m,), -1 for none, and shows itself ``lead`` (m,) steps
    earlier.
    """

    facts: RecordArray
    at: IntArray
    lead: IntArray


FAR_ABOVE = 10.0
"""Times the highest shipped exposure: one beyond that is likely to count other events [assumed]."""


class Exposure(NamedTuple):
    """How many events there are in an hour of driving, between ``low`` and ``high``.

    ``counted`` are events and the hours in which they were, of which the ends are 90 % Poisson limits; None where it is
    assumed. ``source`` says where it is from.
    """

    per_hour: float
    low: float
    high: float
    counted: tuple[int, float] | None
    source: str


class Driven(NamedTuple):
    """How events (m,) end for drivers (D,).

    ``end`` (m, D) is the step after which each has run into the principal vehicle, below zero for never. Of the last
    event ``motion`` (D, steps + 1, 2) is each one's position (m) and speed (m/s), 0 where nobody drives, and ``ahead``
    (steps + 1, 2) the principal vehicle's as if nobody had hit it; both are empty unless they were asked for.
    """

    end: IntArray
    motion: FloatArray
    ahead: FloatArray


N_MEAN_PATHS = 1024
"""Paths over which means are taken."""


class Family(Protocol):
    """A kind of events, and what most have alike. ``traffic`` is all that its kernels need of its environment.

    A family has to say the names below that have no value, and `exposure`, `start`, `events`, `choose` and `script`.
    """

    name: str
    vehicles: tuple[str, ...]
    """Names of the vehicles of a cell, the AV last."""
    principal: int
    """Place of the vehicle that events are about."""
    ahead: int
    """Place of the one ahead of it, -1 without one."""
    columns: tuple[Column, ...]
    """The facts that records keep."""
    n_uniforms: int
    """From how many uniforms the beginning of a path is made: what a pool is aimed over."""
    model: type[Parameters]
    """Its parameter files; ``folder`` has those that a name alone stands for."""
    default_parameters: str
    """The one of them where nothing is said."""
    ladders: Mapping[bool, str]
    """Libraries of surrogates where nothing is said, by whether events show themselves before they happen."""
    follows: bool
    """Whether the AV drives from the start, behind a vehicle that does not look at it: events do not depend on it."""
    stride: int = 1
    """Events of a path between two that a pool asks."""
    pool_error: float = 0.01
    """Relative standard error of its surrogates' crash rates where nothing is said."""
    outside_kept: int = 1
    """Of shells outside the boundary a pool keeps so many times as many events: a vehicle that never crashes is known
    by them."""
    fitter: str = ""
    """Its fit to trajectories (`harness.fitting.protocol.Fitter`), ``module:class``; empty without one."""
    sources: Mapping[Method, str] = MappingProxyType({})
    """Methods of its own, which draw the event in the loop: a `harness.sampling.protocol.Source` each, as above."""
    crosses: int
    """Place of the vehicle that changes lanes, -1 for none."""
    maps: tuple[tuple[Shown, Shown], ...] = ((GAP, CLOSING),)
    """Axes (x, y) of their maps."""
    stand_ins: Mapping[str, tuple[str, Surrogate]] = MappingProxyType({})
    """Who is driven in the AV's place (`drive`), by name: a phrase and the driver, the reference driver first."""

    @property
    def words(self) -> Words:
        """What pages say of events."""
        return words_of(event=f"{self.name} event", of=self.vehicles[self.principal])

    @property
    def shipped(self) -> Path:
        """Folder of the parameter files that a name alone stands for."""
        return self.model.folder

    def parameters(self, settings: EnvironmentSettings) -> Any:
        """The numbers that a campaign's environment names.

        Raises `CampaignError`: the file is missing or wrong, every place being named, or its laws are unsound.
        """
        file = shipped_or_own(settings.named(self.default_parameters), self.shipped, "environment.parameters")
        return read_model(file, self.model)

    def traffic(self, settings: EnvironmentSettings, parameters: Any = None) -> Environment:
        """All that kernels need; ``parameters`` are read unless they are given. Here the parameters themselves."""
        return parameters or self.parameters(settings)

    def traffic_with(
        self, settings: EnvironmentSettings, parameters: Any, values: Mapping[str, float]
    ) -> Environment | None:
        """The same with other numbers; None where they give no laws."""
        try:
            return self.traffic(settings, parameters.with_values(values))
        except (CampaignError, ValueError):
            return None

    def digest(self, traffic: Environment) -> str:
        """Hash of all numbers of it."""
        return hashlib.sha256(_numbers_in(traffic)).hexdigest()[:24]

    def max_steps(self, traffic: Environment) -> int:
        """Steps of the longest test: of any script."""
        return int(self.uneventful(traffic, 1).speed.shape[1])

    def sideways_m(self, traffic: Environment) -> float:
        """Way (m) from a first lateral motion to overlap; 0 where nobody changes lanes."""
        if self.crosses not in (-1, self.principal):
            raise NotImplementedError(f"{self.name} says how far its vehicle {self.crosses} moves sideways")
        return 0.0 if self.crosses < 0 else TO_OVERLAP_M

    def shows(self, traffic: Environment) -> bool:
        """Whether events can be seen before they happen."""
        return False

    def exposure(self, traffic: Environment, parameters: Any) -> Exposure:
        """How often there are events, as `Events.probability` counts them."""

    def milder(self, traffic: Environment) -> Environment | None:
        """The same with events that are too mild to count, of which some are driven all the same; None without any."""
        return None

    def mean_distance_m(self, traffic: Environment) -> float | None:
        """Mean distance (m) that an AV which keeps its speed drives where nothing happens.

        None where tests know no such distance, as between two events that happen for certain.
        """
        return None

    def mean_speed_mps(self, traffic: Environment) -> float:
        """Mean speed (m/s) of the AV on the road that its exposure is of; here that with which its tests begin."""
        return float(self.uneventful(traffic, N_MEAN_PATHS).v[:, -1].mean())

    def start(self, traffic: Environment, u: FloatArray) -> RecordArray:
        """How paths begin, (n,), from uniforms (n, `n_uniforms`)."""

    def events(
        self,
        traffic: Environment,
        seed: int,
        paths: Paths,
        drivers: Followers,
        recorded: Recorded = HOLDING,
        stride: int = 1,
        offset: IntArray | None = None,
    ) -> Events:
        """Every ``stride``-th event of paths, from each one's ``offset`` (n,) on, and which drivers crash on it.

        The AV keeps its speed until the event, or did what is ``recorded``; drivers take over from it after the onset.
        """

    def choose(self, traffic: Environment, seed: int, paths: Paths, event: IntArray, *, of_pool: bool = True) -> Chosen:
        """Events of paths (m,), one of each, -1 for none; those of a pool are drawn each for itself."""

    def onset(self, traffic: Environment, chosen: Chosen) -> IntArray:
        """Steps (m,) at whose end chosen events begin, -1 for none; what happens in them may be later."""
        return np.where(chosen.at < 0, -1, np.maximum(chosen.at - chosen.lead, 0))

    def first_onset(self, traffic: Environment) -> int | None:
        """Step at whose end the earliest event begins, where it follows from the traffic alone; else None."""
        return None

    def told(self, facts: Mapping[str, Any]) -> str:
        """What an event is like, by the columns of its test, as a phrase behind that of its onset; may be empty."""
        return ""

    def script(self, traffic: Environment, chosen: Chosen) -> Script:
        """The motion that chosen events are, from their facts alone."""

    def uneventful(self, traffic: Environment, n: int) -> Script:
        """The motion on ``n`` paths on which nothing happens."""
        paths = Paths(np.arange(n), self.start(traffic, uniforms(0, 0, n, INITIAL, self.n_uniforms)))
        return self.script(traffic, self.choose(traffic, 0, paths, np.full(n, -1)))

    def drive(
        self, traffic: Environment, chosen: Chosen, start: FloatArray, drivers: RecordArray, *, last: bool = False
    ) -> Driven:
        """Other drivers (D,) in the AV's place, on chosen events (m,), from the end of the step of the onset on.

        ``start`` (m, 2) is the AV's position (m) and speed (m/s) then, NaN where it has kept its speed until there.
        With ``last`` the motion on the last event is told. Nobody asks a family without `stand_ins`.
        """
        raise NotImplementedError


def _numbers_in(traffic: Any) -> bytes:
    """All numbers of a traffic: of parameters, or of a tuple, as kernels take it."""
    if isinstance(traffic, ParameterFile):
        return traffic.content_hash().encode()
    if isinstance(traffic, tuple):
        return b"".join(map(_numbers_in, traffic))
    numbers = np.asarray(traffic)
    if numbers.dtype.hasobject:
        raise TypeError(f"{type(traffic).__name__} in a traffic is no number: its family needs a digest of its own")
    return f"{numbers.dtype}{numbers.shape}".encode() + numbers.tobytes()
