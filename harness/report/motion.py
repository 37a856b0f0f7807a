"""The motion of an episode as a file, its suffix says of which kind; among them what SUMO itself repeats.

SUMO's own device for replays puts every vehicle where its floating car data say in every step, and makes their routes.
Nothing is decided anew but where a collision is, which SUMO finds in the step in which the test has ended by one.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory
from xml.sax.saxutils import quoteattr

import numpy as np
import pyarrow as pa
from pyarrow import csv

from harness.arguments import checked
from harness.errors import CampaignError, HarnessError
from harness.files import write_atomically
from harness.records.folder import write_bytes
from harness.report.player import ReplayResult, share_over, tracks_of, write_player
from harness.vehicles.kinematics import STEP_S
from harness.worlds.sumo import network_file, sumo_program

SUFFIXES = ".html", ".csv", ".xosc", ".xml", ".sumocfg"
ROAD_M, SUMO_LANE_M, INSIDE_M = 4000.0, 3.2, 0.01
"""Of the committed network; SUMO takes a vehicle to be on the lane that its middle is on, which it is by so much."""
COLOURS, OTHERS = {"LV": "#00795a", "AV": "#0067a8"}, "#c94f0a"
MARGIN_M, NARROWEST_M, WIDEST_M = 15.0, 80.0, 400.0
"""Of the road that the window shows."""


@checked("harness.write_motion")
def write_motion(result: ReplayResult, file: str | Path) -> Sequence[Path]:
    """Write what `harness.replay` has given into a file, and return the files that were written.

    Parameters
    ----------
    result : ReplayResult
        Motion of an episode.
    file : str or Path
        ``.html`` is a page that plays it; ``.csv`` has a row for each vehicle and step, with units in the columns'
        names; ``.xosc`` is OpenSCENARIO XML 1.2 (extra ``harness[export]``), with its OpenDRIVE road beside it
        (``.xodr``); ``.xml`` is SUMO's floating car data; ``.sumocfg`` runs in SUMO, with the files that it names
        beside it.

    Raises `HarnessError`: the name has another suffix, or the extra is missing.
    """
    file = Path(file)
    return writer_of(file)(result, file) or [file]


def writer_of(file: Path) -> Callable[[ReplayResult, Path], list[Path] | None]:
    """The function that writes files of this suffix, and returns them if they are several; raises as `write_motion`."""
    if file.suffix in WRITERS:
        return WRITERS[file.suffix]
    if file.suffix != ".xosc":
        found = f"a name that ends in '{file.suffix}'" if file.suffix else "a name without a suffix"
        expected, mend = f"one that ends in {', '.join(SUFFIXES)}", f"Write {file.with_suffix('.html')}, say."
        raise HarnessError(str(file), found, expected, mend)
    try:
        from harness.report.openscenario import write_openscenario  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        mend = "Install it, in the harness's folder: pip install -c requirements.lock -e '.[export]'."
        raise HarnessError(str(file), f"no package {error.name}", "the extra 'export'", mend) from error
    return write_openscenario


def _write_csv(result: ReplayResult, file: Path) -> None:
    trace = result.trace
    time_s = pa.array(np.round(trace.column("step").to_numpy() * STEP_S, 1))
    rows = trace.drop_columns(["episode", "step"]).add_column(0, "time_s", time_s)
    write_atomically(file, lambda unfinished: csv.write_csv(rows, unfinished))


def write_floating_car_data(result: ReplayResult, file: Path) -> None:
    """Write the motion of an episode as SUMO's floating car data, each number in every bit."""
    frames: dict[int, list[str]] = {}
    for name, track in tracks_of(result.trace).items():
        x, v, lane = (track.column(column).to_pylist() for column in ("x_m", "v_mps", "lane"))
        middle = SUMO_LANE_M * (0.5 - share_over(track)[: len(x)])
        y = np.where(np.asarray(lane) == 1, np.maximum(middle, INSIDE_M), np.minimum(middle, -INSIDE_M)).tolist()
        for step, (x_m, y_m, v_mps, index) in enumerate(zip(x, y, v, lane, strict=True)):
            frames.setdefault(step, []).append(
                f'<vehicle id={quoteattr(name)} x="{x_m!r}" y="{y_m!r}" angle="90.00" type={quoteattr(name)} '
                f'speed="{v_mps!r}" pos="{x_m!r}" lane="cell0_{index}" slope="0.00"/>'
            )
    lines: list[str] = []
    for step, vehicles in sorted(frames.items()):
        lines += [f'<timestep time="{step * STEP_S:.1f}">', *vehicles, "</timestep>"]
    _write(file, "fcd-export", lines)


