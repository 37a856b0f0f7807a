"""An episode to watch: its motion, and that of others in the AV's place, as the script of a page plays it.

The others meet the same event in the twin: from where the AV was at its onset or, where all follow from the start, from
there on. What the vehicle ahead does after it was hit is drawn as if it had not been.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.campaign.campaign import Campaign
from harness.families import family_named
from harness.families.protocol import Driven, Environment, Family
from harness.numbers import tenths
from harness.pool.shells import onset_steps
from harness.records.schemas import chosen_from
from harness.report.summary import floats
from harness.report.templates import write_page
from harness.report.words import vehicle_words
from harness.shown import ShownInPython
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vehicles.library import library_records
from harness.vocabulary import FloatArray, IntArray

UNKNOWN = -9
"""How it ends for them where the AV acts before the event and its motion is not on record."""
MOTION = ("x_m", "v_mps")
LANE_M = 3.6
BRAKES_MPS2 = 0.5
"""Who slows down by less only coasts."""
UNDECIDED_S, STILL_MPS = 4.0, 0.05
"""Who ends with a shorter time to collision, and faster, has not avoided one yet."""
BEFORE, LEFT, FEWEST = 20, 5, 40
"""Steps shown before the onset, and when all is over; and at least up to the crash."""

Scene = dict[str, Any]
"""What the script reads. Moments are steps of the episode, positions (m) and speeds (m/s) those from ``first`` on."""


@dataclass(frozen=True, repr=False)
class ReplayResult(ShownInPython):
    """An episode run again: its row of the episodes table, and its motion with the schema of the traces table.

    ``bit_equal`` says whether what is stored, in the tables ``compared``, was reproduced in every bit, None where
    nothing is; ``changed`` says what may be why if it was not. ``scene`` is what a page plays; its ``facts`` are what
    happens, as pairs of a name and a phrase, and what is shown of it.
    """

    outcome: str
    row: dict[str, Any]
    trace: pa.Table
    bit_equal: bool | None
    compared: tuple[str, ...]
    scene: dict[str, Any]
    changed: str | None = None

    def _lines(self) -> list[str]:
        facts = [f"  {name:<18} {fact}" for name, fact in self.scene["facts"]]
        ended = {"timeout": "time up, no crash", "bv_lv_contact": "BV ran into LV"}.get(self.outcome, self.outcome)
        return [f"test {self.row['episode']}: {ended}", *facts]


class Scenes:
    """Scenes of a campaign's episodes; without its environment nobody else is driven.

    Rows are of the episodes table, in index order, with `path_columns`; traces are those of the same episodes.
    """

    def __init__(self, campaign: Campaign, environment: Environment | None) -> None:
        self._vehicle, self._acts = vehicle_words(campaign.av)[0], campaign.av.acts_before_event
        self._family, self._environment = family_named(campaign.scenario), environment

    def ends(self, rows: pa.Table, traces: pa.Table | None) -> IntArray:
        """Step after which each stand-in runs into the principal vehicle (n, D); below 0 for never, or `UNKNOWN`."""
        shape = rows.num_rows, len(self._family.stand_ins)
        if self._environment is None or 0 in shape:
            return np.full(shape, UNKNOWN)
        return self._drive(self._environment, rows, traces).end

    def _drive(
        self, environment: Environment, rows: pa.Table, traces: pa.Table | None, *, last: bool = False
    ) -> Driven:
        """What the stand-ins do in these episodes; with the motion in the ``last`` of them."""
        chosen = chosen_from(rows, self._family)
        start = np.full((rows.num_rows, 2), np.nan)
        if traces is not None:
            episode, step, x, v = (floats(_rows_of(traces, "AV").column(name)) for name in ("episode", "step", *MOTION))
            row = np.searchsorted(floats(rows.column("episode")), episode)
            begins = step == self._family.onset(environment, chosen)[row] + 1
            start[row[begins]] = np.stack((x, v), axis=1)[begins]
        others = [driver for _, driver in self._family.stand_ins.values()]
        drivers = library_records(others, self._family.shows(environment))
        driven = self._family.drive(environment, chosen, start, drivers, last=last)
        if self._acts:
            driven.end[np.isnan(start[:, 0])] = UNKNOWN
        return driven

    def scene(self, row: pa.Table, trace: pa.Table, *, why: str = "") -> Scene:
        """The scene of one episode, given its row and its trace: from shortly before the event on, if it has one."""
        trace = with_lateral(row, trace, self._family, self._environment)
        episode, outcome, cut = (row.column(name)[0].as_py() for name in ("episode", "outcome", "event_step"))
        rows = [(name, _rows_of(trace, name)) for name in self._family.vehicles]
        tracks = [{"name": name, **_states(own), "crash": None, "over": share_over(own)} for name, own in rows]
        bv, av = tracks[self._family.principal], tracks[-1]
        last = av["x"].size - 1
        av["crash"] = last if outcome == "crash" else None
        first, onset = 0, None
        ghosts, appearances = list[Scene](), list[tuple[int, str]]()
        if cut is not None and cut < last:
            chosen = chosen_from(row, self._family)
            onset = int(onset_steps(chosen.at, chosen.lead)[0])
            if self._environment is not None:
                onset = int(self._family.onset(self._environment, chosen)[0])
                ghosts = self._ghosts(self._environment, row, trace, onset, bv, av)
                from_step = self._family.script(self._environment, chosen).visible_from[0].tolist()
                appear = zip(from_step, self._family.vehicles, strict=False)
                appearances = [(step, f"{name} becomes visible") for step, name in appear if 0 < step <= last]
            first = max(min(onset - BEFORE, last - FEWEST), 0)
        for track in (*tracks, *ghosts):
            track |= {key: track[key][first:] for key in "xv"}
            track["brakes"] = _brakes(track["v"], first)
        for track in tracks:
            over = track["over"][first:]
            track["over"] = over if (over != over[0]).any() else over[:1]
        words = self._family.words
        moments = [(cut, " ".join(words.happens)), (av["brakes"], "AV brakes"), (av["crash"], "crash")]
        moments += [*appearances, (onset, " ".join(words.shows))] if onset != cut else appearances
        scene = {
            "vehicle": self._vehicle, "scenario": self._family.name, "episode": episode,
            "title": f"Test {episode:,}: {why or outcome}",
            "first": first, "onset": onset, "event": cut, "principal": bv["name"],
            "apart": None if onset is None else first if self._family.follows else onset + 1,
            "tracks": tracks, "ghosts": ghosts,
            "moments": sorted((step, name) for step, name in moments if step is not None),
        }  # fmt: skip
        (stored,) = row.to_pylist()
        event_words = self._family.told(stored) if onset is not None else ""
        cause = stored.get("failure")  # pages show none that failed
        return {**scene, "facts": _facts(scene, event_words, cause and f"FAILS at {STEP_S * last:.1f} s: {cause}")}

    def _ghosts(
        self, environment: Environment, row: pa.Table, trace: pa.Table, onset: int, bv: Scene, av: Scene
    ) -> list[Scene]:
        """Tracks of the stand-ins in an episode; ``bv`` goes on after the AV's crash as long as they are shown."""
        if not self._family.stand_ins:
            return []
        [end], motion, ahead = self._drive(environment, row, trace, last=True)
        last = shown = av["x"].size - 1
        if av["crash"] is not None:
            ends = zip(end, motion, strict=True)
            shown = max(_last_shown(last, int(ended), driven[:, 1], ahead[:, 1]) for ended, driven in ends)
            bv["x"] = np.append(bv["x"], ahead[last + 1 : shown + 1, 0])
            bv["v"] = np.append(bv["v"], ahead[last + 1 : shown + 1, 1])
        ghosts = []
        for name, ended, driven in zip(self._family.stand_ins, end.tolist(), motion, strict=True):
            steps = np.flatnonzero(driven[:, 0])
            begins, until = (int(steps[0]), min(shown, int(steps[-1]))) if steps.size else (onset + 1, onset)
            own = driven[begins : until + 1].T
            moves = {key: np.append(av[key][:begins], own[k]) for k, key in enumerate("xv")}
            ghosts.append({"name": name, **moves, "crash": ended if ended == until else None})
        return ghosts


