"""Challenge tables of a set of surrogates: built once, kept on disk under the hash of all that they depend on.

They are mapped from there, read-only, so that all processes of a machine share one copy.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness import cache
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.challenge import LEVELS, build_after_cut_in, build_before_cut_in, build_immediate
from harness.families.cut_in.nade.grid import AFTER, BEFORE
from harness.processes import usable_cpus
from harness.vocabulary import Float32Array, RecordArray

_FORMAT = 4
"""Raise it when the meaning of a table changes."""


class Tables(NamedTuple):
    """Challenge tables of J surrogates, all float32.

    ``value`` (J, levels + 1, v, R2, R2dot): U by remaining time. ``maneuvers`` (J, v, R2, R2dot, 31): C(s, a).
    ``before`` (J, redraw times + 1, v, R2, R2dot): expected challenge per unit of OL before the cut-in. With the
    immediate challenge the first two are smallest gaps in metres and ``before`` is empty; ``least``, shaped as value,
    is then the smallest gap of all maneuvers, and else empty.
    """

    value: Float32Array
    maneuvers: Float32Array
    before: Float32Array
    least: Float32Array


def tables_name(environment: Environment, drivers: RecordArray, challenge: str) -> str:
    """Name of the tables of a set of surrogates in the cache; they do not depend on the level of lane changing."""
    numbers = {name: value for name, value in environment.content().items() if name != "level"}
    surrogates = drivers.dtype.names, drivers.tolist()
    content = json.dumps([_FORMAT, challenge, numbers, AFTER, BEFORE, surrogates, LEVELS], sort_keys=True)
    return f"tables/{hashlib.sha256(content.encode()).hexdigest()[:24]}.npy"


def _load(path: Path) -> Tables:
    stored = np.asarray(np.load(path, mmap_mode="r"))  # a plain array: numba would take a memmap for something else
    return Tables(*(stored[name][0] for name in Tables._fields))


def _content(tables: Tables) -> memoryview:
    """The tables as the fields of one record: one file, in which each lies in one piece."""
    dtype = [(name, table.dtype, table.shape) for name, table in zip(Tables._fields, tables, strict=True)]
    np.save(file := BytesIO(), np.array([tuple(tables)], dtype))
    return file.getbuffer()


_NONE = np.zeros((0, 2, 2, 2), np.float32)


def build_one(environment: Environment, driver: RecordArray, challenge: str) -> Tables:
    """Tables of one surrogate, ``driver`` (1,), without its axis."""
    if challenge == "immediate":
        value, maneuvers, least = build_immediate(environment, driver)
        return Tables(value, maneuvers, _NONE, least)
    return recursive_tables(environment, *build_after_cut_in(environment, driver))


def recursive_tables(environment: Environment, value: Float32Array, maneuvers: Float32Array) -> Tables:
    """Tables of one surrogate by a challenge after the cut-in; that before it follows from it."""
    return Tables(value, maneuvers, build_before_cut_in(environment, value), _NONE)


def build_tables(
    environment: Environment,
    drivers: RecordArray,
    challenge: str,
    done: Callable[[int], None] = lambda _: None,
    builds: Sequence[Callable[[Environment, RecordArray, str], Tables]] = (),
) -> Tables:
    """Tables of all surrogates, ``drivers`` (J,), read-only, from the cache if they are there.

    ``challenge`` is ``recursive`` or ``immediate``, or identifies the user's own, which ``builds`` tabulate. ``done``
    is called with the number of tables that have become ready.
    """
    name = tables_name(environment, drivers, challenge)
    if (path := cache.find(name)) is not None:
        done(drivers.size)
        return _load(path)

    def one(j: int) -> Tables:
        built = (builds[j] if builds else build_one)(environment, drivers[j : j + 1], challenge)
        done(1)
        return built

    with ThreadPoolExecutor(usable_cpus()) as threads:
        parts = list(threads.map(one, range(drivers.size)))
    tables = Tables(*(np.stack(arrays) for arrays in zip(*parts, strict=True)))
    return _load(cache.keep(name, _content(tables)))
