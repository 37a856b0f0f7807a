"""The worst crashes: a row of the table for each, and of those that were traced a time-space diagram.

The diagram shows where LV, BV and AV were, in a frame that moves with BV's initial speed, and how fast.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes

from harness.numbers import number, tenths
from harness.records.reader import read_traces, stored_columns
from harness.report.style import HALF_WIDTH_IN, INK, VEHICLE_COLOURS, Plot, head, new_figure
from harness.report.summary import RunFolder, RunSummary, floats
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import VEHICLES, FloatArray

CANDIDATES, SHOWN = 50, 3
"""Crashes considered and shown per ranking: with a share of traces only some of the worst have one."""
SECONDS_BEFORE_CUT_IN = 2.0


class Crash(NamedTuple):
    """One crash; units as in the schema of ``episodes``, ``weight`` as in `RunSummary`."""

    episode: int
    impact_speed_mps: float
    crash_time_s: float
    weight: float
    cut_in_s: float
    cut_in_r2_m: float
    cut_in_r2dot_mps: float
    component: int


class GalleryRow(NamedTuple):
    """One crash in the table: why it is there, how to see it again, and its diagram if it was traced."""

    crash: Crash
    reason: str
    share_of_estimate: float
    component: str
    command: str
    plot: Plot | None


class Track(NamedTuple):
    """One vehicle's motion; all of shape (n_steps,): time (s), front bumper (m), speed (m/s), lane (0 right).

    The front bumper is in a frame that moves with BV's initial speed. ``lateral_m`` is how far the vehicle has come
    over, zeros where cut-ins are one step.
    """

    time_s: FloatArray
    front_m: FloatArray
    v_mps: FloatArray
    lane: FloatArray
    lateral_m: FloatArray

    def at(self, time_s: float, values: FloatArray) -> float:
        """One of its values at a time between steps."""
        return float(np.interp(time_s, self.time_s, values))


def worst_crashes(summary: RunSummary, key: str) -> list[Crash]:
    """The `CANDIDATES` largest by a column; ties go to the smaller episode index."""
    crashes = summary.crashes
    order = np.lexsort((crashes["episode"], -crashes[key]))[:CANDIDATES]
    found: list[dict[str, Any]] = [{name: float(crashes[name][row]) for name in Crash._fields} for row in order]
    return [Crash(**of | {name: int(of[name]) for name in ("episode", "component")}) for of in found]


def crash_gallery(run: RunFolder, summary: RunSummary) -> list[GalleryRow]:
    """Hardest impacts first, then the largest weights (of shells: the outermost) that are not among them.

    Traced crashes go first where some of the worst have no trace: a diagram is worth more than a rank.
    """
    rankings = {"impact": worst_crashes(summary, "impact_speed_mps")}
    if summary.from_shells:
        rankings["outermost"] = worst_crashes(summary, "component")
    elif not summary.all_weights_one:
        rankings["weight"] = worst_crashes(summary, "weight")
    episodes = {crash.episode for ranked in rankings.values() for crash in ranked}
    lateral = ["lateral_m"] if "lead_steps" in stored_columns(run.path) else []
    traces = read_traces(run.path, episodes, ["episode", "step", "vehicle", "lane", "x_m", "v_mps", *lateral])
    traced = set() if traces is None else set(traces.column("episode").unique().to_pylist())
    reasons: dict[Crash, list[str]] = {}
    for reason, ranked in rankings.items():
        chosen = sorted(enumerate(ranked, 1), key=lambda item: item[1].episode not in traced)[:SHOWN]
        for rank, crash in sorted(chosen):
            reasons.setdefault(crash, []).append(f"{reason} no. {rank}")
    total = float(summary.crashes["weight"].sum())
    rows = []
    for crash, why in reasons.items():
        component, worth = _component_name(run, crash.component), f"weight {number(crash.weight)}"
        if summary.from_shells:
            worth = f"in the shell {component}, adding {number(crash.weight)} to the rate"
        plot = time_space_plot(crash, _tracks(traces, crash.episode), worth=worth) if crash.episode in traced else None
        share = crash.weight / total if total > 0.0 else math.nan
        command = f"harness replay {run.typed} {crash.episode}"
        rows.append(GalleryRow(crash, ", ".join(why), share, component, command, plot))
    return rows


def _component_name(run: RunFolder, component: int) -> str:
    """Name the shell of an episode, or the importance function it followed, of which the forced cut-in is the first."""
    names = ["forced", *run.campaign.surrogates] if run.shells is None else [s.shell for s in run.shells.shells]
    if component < 0:
        return "–"
    return names[component] if component < len(names) else str(component)


def _tracks(traces: pa.Table, episode: int) -> dict[str, Track]:
    """Tracks of an episode by vehicle."""
    rows = traces.filter(pc.equal(traces.column("episode"), episode)).sort_by("step")
    of = {name: rows.filter(pc.equal(rows.column("vehicle").cast(pa.string()), name)) for name in VEHICLES}
    frame_mps = of["BV"].column("v_mps")[0].as_py()
    tracks = {}
    for vehicle, part in of.items():
        step, x, v, lane = (floats(part.column(name)) for name in ("step", "x_m", "v_mps", "lane"))
        over = floats(part.column("lateral_m")) if "lateral_m" in part.column_names else np.zeros(v.shape)
        tracks[vehicle] = Track(STEP_S * step, x - frame_mps * STEP_S * step, v, lane, over)
    return tracks


def time_space_plot(crash: Crash, tracks: dict[str, Track], *, worth: str) -> Plot:
    """Positions in a frame that moves with BV's initial speed, and speeds, with cut-in and crash marked.

    ``worth`` ends the caption: what the crash means for the estimate.
    """
    av, bv, end_s = tracks["AV"], tracks["BV"], crash.crash_time_s
    over = bool((bv.lateral_m > 0.0).any())
    figure = new_figure(HALF_WIDTH_IN, 5.7 if over else 4.7)
    heights = (3, 2, 1) if over else (3, 2)
    position, speed, *lateral = panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    for vehicle, track in tracks.items():
        _draw_positions(position, vehicle, track)
        speed.plot(track.time_s, track.v_mps, color=VEHICLE_COLOURS[vehicle])
    position.plot(
        [end_s], [av.at(end_s, av.front_m)], "X", color=INK, markersize=9, clip_on=False, zorder=5, label="crash"
    )
    ends = [track.at(end_s, track.v_mps) for track in (bv, av)]
    speed.plot([end_s] * 2, ends, color=INK, linewidth=1.4, clip_on=False, zorder=4)
    start_s = max(min(crash.cut_in_s - SECONDS_BEFORE_CUT_IN, end_s - 4.0), 0.0)
    marks, came = [(crash.cut_in_s, "cut-in", (4, 3))], ""
    if over:
        onset_s = float(bv.time_s[max(int(np.argmax(bv.lateral_m > 0.0)) - 1, 0)])
        marks.append((onset_s, "onset", (1, 2)))
        start_s = min(start_s, onset_s - 0.5)
        came = f"BV came over for {tenths(crash.cut_in_s + STEP_S - onset_s)} s before; "
        lateral[0].plot(bv.time_s, bv.lateral_m, color=VEHICLE_COLOURS["BV"])
        lateral[0].set_ylabel("BV over, m")
    for time_s, name, dashes in marks:
        for axes in panels:
            axes.axvline(time_s, color=INK, linewidth=0.9, linestyle=(0, dashes), label=name)
    position.set_xlim(start_s, end_s + 0.06 * (end_s - start_s))
    _fit_height(position, tracks, start_s, end_s)
    head(position, f"Episode {crash.episode:,}: impact at {tenths(crash.impact_speed_mps)} m/s")
    position.set_ylabel(f"position in a frame\nmoving at {bv.v_mps[0]:.1f} m/s, m")
    speed.set_ylabel("speed, m/s")
    panels[-1].set_xlabel("time, s")
    for axis in (speed.xaxis, speed.yaxis, position.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    alt = (
        f"Time-space diagram of episode {crash.episode}: BV cuts in at {tenths(crash.cut_in_s)} s, "
        f"{tenths(crash.cut_in_r2_m)} m before the AV; the AV hits it at {tenths(end_s)} s with "
        f"{tenths(crash.impact_speed_mps)} m/s."
    )
    caption = (
        f"R2 = {tenths(crash.cut_in_r2_m)} m and R2dot = {tenths(crash.cut_in_r2dot_mps)} m/s at the cut-in, crash "
        f"{tenths(end_s - crash.cut_in_s)} s later; {came}{worth}."
    )
    return Plot(f"crash-{crash.episode:09d}", figure, alt, caption)


def _draw_positions(axes: Axes, vehicle: str, track: Track) -> None:
    """Draw the vehicle as a band from rear to front bumper; paler while it is on the left lane."""
    rear, colour = track.front_m - VEHICLE_LENGTH_M, VEHICLE_COLOURS[vehicle]
    for lane, alpha in ((1, 0.28), (0, 0.62)):
        on_lane = track.lane == lane
        # A band drawn over the mask alone would leave a gap of one step at the lane change.
        on_lane = on_lane | np.r_[False, on_lane[:-1]] if lane == 1 else on_lane
        axes.fill_between(track.time_s, rear, track.front_m, where=on_lane, color=colour, alpha=alpha, linewidth=0)
    axes.plot(track.time_s, track.front_m, color=colour, linewidth=1.2, label=vehicle)


def _fit_height(axes: Axes, tracks: dict[str, Track], start_s: float, end_s: float) -> None:
    """Fit AV and BV; an LV far ahead may leave the panel rather than flatten what matters."""
    lv, bv, av = (
        track.front_m[(track.time_s >= start_s) & (track.time_s <= end_s)]
        for track in (tracks[vehicle] for vehicle in VEHICLES)
    )
    low, high = float(min(bv.min(), av.min())) - VEHICLE_LENGTH_M, float(max(bv.max(), av.max()))
    high = max(high, min(float(lv.max()), high + 1.5 * (high - low)))
    margin = 0.07 * (high - low)
    axes.set_ylim(low - margin, high + 2.0 * margin)
