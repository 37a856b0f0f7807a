"""The motorway trajectories in the PyPI package `tasi`, as a table for `harness fit`, beside what environments say.

DLR Highway Traffic (doi:10.5281/zenodo.14012006): five minutes of 5.6 km of the A39, two lanes in each direction. Its
licence, CC BY-NC-SA, lets nobody ship it here, nor numbers fitted to it as defaults; so it is read where it was
installed. It has positions on the earth and no lanes: each direction is laid along the path of the vehicle that is seen
furthest, less what other vehicles tell of that one's lane changes, and lanes are where most vehicles are across.
"""

from __future__ import annotations

import importlib.util
import math
import operator
import zipfile
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from harness.errors import HarnessError
from harness.estimators.limits import clopper_pearson, garwood
from harness.families.cut_in.fitting.laws import Traffic
from harness.families.cut_in.fitting.observations import Tally
from harness.families.cut_in.laws import CAR_FOLLOWING, FREE_DRIVING, Environment, InitialStates
from harness.families.cut_in.loading import evaluate_laws
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import ACCELERATIONS_MPS2, BoolArray, FloatArray, IntArray, RecordArray

ARCHIVE = "dataset/data/DLR-Highway-Traffic-dataset_*.zip"
COLUMNS = {
    "id": "vehicle_id",
    "center_easting": "east_m",
    "center_northing": "north_m",
    "velocity_magnitude": "speed_mps",
    "dimension_length": "length_m",
}
POINT_M = 2.0
"""Between points of the path that a direction is laid along."""
SMOOTHED_M = 80.0
SECTION_M = 50.0
CHANGES_LANES_M = 1.5
"""Across in a section: who moves by more is not asked where the road goes."""
SHORTEST_S = 2.0
MORE_LANES = 0.03
"""Share of a section's rows beside the two lanes, from which on it has a ramp."""
FREELY_S = 8.0
MOST_LIKELY = 0.5
"""Probability of a lane change within a second, at most (``max_probability_1s``)."""
BINS_S = (0.0, 1.0, 2.0, 3.0, 5.0, 8.0)
TAIL = 0.05
Z = float(stats.norm.isf(TAIL))


def installed_rows() -> pd.DataFrame:
    """Positions, speeds and lengths with a ``time_s``, as they stand in the installed package.

    Raises `HarnessError`: it is not installed, or without data.
    """
    found = importlib.util.find_spec("tasi")
    if found is None or found.origin is None:
        raise HarnessError("studies motorway", "no package tasi", "its data", "Install it: pip install tasi==0.15.4.")
    archives = sorted(Path(found.origin).parent.glob(ARCHIVE))
    if not archives:
        mend = "Install the version that holds them: pip install tasi==0.15.4."
        raise HarnessError(f"studies motorway ({found.origin})", "no trajectories in it", ARCHIVE, mend)
    with zipfile.ZipFile(archives[-1]) as archive:
        name = next(each for each in archive.namelist() if "raw_data/trajectories/" in each and each.endswith(".csv"))
        with archive.open(name) as file:
            rows = pd.read_csv(file, usecols=["timestamp", *COLUMNS], dtype_backend="numpy_nullable")
    time = pd.to_datetime(rows.pop("timestamp"), format="ISO8601")
    return rows.rename(columns=COLUMNS).assign(time_s=(time - time.min()).dt.total_seconds().round(2))