def write_sumo(result: ReplayResult, file: Path) -> list[Path]:
    """Write ``file`` (.sumocfg) and beside it the network, the vehicles, their motion and what sumo-gui shows."""
    files = [file.with_suffix(f".{end}.xml") for end in ("net", "add", "fcd", "view")]
    network, vehicles, motion, view = (quoteattr(each.name) for each in files)
    scene, tracks = result.scene, tracks_of(result.trace)
    first, last = scene["first"], max(map(len, tracks.values())) - 1
    onset = first if scene["onset"] is None else scene["onset"]
    write_bytes(files[0], network_file(1).read_bytes())
    # The device lets vehicles begin no faster than maxSpeed; later in the replay they may be faster.
    types = [
        f'<vType id={quoteattr(name)} color="{COLOURS.get(name, OTHERS)}" length="5" minGap="0" accel="100" '
        f'decel="100" emergencyDecel="100" sigma="0" tau="0.1" speedDev="0" '
        f'maxSpeed="{max(track.column("v_mps")[first].as_py(), 0.001)!r}"/>'
        for name, track in tracks.items()
    ]
    _write(files[1], "additional", types)
    write_floating_car_data(result, files[2])
    shown = [track.column("x_m")[step].as_py() for track in tracks.values() for step in (onset, len(track) - 1)]
    left = min(shown) - MARGIN_M
    width = min(max(max(shown) + MARGIN_M - left, NARROWEST_M), WIDEST_M)
    names = '<vehicles vehicleQuality="2" vehicleName_show="1" vehicleName_size="70" vehicleName_color="white"/>'
    looks = [
        f'<scheme name="harness">{names}</scheme>', f'<delay value="{1000 * STEP_S:g}"/>',
        f'<viewport x="{left + width / 2:.1f}" y="0" zoom="{100 * ROAD_M / width:.0f}"/>',
    ]  # fmt: skip
    _write(files[3], "viewsettings", looks)
    # One step beyond the last: when its time is up sumo-gui asks whether to close, and its box would hide the crash.
    halts = ",".join(f"{step * STEP_S:.1f}" for step in (onset, last))
    settings = {
        "input": f"<net-file value={network}/><additional-files value={vehicles}/>",
        "time": f'<begin value="{first * STEP_S:.1f}"/><end value="{(last + 2) * STEP_S:.1f}"/>'
        f'<step-length value="{STEP_S}"/>',
        "processing": '<step-method.ballistic value="true"/><collision.action value="warn"/>'
        '<collision.mingap-factor value="0"/><insertion-checks value="none"/><time-to-teleport value="-1"/>',
        "report": '<xml-validation value="never"/><xml-validation.net value="never"/><no-step-log value="true"/>',
        "fcd_replay_device": f"<device.fcd-replay.files value={motion}/>",
        "gui_only": f'<gui-settings-file value={view}/><start value="true"/><breakpoints value="{halts}"/>'
        '<window-size value="1200,600"/>',
    }
    _write(file, "configuration", [f"<{name}>{content}</{name}>" for name, content in settings.items()])
    return [file, *files]


def _write(file: Path, root: str, lines: list[str]) -> None:
    write_bytes(file, "\n".join((f"<{root}>", *lines, f"</{root}>\n")).encode())


WRITERS: Mapping[str, Callable[[ReplayResult, Path], list[Path] | None]] = {
    ".html": write_player, ".csv": _write_csv, ".xml": write_floating_car_data, ".sumocfg": write_sumo,
}  # fmt: skip


def gui_program() -> Path:
    """``sumo-gui``, where it can open its window.

    Raises `CampaignError`: it is not installed, or there is no screen.
    """
    try:
        program = sumo_program("sumo-gui", "--gui")
    except CampaignError:
        if (own := which("sumo-gui")) is None:
            raise
        program = Path(own)
    if not os.environ.get("DISPLAY"):
        raise _no_window("no screen (the environment variable DISPLAY is not set)")
    return program


def watch(result: ReplayResult, program: Path) -> None:
    """Show an episode in sumo-gui, halted at its onset and at its end, until its window is closed."""
    with TemporaryDirectory() as folder:
        file = write_sumo(result, Path(folder) / "test.sumocfg")[0]
        ended = subprocess.run([program, "-c", file.name], cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603 - SUMO's own program
    if ended.returncode > 0:  # and not by a signal, which is how one may close it, too
        raise _no_window(f"a sumo-gui that ends with {ended.returncode}: {ended.stderr.strip()[-200:]}")


def _no_window(found: str) -> CampaignError:
    mend = "Start it from a desktop session (or with ssh -X), or write what it shows: --sumo DIR, or --out FILE.html."
    return CampaignError("--gui", found, "a desktop that sumo-gui can open its window on", mend)
