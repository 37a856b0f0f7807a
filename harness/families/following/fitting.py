"""Events that following drivers met, counted in trajectories, and the environment file that they give.

An exposure is events per hour of following: driving in the fit range behind a vehicle on the same lane, whoever drives
and on whichever lane. What a vehicle does is one event to the one driver who follows it then, to nobody if none does.
Limits are exact for a Poisson count; events that have one cause, such as a wave of braking, make them too narrow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from harness.campaign.sections import EnvironmentSettings
from harness.estimators.limits import garwood
from harness.families.following.family import FollowingFamily
from harness.families.protocol import FAR_ABOVE
from harness.families.words import EXCLUDED
from harness.fitting.files import OF_YAML, environment_text
from harness.fitting.protocol import FitRequest, Fitted
from harness.fitting.recording import Recording
from harness.fitting.tracks import R1_MAX_M, V_MAX_MPS, V_MIN_MPS, Scene
from harness.numbers import number
from harness.vocabulary import BoolArray, IntArray, RecordArray

FEWEST_COUNTED, FEWEST_OF_LAW = 5, 20
"""Fewest events from which a rate is taken, and a law [assumed]."""
MOST_OF_ONE = 0.2
"""Share of the events that are of one vehicle, above which they do not count as independent [assumed]."""
TAIL = 0.05
"""At each end of the limits of a rate."""
Numbers = dict[str, dict[str, Any]]


class Followed(NamedTuple):
    """Who follows whom in a recording of n rows.

    ``ahead`` (n,) is the row of the vehicle ahead on the lane, -1 without one; ``follows`` (n,) whether the driver's
    following counts; ``behind`` (n,) the row of a driver whose following of this one counts, -1 without one.
    """

    ahead: IntArray
    follows: BoolArray
    behind: IntArray


@lru_cache(maxsize=1)  # several families ask for the same recording
def followed(track: Recording) -> Followed:
    """Find the vehicle ahead in every row."""
    rows = np.arange(track.v.size)
    ahead, _ = Scene(track, np.ones(rows.size, np.bool_)).neighbours(rows, 0)
    gap = track.gap(ahead, rows)
    follows = track.fitted & (ahead >= 0) & (gap > 0.0) & (gap <= R1_MAX_M)
    follows &= (track.v >= V_MIN_MPS) & (track.v <= V_MAX_MPS)
    behind = np.full(rows.size, -1)
    behind[ahead[follows]] = rows[follows]
    return Followed(ahead, follows, behind)


class Seen(NamedTuple):
    """Hours of following in which events would have been seen, and the events; ``why`` a recording is not counted.

    ``of_one`` is the largest number of events of one vehicle.
    """

    hours: float
    events: RecordArray
    why: str = ""
    of_one: int = 0


def most_of_one(vehicle: IntArray) -> int:
    """Number of events of the vehicle that has most, by that of each event (k,)."""
    return int(np.bincount(vehicle).max(initial=0))


def fitted_number(value: float, se: float) -> dict[str, Any]:
    """A number of an environment file."""
    return {"value": float(f"{value:.4g}"), "source": "fitted", "se": float(f"{se:.2g}")}


class FollowingFitter:
    """See `harness.fitting.protocol.Fitter`; ``events`` are what a family's are called, in the plural."""

    family: FollowingFamily
    events: str

    def __init__(self) -> None:
        self._seen = list[Seen]()

    def seen(self, track: Recording) -> Seen:
        """Events in a recording."""
        raise NotImplementedError

    def numbers(self, events: RecordArray) -> Numbers:
        """Fitted numbers by section and name, from at least `FEWEST_OF_LAW` events."""
        raise NotImplementedError

    def share_counted(self, numbers: Numbers) -> float:
        """Share of the events of its law, with fitted ``numbers`` if there are any, that are counted: here all."""
        return 1.0

    def marks(self, out: Path) -> dict[Path, bytes]:
        return {out.with_name(f"{out.stem}.{self.family.name}.yaml"): OF_YAML}

    def observe(self, recording: Recording) -> None:
        self._seen.append(self.seen(recording))

    def fitted(self, request: FitRequest, others: Mapping[str, Fitted]) -> Fitted:
        base = self.family.default_parameters
        hours = math.fsum(each.hours for each in self._seen)
        events = np.concatenate([each.events for each in self._seen])
        law = self.numbers(events) if events.size >= FEWEST_OF_LAW else {}
        content, line = self._exposure(events.size, hours, self.share_counted(law))
        if law:
            content |= law
            fitted = [item for section in law.values() for item in section.items()]
            line += "; " + ", ".join(f"{name} {number(n['value'])} ± {number(n['se'], 2)}" for name, n in fitted)
        elif events.size >= FEWEST_COUNTED:
            line += f"; a law takes {FEWEST_OF_LAW}: kept is that of {base}"
        line += self._in_scope(content)
        n, reasons = len(self._seen), [each.why for each in self._seen if each.why]
        warnings = []
        if reasons:
            warnings.append(f"! {self.family.name}: {len(reasons)} of {n} recordings are not counted: {reasons[0]}")
        if (of_one := max(each.of_one for each in self._seen)) > max(1, MOST_OF_ONE * events.size):
            few = f"! {self.family.name}: {of_one} of {events.size} {self.events} are of one vehicle"
            warnings.append(f"{few}: the limits, which take them to be independent, are too narrow")
        head = [f"{n - len(reasons)} recordings.", line, f"The rest is as in {base}.", *request.provenance()]
        [file] = self.marks(request.out)
        text = environment_text(head, {"like": base, **content})
        facts = {self.family.name: {"events": events.size, "hours": hours, **content}}
        return Fitted({file: text.encode()}, (line, *warnings), facts)

    def _exposure(self, n: int, hours: float, share: float) -> tuple[Numbers, str]:
        """Section with the rate of n counted events, a ``share`` of all, or with the shipped one; and both in words."""
        shipped = self.family.parameters(EnvironmentSettings()).exposure.per_hour
        line = f"{self.family.name}: {n:,} {self.events} in {number(hours)} h of following"
        hours_of_all = hours * share
        low, high = (float(f"{end / max(hours_of_all, 1e-9):.4g}") for end in garwood(n, TAIL))
        limits = f"{number(low, 2)} to {number(high, 2)}"
        if n >= FEWEST_COUNTED:
            part = f", {share:.3g} of all by the law" * (share < 0.9995)
            note = f"{n} in {hours:.4g} h of following{part}"
            rate = {**fitted_number(n / hours_of_all, math.sqrt(n) / hours_of_all), "range": [low, high], "note": note}
            counted = {"exposure": {"per_hour": rate, "events": n, "hours": round(hours_of_all, 6)}}
            far = low > FAR_ABOVE * (shipped.range or [shipped.value])[-1]
            beside = f", {number(n / hours_of_all / shipped.value, 2)} times the shipped one (see docs/fit.md)" * far
            return counted, f"{line}{part}: {number(n / hours_of_all)} per hour ({limits}){beside}"
        needed = f", some {number(hours * FEWEST_COUNTED / n, 2)} h" if n else ""
        outside = not low <= shipped.value <= high
        remark = {"note": f"{shipped.note or shipped.source}; {EXCLUDED}: {n} in {hours:.4g} h of following"}
        content: Numbers = {"exposure": {"per_hour": shipped.model_dump(exclude_none=True) | remark}} if outside else {}
        excluded = ", which these data exclude (--exposure takes your own)" if outside else ""
        line += f" ({limits} per hour)" * (hours > 0.0)
        line += f"; at least {FEWEST_COUNTED} are needed{needed}: kept is {number(shipped.value)} per hour"
        return content, f"{line} [{shipped.source}]{excluded}, and the law of {self.family.default_parameters}"

    def _in_scope(self, content: Numbers) -> str:
        """In words: the part of the rate that is tested, unless all of it is."""
        settings = EnvironmentSettings()
        parameters = self.family.parameters(settings)
        numbers = {f"{section}__{name}": each for section, entries in content.items() for name, each in entries.items()}
        values = {name: each["value"] for name, each in numbers.items() if isinstance(each, dict)}
        traffic = self.family.traffic_with(settings, parameters, values)
        every = values.get("exposure__per_hour", parameters.exposure.per_hour.value)
        tested = number(every * (1.0 if traffic is None else self.family.share_in_scope(traffic)))
        return "" if tested == number(every) else f"; in scope, as --exposure takes them: {tested} per hour"