def beside_other(scene: Scene, label: str, other: str, trace: pa.Table | None) -> Scene:
    """The scene of a crash of the vehicle ``label``, with the ``other`` as a ghost, which did not crash on this event.

    The scene has no ghosts yet. The vehicle ahead goes on after the crash as in the other's test, if that was traced.
    """
    first, av, ghosts = scene["first"], scene["tracks"][-1], list[Scene]()
    bv = scene["tracks"][family_named(scene["scenario"]).principal]
    endings = {other: "does not crash; its motion is not on record, and it cannot be run again"}
    if trace is not None:
        ghost, goes_on = (_states(_rows_of(trace, name)) for name in ("AV", bv["name"]))
        crash = first + av["x"].size - 1
        shown = _last_shown(crash, -1, ghost["v"], goes_on["v"]) + 1
        for key in "xv":
            bv[key] = np.append(bv[key], goes_on[key][crash + 1 : shown])
            ghost[key] = ghost[key][first:shown]
        ghosts.append(ghost | {"name": other, "crash": None, "brakes": _brakes(ghost["v"], first)})
        endings[other] = _ending(ghosts[0], scene)
    facts = [(name.replace("AV", label), phrase) for name, phrase in scene["facts"]]
    moments = [(step, name.replace("AV", label)) for step, name in scene["moments"]]
    av["label"] = label
    return {**scene, "ghosts": ghosts, "facts": [*facts, *endings.items()], "moments": moments}


