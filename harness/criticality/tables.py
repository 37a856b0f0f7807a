"""Challenge tables of a set of surrogates: built once, kept on disk under the hash of all that they depend on."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from harness.arrays import Float32Array, RecordArray
from harness.compiled import cache_root
from harness.criticality import grid
from harness.criticality.after_cut_in import LEVELS, build_after_cut_in, level_steps
from harness.criticality.before_cut_in import build_before_cut_in, naturalistic_pmf
from harness.criticality.immediate import build_immediate
from harness.environment.driving import Environment
from harness.errors import writing
from harness.vehicles.models import MODEL_FIELDS

_FORMAT = 2
"""Raise it when the meaning of a table changes."""


class Tables(NamedTuple):
    """Challenge tables of J surrogates, all float32.

    ``value`` (J, levels + 1, v, R2, R2dot): U by remaining time. ``maneuvers`` (J, v, R2, R2dot, 31): C(s, a).
    ``before`` (J, redraw times + 1, v, R2, R2dot): expected challenge per unit of OL before the cut-in. With the
    immediate challenge the first two are smallest gaps in metres and the last is empty.
    """

    value: Float32Array
    maneuvers: Float32Array
    before: Float32Array


def tables_hash(environment: Environment, driver: RecordArray, challenge: str) -> str:
    """Hash of what one surrogate's tables depend on; the level of lane changing is not among it."""
    numbers = {
        name: environment.numbers[name][0].item() for name in environment.numbers.dtype.fields or () if name != "level"
    }
    axes = {name: list(value) for name, value in vars(grid).items() if isinstance(value, grid.Axis)}
    surrogate = {name: driver[name][0].item() for name in MODEL_FIELDS}
    content = json.dumps([_FORMAT, challenge, numbers, axes, surrogate, LEVELS], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:24]


def table_path(environment: Environment, driver: RecordArray, challenge: str) -> Path:
    """Where the tables of one surrogate are cached."""
    return cache_root() / "tables" / f"{tables_hash(environment, driver, challenge)}.npz"


def _load(path: Path) -> Tables | None:
    try:
        with path.open("rb") as file, np.load(file) as stored:  # a damaged file would be left open by np.load
            return Tables(stored["value"], stored["maneuvers"], stored["before"])
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None  # absent or damaged: it is built again


def _save(path: Path, tables: Tables) -> None:
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **tables._asdict())
            Path(name).replace(path)
        finally:
            Path(name).unlink(missing_ok=True)


def _build_one(environment: Environment, driver: RecordArray, challenge: str) -> Tables:
    if challenge == "immediate":
        return Tables(*build_immediate(environment, driver), np.zeros((0, 2, 2, 2), np.float32))
    value, maneuvers = build_after_cut_in(environment, driver)
    steps_per_level = level_steps(int(environment.numbers["hold_steps"][0]))
    before = build_before_cut_in(environment, value, naturalistic_pmf(environment), steps_per_level)
    return Tables(value, maneuvers, before)


def build_tables(
    environment: Environment, drivers: RecordArray, challenge: str, done: Callable[[int], None] = lambda _: None
) -> Tables:
    """Tables of all surrogates, from the cache where they are.

    Parameters
    ----------
    environment : Environment
    drivers : structured ndarray, shape (J,)
    challenge : str
        ``recursive`` or ``immediate``.
    done : callable
        Called with 1 for every surrogate that is ready.

    Returns
    -------
    Tables
        With the surrogates as first axis.
    """

    def one(j: int) -> Tables:
        driver = drivers[j : j + 1]
        path = table_path(environment, driver, challenge)
        tables = _load(path)
        if tables is None:
            tables = _build_one(environment, driver, challenge)
            _save(path, tables)
        done(1)
        return tables

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        parts = list(threads.map(one, range(drivers.size)))
    return Tables(*(np.stack(arrays) for arrays in zip(*parts, strict=True)))


def tables_cached(environment: Environment, drivers: RecordArray, challenge: str) -> bool:
    """Whether all tables are on disk."""
    return all(table_path(environment, drivers[j : j + 1], challenge).exists() for j in range(drivers.size))
