"""What a family of events brings: paths on which nothing happens, the events on them, and their motion.

All that the harness does is: walk the others' motion without the event → list the events on it, each with its exact
probability → find out which drivers crash on each → repeat some of them → count. A family is a package with the methods
of `Family`, each called once per batch. Its kernels are its own, its answers are arrays. The core repeats its scripts,
judges, counts and shows them, and knows nothing else of it.
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
"""All that a family's kernels need of its traffic; only the family knows what is in it."""
Parameters: TypeAlias = ParameterFile
"""The numbers of a traffic, each with its provenance."""


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
    """How the AV moved on paths (n,) without an event; `HOLDING` (0,) for an AV that keeps its speed.

    ``n_steps`` (n,) are recorded; ``failed`` (n,) says whether the AV failed after them. ``x_m``, ``v_mps``
    (n, steps + 1) are its positions and speeds, undefined beyond ``n_steps``.
    """

    n_steps: IntArray
    failed: BoolArray
    x_m: FloatArray
    v_mps: FloatArray

    def mean_distance_m(self, weight: FloatArray) -> float:
        """Mean distance (m) that the AV drives without an event, over paths with the ``weight`` (n,)."""
        complete = ~self.failed
        distance = self.x_m[np.arange(len(self.n_steps)), self.n_steps] - self.x_m[:, 0]
        return float((weight * distance)[complete].sum() / weight[complete].sum())

    def digest(self) -> str:
        """Hash of all that is recorded."""
        digest = hashlib.sha256(self.n_steps.tobytes() + self.failed.tobytes())
        on_record = np.arange(self.x_m.shape[1]) <= self.n_steps[:, None]
        for values in (self.x_m, self.v_mps):
            digest.update(values[on_record].tobytes())
        return digest.hexdigest()


HOLDING = Recorded(np.zeros(0, np.int64), np.zeros(0, np.bool_), np.zeros((0, 1)), np.zeros((0, 1)))


class Paths(NamedTuple):
    """Paths (n,): the ``number`` of each, from which all its random numbers follow, and how it begins.

    ``start`` (n,) are records of the family's own, made from uniforms. They hold also what drivers are told of the
    path, such as the headway that people keep on it.
    """

    number: IntArray
    start: RecordArray


class Events(NamedTuple):
    """Events on paths: rows are paths, columns the family's grid of E events, of which every ``stride``-th is listed.

    ``probability`` (n, E) is ``stride`` · P(event | path) where it is listed, else 0: with uniform offsets the sum over
    any set of events has its probability as mean. ``crashes`` (n, E) has one bit per driver. ``log_any`` (n,) is the
    log probability that there is an event on the path. ``after_failure`` (n,) is an upper bound of the probability of
    an event after the failure of a recorded AV, wherever it may be then.
    """

    probability: FloatArray
    crashes: IntArray
    log_any: FloatArray
    after_failure: FloatArray


def every_event(probability: FloatArray, crashes: IntArray, stride: int = 1, offset: IntArray | None = None) -> Events:
    """Every ``stride``-th event from each ``offset`` (n,) on, where no AV changes the ``probability`` (n, E) of all."""
    n, n_events = probability.shape
    listed = np.arange(n_events) % stride == (np.zeros(n, np.int64) if offset is None else offset)[:, None]
    total = probability.sum(axis=1)
    return Events(
        np.where(listed, stride * probability, 0.0), np.where(listed, crashes, 0), elementary.log(total), total
    )


class Chosen(NamedTuple):
    """Chosen events (m,): all that is needed to repeat them.

    ``facts`` (m,) are the family's; the event is in step ``at`` (m,), -1 for none, and shows itself ``lead`` (m,) steps
    earlier.
    """

    facts: RecordArray
    at: IntArray
    lead: IntArray


FAR_ABOVE = 10.0
"""A fitted exposure so many times above the highest shipped one is likely to count other events [assumed]."""


class Exposure(NamedTuple):
    """How many events there are in an hour of driving, between ``low`` and ``high``.

    ``counted`` are a number of events and the hours in which they were counted; ``low`` and ``high`` are then 90 %
    Poisson limits. It is None for an assumed exposure. ``source`` says where it is from.
    """

    per_hour: float
    low: float
    high: float
    counted: tuple[int, float] | None
    source: str


class Driven(NamedTuple):
    """How events (m,) end for drivers (D,).

    ``end`` (m, D) is the step after which each has run into the principal vehicle, below zero for never. The motion on
    the last event is empty unless it was asked for: ``motion`` (D, steps + 1, 2) are positions (m) and speeds (m/s) of
    the drivers, 0 where nobody drives, ``ahead`` (steps + 1, 2) those of the principal vehicle as if nobody had hit it.
    """

    end: IntArray
    motion: FloatArray
    ahead: FloatArray


N_MEAN_PATHS = 1024
"""Paths over which means are taken."""