def trajectories_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows (vehicle_id, time_s, east_m, north_m, speed_mps, length_m) as the table that `harness fit` reads.

    The directions are those to the north and to the south; each is a recording of its own.
    """
    rows = rows.astype("float64").sort_values(["vehicle_id", "time_s"])
    of = rows.groupby("vehicle_id")
    rows["length_m"] = of.length_m.transform("median")
    rows = rows[of.time_s.transform("max") - of.time_s.transform("min") >= SHORTEST_S]
    of = rows.groupby("vehicle_id")
    north = of.north_m.transform("last") > of.north_m.transform("first")
    directions = {"north": rows[north], "south": rows[~north]}
    tables = [_laid_out(part).assign(recording_id=name) for name, part in directions.items() if len(part)]
    whole = pd.concat(tables, ignore_index=True)
    whole["vehicle_id"] = whole.vehicle_id.astype(int)
    columns = ["recording_id", "vehicle_id", "time_s", "s_m", "speed_mps", "lane", "length_m", "lateral_m"]
    return whole[columns].round({"s_m": 3, "lateral_m": 3})


def _laid_out(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of one direction with ``s_m`` along the road, ``lateral_m`` from its right edge, and ``lane``."""
    rows = _along(rows, _longest_path(rows))
    section = (rows.s_m // SECTION_M).astype(int)
    across = rows.lateral_m.groupby([rows.vehicle_id, section]).median().unstack()
    moved = across.diff(axis=1)
    drift = moved.where(moved.abs() < CHANGES_LANES_M).median().fillna(0.0).cumsum()
    rows["lateral_m"] -= np.interp(rows.s_m, (drift.index + 0.5) * SECTION_M, drift)
    right, left = _lanes(rows.lateral_m.to_numpy())
    width = left - right
    rows["lateral_m"] -= right - 0.5 * width
    beside = ~rows.lateral_m.between(0.0, 2.0 * width)
    ramp = beside.groupby(section).transform("mean") > MORE_LANES
    rows["lane"] = (rows.lateral_m > width).astype(int)
    return rows[~beside & ~ramp]


def _longest_path(rows: pd.DataFrame) -> FloatArray:
    """Points (n, 2), `POINT_M` from each other, of the vehicle that is seen furthest; smoothed."""
    of = rows.groupby("vehicle_id")[["east_m", "north_m"]]
    seen = (of.last() - of.first()).pow(2).sum(axis=1).idxmax()
    points = rows.loc[rows.vehicle_id == seen, ["east_m", "north_m"]].to_numpy()
    driven = np.append(0.0, np.hypot(*np.diff(points, axis=0).T).cumsum())
    even = np.arange(0.0, driven[-1], POINT_M)
    path = np.column_stack([np.interp(even, driven, each) for each in points.T])
    cut = round(2.0 * SMOOTHED_M / POINT_M)
    return np.asarray(gaussian_filter1d(path, SMOOTHED_M / POINT_M, axis=0)[cut:-cut])


def _along(rows: pd.DataFrame, path: FloatArray) -> pd.DataFrame:
    """Rows with ``s_m`` along a path and ``lateral_m`` to the left of it; without those before or behind it."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    points = rows[["east_m", "north_m"]].to_numpy()
    _, nearest = cKDTree(path).query(points)
    beyond = points - path[nearest]
    ahead = (beyond * tangent[nearest]).sum(axis=1)
    left = tangent[nearest, 0] * beyond[:, 1] - tangent[nearest, 1] * beyond[:, 0]
    inside = (nearest > 0) & (nearest < len(path) - 1)
    return pd.DataFrame(rows.assign(s_m=POINT_M * nearest + ahead, lateral_m=left)[inside])


def _lanes(lateral: FloatArray) -> tuple[float, float]:
    """Middles of the two lanes (m): where most rows are across, and where most of those are that are not there."""
    counts, edges = np.histogram(lateral, np.arange(-30.0, 30.0, 0.1))
    density, middle = gaussian_filter1d(counts.astype(float), 3.0), edges[:-1] + 0.05
    first = middle[density.argmax()]
    second = middle[np.where(np.abs(middle - first) > 2.5, density, 0.0).argmax()]  # lanes are wider
    return float(min(first, second)), float(max(first, second))


# -- beside environments --


class Figure(NamedTuple):
    """Something seen with its 90 % interval, and what environments say of the same states, by name."""

    words: str
    seen: float
    low: float
    high: float
    of: dict[str, float]

    def agrees(self, name: str) -> bool:
        """Whether what an environment says lies in the interval."""
        return bool(self.low <= self.of[name] <= self.high)


Interval = tuple[float, float, float]
"""A value, and the ends of its 90 % interval."""


class Laws(NamedTuple):
    """What an environment says of observations: initial states, moments and tails of accelerations, hazards.

    ``free`` and ``following`` are probabilities (n, 31) of accelerations; ``wished`` (n,) lane changes per row at risk,
    ``accepted`` (n,) shares of them; ``leads_s`` and ``lateral_mps`` medians.
    """

    initial: RecordArray
    free: FloatArray
    following: FloatArray
    wished: FloatArray
    accepted: FloatArray
    lead_s: float
    lateral_mps: float

    @classmethod
    def of(cls, environment: Environment, seen: Traffic) -> Laws:
        """Of an environment, in the states that were seen."""
        risk = seen.at_risk
        nobody = ~np.isfinite(risk["r2_m"])
        behind = [np.where(nobody, 1.0, risk["r2_m"]), np.where(nobody, 1.0, risk["r2dot_mps"])]
        speeds = seen.free["v_mps"]
        free = np.column_stack([speeds, np.full_like(speeds, 50.0), np.zeros_like(speeds)])
        *_, chance, accepted = evaluate_laws(environment, _states(risk), np.column_stack(behind))
        lateral = environment.lateral
        lead_s = STEP_S * float(np.searchsorted(lateral.cumulative, 0.5))
        return cls(
            InitialStates(environment.numbers).from_uniforms(np.random.default_rng(1).random((20_000, 5))),
            evaluate_laws(environment, free).pmf[FREE_DRIVING],
            evaluate_laws(environment, _states(seen.following)).pmf[CAR_FOLLOWING],
            -np.log1p(-np.minimum(chance, MOST_LIKELY)) * risk["duration_s"],
            accepted,
            lead_s,
            lateral.distance_m / lead_s if lead_s > 0.0 else math.inf,
        )


def _states(rows: RecordArray) -> FloatArray:
    return np.column_stack([rows[name] for name in ("v_mps", "r1_m", "r1dot_mps")])


def figures(seen: Traffic, environments: Mapping[str, Environment]) -> list[Figure]:
    """What is seen beside what environments say; vehicles are taken to be independent.

    The level of lane changing is not compared: that of an environment is fitted where nobody closes in within 8 s.
    """
    laws = {name: Laws.of(each, seen) for name, each in environments.items()}
    start, risk, found = seen.initial, seen.at_risk, list[Figure]()
    changes, ttc = risk["changes"], risk["ttc_s"]
    freely = ttc > FREELY_S

    def add(words: str, interval: Interval, says: Callable[[Laws], float]) -> None:
        found.append(Figure(words, *interval, {name: says(each) for name, each in laws.items()}))

    def state(words: str, column: str, of_law: str, inside: Callable[[FloatArray], NDArray[Any]]) -> None:
        interval = _mean(inside(start[column]), start["vehicle"])
        add(words, interval, lambda of: float(inside(of.initial[of_law]).mean()))

    def accelerations(kind: str, rows: RecordArray, pmf: Callable[[Laws], FloatArray]) -> None:
        a = rows["acceleration_mps2"]
        square = _mean(np.square(a), rows["vehicle"])
        mean = pmf_mean(pmf, np.square(ACCELERATIONS_MPS2))
        add(f"{kind}: mean square (m²/s⁴)", square, mean)
        for limit in (-1.0, -2.0):
            harder = _mean(100.0 * (a < limit - 0.1), rows["vehicle"])
            add(f"{kind}: below {limit:g} m/s² (%)", harder, pmf_mean(pmf, 100.0 * (limit - 0.1 > ACCELERATIONS_MPS2)))

    def lane_changes(words: str, here: BoolArray) -> None:
        if not (changes & freely).any():
            return
        share = _share(int((changes & here & freely).sum()), int((changes & freely).sum()))
        chosen, words = here & freely, f"lane changes {words} (%)"
        add(words, share, lambda of: 100.0 * float(of.wished[chosen].sum() / of.wished[freely].sum()))

    def carried_out(low: float, high: float) -> None:
        here = (ttc >= low) & (ttc < high)
        words, interval = f"lane changes at a TTC of {low:g} to {high:g} s", _count(int((changes & here).sum()))
        add(words, interval, lambda of: _expected(of, here, changes, freely))

    state("R1, mean (m)", "r1_m", "r1_m", lambda r1: r1)
    state("R1 below 30 m (%)", "r1_m", "r1_m", lambda r1: 100.0 * (r1 < 30.0))
    state("R1dot below -2 m/s (%)", "r1dot_mps", "r1dot_mps", lambda rate: 100.0 * (rate < -2.0))
    state("R1dot above 2 m/s (%)", "r1dot_mps", "r1dot_mps", lambda rate: 100.0 * (rate > 2.0))
    accelerations("free driving", seen.free, operator.attrgetter("free"))
    accelerations("car following", seen.following, operator.attrgetter("following"))
    rate = seen.following["r1dot_mps"] - seen.following["r1dot_mps"].mean()
    slope = _mean(rate * seen.following["acceleration_mps2"], seen.following["vehicle"], np.square(rate))
    gain = pmf_mean(operator.attrgetter("following"), ACCELERATIONS_MPS2, rate / np.square(rate).mean())
    add("car following: acceleration by R1dot (1/s)", slope, gain)
    lane_changes("at R1 below 20 m", risk["r1_m"] < 20.0)
    lane_changes("at R1dot below -1 m/s", risk["r1dot_mps"] < -1.0)
    lane_changes("at R1dot above 1 m/s", risk["r1dot_mps"] > 1.0)
    for low, high in pairwise(BINS_S):
        carried_out(low, high)
    if seen.leads.size:
        add("lead, median (s)", _median(seen.leads["lead_s"]), operator.attrgetter("lead_s"))
        speed = _median(seen.leads["lateral_speed_mps"])
        add("lateral speed at the marking, median (m/s)", speed, operator.attrgetter("lateral_mps"))
    return found


def pmf_mean(
    pmf: Callable[[Laws], FloatArray], values: NDArray[Any], weight: FloatArray | float = 1.0
) -> Callable[[Laws], float]:
    """Mean of ``values`` (31,) of accelerations over rows, each with its ``weight``."""
    return lambda of: float(((pmf(of) @ values) * weight).mean())


def _expected(laws: Laws, here: BoolArray, changes: BoolArray, freely: BoolArray) -> float:
    """Lane changes that are expected among some rows, at the level of those where nobody is in the way."""
    expected = laws.wished * laws.accepted
    return float(expected[here].sum() * changes[freely].sum() / expected[freely].sum())


def _mean(values: NDArray[Any], cluster: IntArray, weight: FloatArray | float = 1.0) -> Interval:
    """Mean of values over weights, sums of both (n,), and its interval; clusters are independent.

    Where all values are 0, they are taken to be shares in per cent.
    """
    _, of = np.unique(cluster, return_inverse=True)
    top, bottom = np.bincount(of, values), np.bincount(of, np.broadcast_to(weight, values.shape))
    mean = float(top.sum() / bottom.sum())
    error = Z * float(np.sqrt(np.square(top - mean * bottom).sum()) / bottom.sum())
    if not top.any():  # never seen in any cluster
        return 0.0, 0.0, 100.0 * (1.0 - TAIL ** (1.0 / top.size))
    return mean, mean - error, mean + error


def _count(k: int) -> Interval:
    """A count and the interval of its mean (Garwood's)."""
    low, high = garwood(k, TAIL)
    return float(k), float(low), float(high)


def _share(k: int, n: int) -> Interval:
    """A share of n in per cent and its interval (Clopper's and Pearson's)."""
    low, high = clopper_pearson(k, n, TAIL)
    return 100.0 * k / n, 100.0 * float(low), 100.0 * float(high)


def _median(values: FloatArray) -> Interval:
    """A median and its interval, by ranks."""
    n, ordered = values.size, np.sort(values)
    low, high = (int(stats.binom.ppf(each, n, 0.5)) for each in (TAIL, 1.0 - TAIL))
    return float(np.median(values)), float(ordered[low]), float(ordered[min(high, n - 1)])


def page(sides: Mapping[str, tuple[Tally, Sequence[Figure]]]) -> str:
    """The figures of lane changes to each side as Markdown."""
    lines = [
        "# Motorway trajectories beside traffic that is simulated",
        "",
        "DLR Highway Traffic, with 90 % intervals: by chance alone one in ten figures of traffic that is right would "
        "lie outside. Counts of lane changes are expected at the level of those where nobody closes in within "
        f"{FREELY_S:g} s.",
    ]
    for side, (tally, found) in sides.items():
        names = list(found[0].of)
        lines += [
            "",
            f"## To the {side}",
            "",
            f"{tally.vehicles:,} vehicles beside a lane to the {side}, {tally.driven_s / 3600.0:.1f} vehicle-hours, "
            f"{tally.changes:,} lane changes to it.",
            "",
            "| | seen | " + " | ".join(names) + " |",
            "| --- | --- |" + " --- |" * len(names),
        ]
        for each in found:
            seen_here = f"{each.seen:.3g} ({each.low:.3g} … {each.high:.3g})"
            said = [f"{value:.3g}{' agrees' * each.agrees(name)}" for name, value in each.of.items()]
            lines.append(f"| {' | '.join([each.words, seen_here, *said])} |")
        agreeing = (f"{name} agrees in {sum(each.agrees(name) for each in found)} of {len(found)}" for name in names)
        lines += ["", "; ".join(agreeing) + "."]
    return "\n".join([*lines, ""])
