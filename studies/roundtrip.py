"""Is what `harness fit` says of its own uncertainty true? Trajectories of known traffic, fitted again and again.

Each data set is simulated (`studies.trajectories`) with vehicles that differ and errors of measurement, from
`ndd-overtaking-2` with more lane changes and a larger share that ignores who is behind, of which a set of 10
vehicle-hours shows none in most bins. Kept is what the fit gives: one row of numbers, one of standard errors, and the
replicates.

What numbers should be found is the environment's, where all vehicles drive by it. Where they differ, it is the *mean
law*: what a fit finds in the mean of all large sets. The crash rate that should be found is always that of the
environment. Enumerating it in all replicates of all sets would take days: it is a sum over the steps of acceptance,
each share times a number, and changes with all other numbers as its logarithm's gradient says; how far that holds is
seen in sets that are enumerated.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from harness.campaign.files import load_campaign
from harness.campaign.sections import EnvironmentSettings
from harness.fitting.observations import observations
from harness.fitting.table import load_mapping
from harness.pool.build import take_aim
from harness.pool.walk import PILOT_PATHS, Enumerator
from harness.progress import Progress
from harness.records.folder import write_atomically
from harness.resolved import resolve
from harness.traffic.loading import load_environment, load_parameters
from harness.traffic.parameters import EnvironmentParameters
from harness.vocabulary import BoolArray, FloatArray
from studies.trajectories import Differences, simulate, write

TRAFFIC = EnvironmentSettings(parameters="ndd-overtaking-2", lane_change_level=1000.0)
IGNORE_SHARE = 0.1
FITTED = EnvironmentSettings(parameters="ndd-overtaking-2")
DRIVERS = ("r157-cc", "late-500ms", "late-1s")
CONFIDENCE = 0.9
ESTIMATE, ERROR, REPLICATE = "estimate", "std_error", "replicate"
KNOTS: dict[str, FloatArray] = {
    "v": np.arange(20.0, 40.1, 2.5),
    "r1": np.array([0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 80.0, 100.0, 115.0]),
    "r1dot": np.array([-10.0, -6.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0, 6.0, 10.0]),
}
"""Where hazards of all data sets are compared: their own knots differ."""
HAZARD = {"v": "v_mps", "r1": "r1_m", "r1dot": "r1dot_mps"}
STATES = ((30.0, 40.0, 0.0), (25.0, 20.0, -2.0), (35.0, 60.0, 2.0), (30.0, 15.0, 0.0), (28.0, 80.0, -4.0))
"""States (v, R1, R1dot) whose hazards are judged."""
N_PATHS = 4096
N_STEPS = 6


def truth() -> EnvironmentParameters:
    """The environment that data sets are simulated from, but for the level of lane changing."""
    return load_parameters(TRAFFIC).with_values({"cut_in__ignore_share": IGNORE_SHARE})


def data_set(hours: float, seed: int, folder: Path) -> Path:
    """A file of trajectories."""
    path = folder / "trajectories.parquet"
    write(simulate(load_environment(TRAFFIC, truth()), hours, seed, Differences()), path)
    return path


def seed_of(hours: float, index: int) -> int:
    """Of a data set."""
    return round(1000.0 * hours) + index


# -- crash rates of known drivers --


class Drivers:
    """Enumerates crash rates of `DRIVERS` on the same paths in any traffic."""

    def __init__(self) -> None:
        settings = {"environment.parameters": TRAFFIC.parameters, "environment.lane_change_level": 1.0}
        resolved = resolve(load_campaign("scenarios/smoke.yaml", [f"{key}={value}" for key, value in settings.items()]))
        library, nobody = resolved.library, Progress()
        names = [*library.surrogates, *library.references]
        self._bits = [names.index(driver) for driver in DRIVERS]
        here = load_environment(TRAFFIC, truth())
        self._paths: Enumerator = take_aim(here, library, resolved.campaign.pool, nobody).enumerator
        self.true = self._of(here)

    def rates(self, parameters: EnvironmentParameters) -> FloatArray:
        """Crash rates (drivers,) in fitted traffic."""
        return self._of(load_environment(FITTED, parameters))

    def _of(self, environment: Any) -> FloatArray:
        paths = replace(self._paths, environment=environment).run(PILOT_PATHS, N_PATHS, Progress())
        return np.array([np.where((paths.crashes >> bit) & 1 == 1, paths.mass, 0.0).sum() for bit in self._bits]) / N_PATHS


# -- numbers of data sets, made comparable --


def effects(rows: pd.DataFrame) -> FloatArray:
    """Log-hazards (n, knots) of rows at `KNOTS`, those of v, R1 and R1dot side by side; their sums count."""
    parts = []
    for axis, knots in KNOTS.items():
        at, log = (_listed(rows, f"hazard_table__{name}") for name in (HAZARD[axis], f"{axis}_log"))
        parts.append(np.array([np.interp(knots, *pair) for pair in zip(at, log, strict=True)]))
    return np.hstack(parts)


def log_hazard(rows: pd.DataFrame, state: Sequence[float]) -> FloatArray:
    """Log-hazard (n,) of rows in a state."""
    total = np.zeros(len(rows))
    for axis, value in zip(KNOTS, state, strict=True):
        at, log = (_listed(rows, f"hazard_table__{name}") for name in (HAZARD[axis], f"{axis}_log"))
        total += [float(np.interp(value, *pair)) for pair in zip(at, log, strict=True)]
    return total


def _listed(rows: pd.DataFrame, name: str) -> FloatArray:
    columns = sorted((each for each in rows if each.startswith(f"{name}__")), key=lambda each: int(each.rsplit("__")[-1]))
    return rows[columns].to_numpy()
