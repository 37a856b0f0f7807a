"""A crash as a time-space diagram: where LV, BV and AV were, and how fast."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes

from harness.records.schemas import VEHICLES
from harness.report.fine_histogram import Floats
from harness.report.number_format import decimal
from harness.report.plot_style import HALF_WIDTH_IN, INK, VEHICLE_COLOURS, Plot, new_figure
from harness.report.worst_crashes import Crash
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M

TRACE_COLUMNS = ("episode", "step", "vehicle", "lane", "x_m", "v_mps")
SECONDS_BEFORE_CUT_IN = 2.0
NAME_HEIGHT = 0.11
"""Least distance of two names beside the speed panel, as a share of its height."""


@dataclass(frozen=True)
class Track:
    """One vehicle's motion; all of shape (n_steps,): time in s, front bumper in m, speed in m/s, lane (0 right)."""

    time_s: Floats
    x_m: Floats
    v_mps: Floats
    lane: Floats


def tracks_of(traces: pa.Table, episode: int) -> dict[str, Track]:
    """Tracks of an episode by vehicle, in the order of steps; empty when it was not traced."""
    rows = traces.filter(pc.equal(traces.column("episode"), episode))
    tracks = {}
    for vehicle in VEHICLES:
        part = rows.filter(pc.equal(rows.column("vehicle").cast(pa.string()), vehicle)).sort_by("step")
        if part.num_rows:
            step, x_m, v_mps, lane = (
                part.column(name).to_numpy().astype(np.float64) for name in ("step", "x_m", "v_mps", "lane")
            )
            tracks[vehicle] = Track(STEP_S * step, x_m, v_mps, lane)
    return tracks


def time_space_plot(crash: Crash, tracks: dict[str, Track], *, worth: str) -> Plot:
    """Positions in a frame that moves with BV's initial speed, and speeds, with cut-in and crash marked.

    ``worth`` ends the caption: what the crash means for the estimate.
    """
    figure = new_figure(HALF_WIDTH_IN, 4.7)
    position, speed = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    frame_mps = float(tracks["BV"].v_mps[0]) if "BV" in tracks else crash.v_bv_mps
    for vehicle, track in tracks.items():
        _draw_positions(position, vehicle, track, frame_mps)
        speed.plot(track.time_s, track.v_mps, color=VEHICLE_COLOURS[vehicle])
    for axes in (position, speed):
        _mark_cut_in(axes, crash, with_label=axes is position)
    _mark_crash(position, speed, crash, tracks, frame_mps)
    _label(position, speed, crash, tracks, frame_mps)
    alt = (
        f"Time-space diagram of episode {crash.episode}: BV cuts in at {decimal(crash.cut_in_time_s)} s, "
        f"{decimal(crash.cut_in_r2_m)} m before the AV; the AV hits it at {decimal(crash.crash_time_s)} s with "
        f"{decimal(crash.impact_speed_mps)} m/s."
    )
    caption = (
        f"R2 = {decimal(crash.cut_in_r2_m)} m and R2dot = {decimal(crash.cut_in_r2dot_mps)} m/s at the cut-in, crash "
        f"{decimal(crash.crash_time_s - crash.cut_in_time_s)} s later; {worth}."
    )
    return Plot(f"crash-{crash.episode:09d}", figure, alt, caption)


def _draw_positions(axes: Axes, vehicle: str, track: Track, frame_mps: float) -> None:
    """Draw the vehicle as a band from rear to front bumper; paler while it is on the left lane."""
    front = track.x_m - frame_mps * track.time_s
    colour = VEHICLE_COLOURS[vehicle]
    for lane, alpha in ((1, 0.28), (0, 0.62)):
        on_lane = track.lane == lane
        # A band drawn over the mask alone would leave a gap of one step at the lane change.
        on_lane = on_lane | np.r_[False, on_lane[:-1]] if lane == 1 else on_lane
        axes.fill_between(
            track.time_s, front - VEHICLE_LENGTH_M, front, where=on_lane, color=colour, alpha=alpha, linewidth=0
        )
    axes.plot(track.time_s, front, color=colour, linewidth=1.2)