def _states(rows: pa.Table) -> dict[str, Any]:
    return {"x": floats(rows.column("x_m")), "v": floats(rows.column("v_mps"))}


def with_lateral(row: pa.Table, trace: pa.Table, family: Family, environment: Environment | None) -> pa.Table:
    """The trace of an episode with ``lateral_m``, how far the vehicle that leaves its lane has moved sideways.

    Records have it already where vehicles come over; where the environment is not known it is left out.
    """
    if environment is None or "lateral_m" in trace.column_names or not row.column("event_step")[0].is_valid:
        return trace
    chosen = chosen_from(row, family)
    sideways_mps = float(family.script(environment, chosen).sideways_mps[0])
    if sideways_mps == 0.0 or family.crosses < 0:
        return trace
    steps = np.maximum(floats(trace.column("step")) - int(family.onset(environment, chosen)[0]), 0.0)
    moves = np.asarray(pc.equal(trace.column("vehicle").cast(pa.string()), family.vehicles[family.crosses]))
    lateral_m = np.where(moves, np.minimum(sideways_mps * STEP_S * steps, LANE_M), 0.0)
    return trace.append_column("lateral_m", pa.array(lateral_m))


def share_over(track: pa.Table) -> FloatArray:
    """Where a vehicle is between the left lane (0) and the right one (1), each row of its trace and until it is over.

    Where lane changes take time its record ends at the overlap; from there on it moves on sideways as fast.
    """
    over: FloatArray = 1.0 - floats(track.column("lane"))
    if "lateral_m" in track.column_names and over[0] == 1.0:
        return 1.0 - floats(track.column("lateral_m")) / LANE_M
    overlap = int(np.count_nonzero(over == 0.0))
    if "lateral_m" not in track.column_names or not overlap:
        return over
    lateral_m = floats(track.column("lateral_m"))
    if overlap < over.size:
        overlap_m = lateral_m[overlap]
        step_m = overlap_m - lateral_m[overlap - 1]
        rest = max(over.size - overlap, math.ceil((LANE_M - overlap_m) / step_m) + 1)
        lateral_m = np.append(lateral_m[:overlap], overlap_m + step_m * np.arange(rest))
    return np.minimum(lateral_m / LANE_M, 1.0)


def tracks_of(trace: pa.Table) -> dict[str, pa.Table]:
    """The rows of each vehicle of an episode's trace."""
    names = dict.fromkeys(trace.column("vehicle").cast(pa.string()).to_pylist())
    return {name: _rows_of(trace, name) for name in names}


def _rows_of(traces: pa.Table, vehicle: str) -> pa.Table:
    return traces.filter(pc.equal(traces.column("vehicle").cast(pa.string()), vehicle))


def _last_shown(crash: int, end: int, v: FloatArray, v_bv: FloatArray) -> int:
    """Last step that is shown of another driver after the AV's crash: it too has crashed, or no longer closes in."""
    until = end
    if end < 0:
        safe = np.flatnonzero(v[crash:] <= v_bv[crash:])
        until = crash + int(safe[0]) if safe.size else v_bv.size - 1
    return int(min(max(until, crash), v_bv.size - 1 - LEFT)) + LEFT


def _brakes(v: FloatArray, first: int) -> int | None:
    """In which step a vehicle first brakes; ``v`` are its speeds from the step ``first`` on."""
    braking = np.flatnonzero(np.diff(v) <= -BRAKES_MPS2 * STEP_S)
    return first + int(braking[0]) if braking.size else None