class Family(Protocol):
    """A kind of events, with defaults that suit most. ``traffic`` is all that its kernels need of its environment.

    A family has to define the names below that have no value, and `exposure`, `start`, `events`, `choose` and `script`.
    """

    name: str
    vehicles: tuple[str, ...]
    """Names of the vehicles of a cell, the AV last."""
    principal: int
    """Place, among the vehicles, of the one that events are about."""
    ahead: int
    """Place of the vehicle ahead of it, -1 without one."""
    columns: tuple[Column, ...]
    """The facts that records keep."""
    n_uniforms: int
    """Number of uniforms from which the beginning of a path is made; a pool's proposal is over these."""
    model: type[Parameters]
    """Class of its parameter files; the shipped ones lie in its ``folder``."""
    default_parameters: str
    """Name of the default parameter file."""
    ladders: Mapping[bool, str]
    """Default libraries of surrogates, by whether events show themselves before they happen."""
    follows: bool
    """Whether the AV drives from the start, behind a vehicle that does not look at it: events do not depend on it."""
    stride: int = 1
    """A pool lists every ``stride``-th event of a path."""
    pool_error: float = 0.01
    """Default relative standard error of the surrogates' crash rates in a pool."""
    outside_kept: int = 1
    """A pool keeps so many times as many events of shells outside the boundary: they decide how low the rate of a
    vehicle that never crashes is known to be."""
    fitter: str = ""
    """Its fit to trajectories (`harness.fitting.protocol.Fitter`), ``module:class``; empty without one."""
    sources: Mapping[Method, str] = MappingProxyType({})
    """Methods of its own, which draw the event in the loop: a `harness.sampling.protocol.Source` each, as above."""
    crosses: int
    """Place of the vehicle that changes lanes, -1 for none."""
    maps: tuple[tuple[Shown, Shown], ...] = ((GAP, CLOSING),)
    """Axes (x, y) of their maps."""
    stand_ins: Mapping[str, tuple[str, Surrogate]] = MappingProxyType({})
    """Drivers to put in the AV's place (`drive`), by name: a phrase and the driver, the reference driver first."""

    @property
    def words(self) -> Words:
        """Words for pages and terminals."""
        return words_of(event=f"{self.name} event", of=self.vehicles[self.principal])

    @property
    def shipped(self) -> Path:
        """Folder of the parameter files that a name alone stands for."""
        return self.model.folder

    def parameters(self, settings: EnvironmentSettings) -> Any:
        """The numbers that a campaign's environment names.

        Raises `CampaignError`: the file is missing or wrong (each wrong place is named), or its laws are unsound.
        """
        file = shipped_or_own(settings.named(self.default_parameters), self.shipped, "environment.parameters")
        return read_model(file, self.model)

    def traffic(self, settings: EnvironmentSettings, parameters: Any = None) -> Environment:
        """All that kernels need: here the parameters themselves. ``parameters`` are read unless they are given."""
        return parameters or self.parameters(settings)

    def traffic_with(
        self, settings: EnvironmentSettings, parameters: Any, values: Mapping[str, float]
    ) -> Environment | None:
        """The same with other ``values`` by name; None where they give no sound laws."""
        try:
            return self.traffic(settings, parameters.with_values(values))
        except (CampaignError, ValueError):
            return None

    def digest(self, traffic: Environment) -> str:
        """Hash of all numbers of a traffic."""
        return hashlib.sha256(_numbers_in(traffic)).hexdigest()[:24]

    def max_steps(self, traffic: Environment) -> int:
        """Steps of the longest test: of any script."""
        return int(self.uneventful(traffic, 1).speed.shape[1])

    def sideways_m(self, traffic: Environment) -> float:
        """Distance (m) from a first lateral motion to overlap; 0 where nobody changes lanes."""
        if self.crosses not in (-1, self.principal):
            raise NotImplementedError(f"{self.name} says how far its vehicle {self.crosses} moves sideways")
        return 0.0 if self.crosses < 0 else TO_OVERLAP_M

    def shows(self, traffic: Environment) -> bool:
        """Whether events can be seen before they happen."""
        return False

    def exposure(self, traffic: Environment, parameters: Any) -> Exposure:
        """How often there are events of the kind that `Events.probability` is about."""

    def milder(self, traffic: Environment) -> Environment | None:
        """Traffic whose events are too mild to be in scope, for a few tests of them; None without any."""
        return None

    def mean_distance_m(self, traffic: Environment) -> float | None:
        """Mean distance (m) that an AV which keeps its speed drives where nothing happens.

        None if a test has an event for certain, so that no test tells how far it is from one to the next.
        """
        return None

    def mean_speed_mps(self, traffic: Environment) -> float:
        """Mean speed (m/s) of the AV in the hours of its exposure; by default that with which its tests begin."""
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
        """One event of each path (m,), -1 for none; in a pool each event of a path has random numbers of its own."""

    def onset(self, traffic: Environment, chosen: Chosen) -> IntArray:
        """Steps (m,) at whose end chosen events begin, which may be before they happen; -1 for none."""
        return np.where(chosen.at < 0, -1, np.maximum(chosen.at - chosen.lead, 0))

    def first_onset(self, traffic: Environment) -> int | None:
        """Step at whose end the earliest event begins, where it follows from the traffic alone; else None."""
        return None

    def told(self, facts: Mapping[str, Any]) -> str:
        """Phrase that describes an event by the columns of its test, to follow that of its onset; may be empty."""
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
        With ``last`` the motion on the last event is given, too. Not called for a family without `stand_ins`.
        """
        raise NotImplementedError


def _numbers_in(traffic: Any) -> bytes:
    """All numbers of a traffic as bytes: of a parameter file, or of nested tuples of arrays, as kernels take them."""
    if isinstance(traffic, ParameterFile):
        return traffic.content_hash().encode()
    if isinstance(traffic, tuple):
        return b"".join(map(_numbers_in, traffic))
    numbers = np.asarray(traffic)
    if numbers.dtype.hasobject:
        raise TypeError(f"{type(traffic).__name__} in a traffic is no number: its family needs a digest of its own")
    return f"{numbers.dtype}{numbers.shape}".encode() + numbers.tobytes()