def _mark_cut_in(axes: Axes, crash: Crash, *, with_label: bool) -> None:
    axes.axvline(crash.cut_in_time_s, color=INK, linewidth=0.9, linestyle=(0, (4, 3)))
    if with_label:
        axes.annotate(
            "cut-in",
            (crash.cut_in_time_s, 0.0),
            xycoords=("data", "axes fraction"),
            xytext=(-4, 5),
            textcoords="offset points",
            ha="right",
            color=INK,
            fontsize=8,
        )


def _mark_crash(position: Axes, speed: Axes, crash: Crash, tracks: dict[str, Track], frame_mps: float) -> None:
    if "AV" in tracks:
        track = tracks["AV"]
        at_crash = float(np.interp(crash.crash_time_s, track.time_s, track.x_m)) - frame_mps * crash.crash_time_s
        position.plot([crash.crash_time_s], [at_crash], "X", color=INK, markersize=9, clip_on=False, zorder=5)
    if {"AV", "BV"} <= tracks.keys():
        ends = [float(np.interp(crash.crash_time_s, tracks[v].time_s, tracks[v].v_mps)) for v in ("BV", "AV")]
        speed.plot([crash.crash_time_s] * 2, ends, color=INK, linewidth=1.4, clip_on=False, zorder=4)


def _label(position: Axes, speed: Axes, crash: Crash, tracks: dict[str, Track], frame_mps: float) -> None:
    start = max(min(crash.cut_in_time_s - SECONDS_BEFORE_CUT_IN, crash.crash_time_s - 4.0), 0.0)
    end = crash.crash_time_s + 0.06 * (crash.crash_time_s - start)
    position.set_xlim(start, end)
    _fit_height(position, tracks, frame_mps, start, crash.crash_time_s)
    _name_vehicles(position, tracks, frame_mps, start)
    position.set_title(f"Episode {crash.episode:,}: impact at {decimal(crash.impact_speed_mps)} m/s")
    position.set_ylabel(f"position in a frame\nmoving at {frame_mps:.1f} m/s, m")
    _name_speeds(speed, tracks, crash.crash_time_s)
    speed.set_ylabel("speed, m/s")
    speed.set_xlabel("time, s")
    for axis in (speed.xaxis, speed.yaxis, position.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")


def _name_vehicles(axes: Axes, tracks: dict[str, Track], frame_mps: float, start: float) -> None:
    """Name each band at its left end; an LV beyond the panel is named at the panel's edge."""
    top = axes.get_ylim()[1]
    for vehicle, track in tracks.items():
        front = float(np.interp(start, track.time_s, track.x_m)) - frame_mps * start
        outside = front > top
        axes.annotate(
            f"{vehicle}, {front - top:.0f} m further" if outside else vehicle,
            (start, min(front, top)),
            xytext=(5, -3 if outside else 4),
            textcoords="offset points",
            va="top" if outside else "bottom",
            color=VEHICLE_COLOURS[vehicle],
            fontweight="bold",
        )


def _name_speeds(axes: Axes, tracks: dict[str, Track], end: float) -> None:
    """Name each line right of the panel, at its height at the crash; names of nearly equal speeds move apart."""
    low, high = axes.get_ylim()
    heights = {vehicle: float(np.interp(end, track.time_s, track.v_mps)) for vehicle, track in tracks.items()}
    lowest = -math.inf
    for vehicle in sorted(heights, key=lambda name: heights[name]):
        lowest = max((heights[vehicle] - low) / (high - low), lowest + NAME_HEIGHT)
        axes.annotate(
            vehicle,
            (1.0, lowest),
            xycoords="axes fraction",
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            color=VEHICLE_COLOURS[vehicle],
            fontweight="bold",
            annotation_clip=False,
        )


def _fit_height(axes: Axes, tracks: dict[str, Track], frame_mps: float, start: float, end: float) -> None:
    """Fit AV and BV; an LV far ahead may leave the panel rather than flatten what matters."""
    fronts = {
        vehicle: (track.x_m - frame_mps * track.time_s)[(track.time_s >= start) & (track.time_s <= end)]
        for vehicle, track in tracks.items()
    }
    near = np.concatenate([f for vehicle, f in fronts.items() if vehicle != "LV" or len(fronts) == 1])
    low, high = float(near.min()) - VEHICLE_LENGTH_M, float(near.max())
    if "LV" in fronts and fronts["LV"].size:
        high = max(high, min(float(fronts["LV"].max()), high + 1.5 * (high - low)))
    margin = 0.07 * (high - low)
    axes.set_ylim(low - margin, high + 2.0 * margin)