def _facts(scene: Scene, event: str, failed: str | None) -> list[tuple[str, str]]:
    """What happens, as pairs of a name and a phrase; ``event`` is that of the event, ``failed`` how the AV failed."""
    family = family_named(scene["scenario"])
    bv, av, words = scene["tracks"][family.principal], scene["tracks"][-1], family.words
    first, onset, cut = scene["first"], scene["onset"], scene["event"]
    if onset is None:
        ends = failed or (_ending(av, scene) if av["crash"] is not None else "")
        return [(words.shows[0], words.none), *[("AV", ends)] * bool(ends)]
    ahead, passed = _gap(av, bv, cut - first), _gap(bv, av, cut - first)
    rate = _closing(av, bv, cut - first)
    where = f"{tenths(ahead)} m ahead" if passed < 0.0 else f"{tenths(passed)} m behind"
    where += f" and {tenths(abs(rate))} m/s {'slower' if rate > 0.0 else 'faster'}"
    shows = event or f"{tenths(_gap(av, bv, onset - first))} m ahead"
    phrases = {
        " ".join(words.happens): where if bv["name"] == words.happens[0] else f"{bv['name']} is {where}",
        " ".join(words.shows): shows if onset != cut else ", ".join(filter(None, (event, where))),
        "AV brakes": f"at up to {tenths(-float(np.diff(av['v']).min()) / STEP_S)} m/s²",
    }
    moments = [(step, name) for step, name in scene["moments"] if name in phrases]
    ends = f"{STEP_S * cut:.1f} to {STEP_S * (cut + 1):.1f} s"  # a lane changes in this step, a row has it at its end
    times = [ends if step == cut and family.crosses >= 0 else _when(step, cut, words.since) for step, _ in moments]
    facts = [(name, f"{when}: {phrases[name]}") for when, (_, name) in zip(times, moments, strict=True)]
    facts += [("AV brakes", "never")] if av["brakes"] is None else []
    place = onset - first
    for track in (av, *scene["ghosts"]):
        remarks = [] if track is av else [family.stand_ins[track["name"]][0]]
        if family.follows:  # how it ends may hang on nothing else
            ahead = min(_gap(track, other, place) for other in scene["tracks"][:-1])
            remarks.append(f"{tenths(ahead / track['v'][place])} s behind at the onset")
        ends = (track is av and failed) or _ending(track, scene)
        facts.append((track["name"], ": ".join(filter(None, (", ".join(remarks), ends)))))
    return facts


def _ending(track: Scene, scene: Scene) -> str:
    """How it ends for one who follows the principal vehicle after its event, or who crashes before the event."""
    family, others = family_named(scene["scenario"]), scene["tracks"][:-1]
    first, cut, crash = scene["first"], scene["event"], track["crash"]
    early, bv = scene["onset"] is None, others[family.principal]
    if crash is None:
        places = () if early else range(cut + 1 - first, min(len(track["x"]), len(bv["x"])))
        if not places:  # it has ended before the event, by an impact too soft to count
            return "does not crash"
        (closest, nearest), end = min((_gap(track, bv, place), place) for place in places), places[-1]
        if _gap(bv, track, end) >= 0.0:
            return f"has passed {bv['name']}"
        if closest < 0.0:
            return f"touches {bv['name']} at {tenths(_closing(track, bv, nearest))} m/s, too softly to count"
        gap = f"{tenths(closest)} m" if closest >= 0.05 else "< 0.1 m"
        if (rate := _closing(track, bv, end)) > STILL_MPS and _gap(track, bv, end) < rate * UNDECIDED_S:
            return f"no crash until the test ends, {gap} behind {bv['name']} and still {tenths(rate)} m/s faster"
        return f"avoids it, {gap} at the closest" + f" since {family.words.since}" * bool(scene["onset"] < cut)
    contact = crash - first
    bv = min(others, key=lambda each: abs(_gap(track, each, contact))) if early else bv
    v, v_bv = (tenths(float(each["v"][contact])) for each in (track, bv))
    from_the_side = not early and family.crosses == family.principal and scene["onset"] < cut and crash == cut + 1
    who = f"{bv['name']} moves sideways into it" if from_the_side else f"strikes {bv['name']} from behind"
    when = f"{STEP_S * crash:.1f} s, before anything happens" if early else _when(crash, cut, family.words.since)
    speeds = f"it drives {v} m/s, {bv['name']} {v_bv} m/s"
    return f"crashes at {when}: {who}; {speeds}: impact {tenths(_closing(track, bv, contact))} m/s"


def _gap(track: Scene, bv: Scene, place: int) -> float:
    return float(bv["x"][place] - VEHICLE_LENGTH_M - track["x"][place])


def _closing(track: Scene, bv: Scene, place: int) -> float:
    return float(track["v"][place] - bv["v"][place])


def _when(step: int, cut: int, since: str) -> str:
    """The time of a step, and how far it is from the event, which happens at ``since``."""
    if step == cut:
        return f"{STEP_S * step:.1f} s"
    side = "after" if step > cut else "before"
    return f"{STEP_S * step:.1f} s, {STEP_S * abs(step - cut):.1f} s {side} {since}"


def write_player(result: ReplayResult, file: Path) -> None:
    """Write a page with nothing but the player of an episode."""
    scene, family = result.scene, family_named(result.scene["scenario"])
    write_page(file, "replay.html.j2", scene=scene, scenes=[scene], family=family, words=family.words)
