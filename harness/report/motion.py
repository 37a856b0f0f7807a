"""The motion of an episode as a file: its suffix says of which kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from harness.arguments import checked
from harness.errors import HarnessError
from harness.files import write_atomically
from harness.report.player import ReplayResult, write_player
from harness.report.sumo_files import write_floating_car_data, write_sumo
from harness.vehicles.kinematics import STEP_S

SUFFIXES = ".html", ".csv", ".xosc", ".xml", ".sumocfg"


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
    """What writes files of this name, and returns them if they are several; raises as `write_motion` does."""
    if file.suffix == ".html":
        return lambda result, file: write_player(result.scene, file)
    if file.suffix == ".csv":
        return _write_csv
    if file.suffix == ".xml":
        return lambda result, file: write_floating_car_data(result.trace, file)
    if file.suffix == ".sumocfg":
        return write_sumo
    if file.suffix != ".xosc":
        found = f"a name that ends in '{file.suffix}'" if file.suffix else "a name without a suffix"
        expected, mend = f"one that ends in {', '.join(SUFFIXES)}", f"Write {file.with_suffix('.html')}, say."
        raise HarnessError(str(file), found, expected, mend)
    try:
        from harness.report.openscenario import write_openscenario  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        mend = "Install it, in the harness's folder: pip install -c requirements.lock -e '.[export]'."
        raise HarnessError(str(file), f"no package {error.name}", "the extra 'export'", mend) from error
    return lambda result, file: write_openscenario(result.trace, file)


def _write_csv(result: ReplayResult, file: Path) -> None:
    trace = result.trace
    time_s = pa.array(trace.column("step").to_numpy() * STEP_S).cast(pa.float64())
    rows = trace.drop_columns(["episode", "step"]).add_column(0, "time_s", pc.round(time_s, 1))
    write_atomically(file, lambda unfinished: csv.write_csv(rows, unfinished))
