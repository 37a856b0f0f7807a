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

import functools
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from harness.campaign.files import load_campaign
from harness.campaign.sections import EnvironmentSettings
from harness.estimators.traffic import ONE_LAW
from harness.families.cut_in.fitting.fitter import fit_traffic, replicates
from harness.families.cut_in.fitting.laws import ObservedTraffic
from harness.families.cut_in.fitting.observations import KINDS, Observations, observe
from harness.families.cut_in.loading import load_environment, load_parameters
from harness.families.cut_in.parameters import FIXED, EnvironmentParameters
from harness.families.cut_in.sections import REPLACED
from harness.files import write_atomically
from harness.fitting.table import load_mapping, recordings
from harness.pool.aim import PILOT_PATHS, Enumerator
from harness.pool.build import take_aim
from harness.progress import Progress
from harness.records.folder import write_json
from harness.resolved import resolve
from harness.vocabulary import BoolArray, FloatArray, RecordArray
from studies.trajectories import RECORDING_H, Differences, simulate, write

TRAFFIC = EnvironmentSettings(parameters="ndd-overtaking-2", lane_change_level=1000.0)
IGNORE_SHARE = 0.1
FITTED = EnvironmentSettings(parameters="ndd-overtaking-2")
DRIVERS = ("r157-cc", "late-500ms", "late-1s")
CONFIDENCE = 0.9
ENDS = 0.05, 0.95
"""Of replicates: their k-th of n is taken as the k/(n + 1) quantile, for which one more replicate falls between."""
ESTIMATE, ERROR, REPLICATE = "estimate", "std_error", "replicate"
SEEN = "seen"
"""Lane changes of each step of acceptance are kept beside numbers."""
KNOTS: dict[str, FloatArray] = {
    "v": np.arange(20.0, 40.1, 2.5),
    "r1": np.array([0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 80.0, 100.0, 115.0]),
    "r1dot": np.array([-10.0, -6.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0, 6.0, 10.0]),
}
"""Where hazards of all data sets are compared: their own knots differ."""
HAZARD = {"v": "v_mps", "r1": "r1_m", "r1dot": "r1dot_mps"}
STATES = ((30.0, 40.0, 0.0), (25.0, 20.0, -2.0), (35.0, 60.0, 2.0), (30.0, 15.0, 0.0), (28.0, 80.0, -4.0))
"""States (v, R1, R1dot) whose hazards are judged."""
SEED, PART_H = 10_000, 10.0
N_PATHS = 4096
N_STEPS, N_CHECKED = 6, 20


def truth() -> EnvironmentParameters:
    """The environment that data sets are simulated from, but for the level of lane changing."""
    return load_parameters(TRAFFIC).with_values({"cut_in__ignore_share": IGNORE_SHARE})


@functools.cache
def simulated(n_parts: int, progress: Progress) -> ObservedTraffic:
    """Observations of ``n_parts`` of 10 vehicle-hours, 20 recordings each, as a fit reads them from files."""
    progress.stage("trajectories", n_parts)
    found = list[Observations]()
    with tempfile.TemporaryDirectory() as name:
        file = Path(name, "trajectories.parquet")
        for part in range(n_parts):
            write(simulate(load_environment(TRAFFIC, truth()), PART_H, SEED + part, Differences()), file)
            found += map(observe, recordings([file], load_mapping()))
            progress.advance(1)
    return ObservedTraffic.of(found)


def data_set(pool: ObservedTraffic, hours: float, index: int) -> ObservedTraffic:
    """So many vehicle-hours of recordings: each is in one set of 10 alone, larger sets are drawn from all."""
    n = round(hours / RECORDING_H)
    if hours == PART_H:
        chosen = np.arange(n) + n * index
    else:
        chosen = np.random.default_rng([SEED, index]).choice(int(pool.recording.max()) + 1, n, replace=False)
    inside = np.isin(pool.recording, chosen)
    number = np.cumsum(inside) - 1
    kept: dict[str, RecordArray] = {}
    for kind in KINDS:
        rows: RecordArray = getattr(pool, kind)
        kept[kind] = rows[inside[rows["vehicle"]]]
        kept[kind]["vehicle"] = number[kept[kind]["vehicle"]]
    return ObservedTraffic(**kept, recording=np.unique(pool.recording[inside], return_inverse=True)[1])


# -- crash rates of known drivers --


class Drivers:
    """Enumerates crash rates of `DRIVERS` on the same paths in any traffic."""

    def __init__(self) -> None:
        settings = {"environment.parameters": TRAFFIC.parameters, "environment.lane_change_level": 1.0}
        resolved = resolve(load_campaign("scenarios/smoke.yaml", [f"{key}={value}" for key, value in settings.items()]))
        names = [*resolved.library.surrogates, *resolved.library.references]
        self._bits = [names.index(driver) for driver in DRIVERS]
        here = load_environment(TRAFFIC, truth())
        self._paths: Enumerator = take_aim(replace(resolved, environment=here), Progress()).enumerator
        self.true = self._of(here)

    def rates(self, parameters: EnvironmentParameters) -> FloatArray:
        """Crash rates (drivers,) in fitted traffic."""
        return self._of(load_environment(FITTED, parameters))

    def _of(self, environment: Any) -> FloatArray:
        paths = replace(self._paths, environment=environment).run(PILOT_PATHS, N_PATHS, Progress())
        crashing = [np.where((paths.crashes >> bit) & 1 == 1, paths.mass, 0.0).sum() for bit in self._bits]
        return np.array(crashing) / N_PATHS


# -- numbers of data sets, made comparable --


def _of_axes(rows: pd.DataFrame, at: Sequence[Any]) -> list[FloatArray]:
    """Log-hazards of rows by axis, each at some values of it: (n,) of one value, else (n, values)."""
    found = []
    for axis, values in zip(KNOTS, at, strict=True):
        knots, log = (_listed(rows, f"hazard_table__{name}") for name in (HAZARD[axis], f"{axis}_log"))
        found.append(np.array([np.interp(values, *pair) for pair in zip(knots, log, strict=True)]))
    return found


def effects(rows: pd.DataFrame) -> FloatArray:
    """Log-hazards (n, knots) of rows at `KNOTS`, those of v, R1 and R1dot side by side; their sums count."""
    return np.hstack(_of_axes(rows, [*KNOTS.values()]))


def log_hazard(rows: pd.DataFrame, state: Sequence[float]) -> FloatArray:
    """Log-hazard (n,) of rows in a state."""
    return np.asarray(sum(_of_axes(rows, state), start=np.zeros(len(rows))))


def _listed(rows: pd.DataFrame, name: str) -> FloatArray:
    places = [int(each.rsplit("__")[-1]) for each in map(str, rows) if each.startswith(f"{name}__")]
    return rows[[f"{name}__{place}" for place in sorted(places)]].to_numpy()


@dataclass(frozen=True, eq=False)
class Surrogate:
    """Log crash rates of the drivers (d) near some numbers: Σ shares · ``masses`` · exp(gradient · (θ - middle)).

    Shares are those of lane changes that are carried out. ``names`` (p,) are numbers that enter as they are; the hazard
    enters by its `effects`. ``gradient`` is (d, p + effects), ``middle`` as long, ``masses`` (d, steps) the rates of a
    share of 1 in each step.
    """

    names: tuple[str, ...]
    middle: FloatArray
    gradient: FloatArray
    masses: FloatArray

    def log_rates(self, rows: pd.DataFrame) -> FloatArray:
        """Of rows of numbers: (n, d)."""
        numbers = np.hstack([rows[list(self.names)].to_numpy(), effects(rows)])
        shares = _listed(rows, "acceptance_steps__share")
        return np.log(shares @ self.masses.T) + (numbers - self.middle) @ self.gradient.T


def surrogate(drivers: Drivers, sets: pd.DataFrame, progress: Progress) -> Surrogate:
    """Enumerate around the mean of some estimates, by their standard deviations."""
    middle = on_common_knots(sets)
    base = parameters_of(middle)
    hazards = [f"hazard_table__{axis}_log__{i}" for axis, knots in KNOTS.items() for i in range(knots.size)]
    names = tuple(name for name in fitted_numbers(sets) if not name.startswith(("hazard_table", "acceptance_steps")))
    spread = np.append(sets[list(names)].std().to_numpy(), np.full(len(hazards), 0.2))
    numbers = base.values()
    progress.stage("gradient of crash rates", len(spread) + N_STEPS)

    def moved(name: str, by: float) -> FloatArray:
        return drivers.rates(base.with_values({name: numbers[name] + by}))

    gradient = []
    for name, step in zip([*names, *hazards], spread.tolist(), strict=True):
        up, down = moved(name, step), moved(name, -step)
        gradient.append((np.log(up) - np.log(down)) / (2.0 * step))
        progress.advance(1)
    masses = []
    for i in range(N_STEPS):
        name = f"acceptance_steps__share__{i}"
        half = -0.5 * numbers[name]
        masses.append(np.maximum((drivers.rates(base) - moved(name, half)) / -half, 0.0))
        progress.advance(1)
    place = np.append([numbers[name] for name in names], [numbers[name] for name in hazards])
    return Surrogate(names, place, np.array(gradient).T, np.array(masses).T)


def parameters_of(row: Mapping[Any, Any]) -> EnvironmentParameters:
    """Environment of a row of numbers."""
    base = truth()
    content = base.model_dump(exclude_none=True)
    for section, names in REPLACED.items():
        content[section] = {}
        for name in names:
            content["cut_in"].pop(name, None)
    for path, value in row.items():
        section, name, *place = path.split("__")
        if section == SEEN:
            continue
        if place:
            content[section].setdefault(name, []).append({"value": float(value), "source": "fitted"})
        elif name not in FIXED:
            content[section][name] = {"value": float(value), "source": "fitted"}
    return EnvironmentParameters.model_validate(content)


def on_common_knots(rows: pd.DataFrame) -> dict[str, float]:
    """The mean of rows of numbers, with hazards at `KNOTS`."""
    numbers = rows[[name for name in map(str, rows) if not name.startswith("hazard_table__")]]
    mean = {str(name): float(value) for name, value in numbers.mean().items()}
    logs = np.split(effects(rows).mean(axis=0), np.cumsum([knots.size for knots in KNOTS.values()])[:-1])
    for (axis, knots), log in zip(KNOTS.items(), logs, strict=True):
        mean |= {f"hazard_table__{HAZARD[axis]}__{i}": value for i, value in enumerate(knots.tolist())}
        mean |= {f"hazard_table__{axis}_log__{i}": value for i, value in enumerate(log.tolist())}
    return mean


# -- data sets --


def fit_data_set(traffic: ObservedTraffic, seed: int, n_replicates: int) -> pd.DataFrame:
    """Rows of numbers by kind (index): the estimate, standard errors (NaN where none), replicates."""
    fit = fit_traffic(traffic, f"data set {seed}", Progress())
    drawn = replicates(fit, n_replicates, seed, Progress())
    numbers = fit.environment.values()
    errors = {key: value for law in fit.laws.values() for key, value in law.std_error.items() if value > 0.0}
    numbers |= {f"{SEEN}__{step}": count for step, count in enumerate(fit.acceptance.events.tolist())}
    rows = pd.DataFrame([numbers, {**dict.fromkeys(numbers, np.nan), **errors}, *[numbers] * n_replicates], dtype=float)
    rows.loc[2:, list(drawn)] = np.column_stack(list(drawn.values()))
    rows.index = pd.Index([ESTIMATE, ERROR, *[REPLICATE] * n_replicates], name="kind")
    return rows


def data_sets(folder: Path, hours: float, n: int, n_replicates: int, progress: Progress) -> list[pd.DataFrame]:
    """Rows of ``n`` data sets of so many vehicle-hours; those that the folder does not have yet are fitted."""
    paths = [folder / f"{hours:g}h" / f"{index:04d}.parquet" for index in range(n)]
    if missing := [(index, path) for index, path in enumerate(paths) if not path.exists()]:
        pool = simulated(n, progress)
        progress.stage(f"fits of {hours:g} vehicle-hours", n, done=n - len(missing))
        for index, path in missing:
            rows = fit_data_set(data_set(pool, hours, index), index, n_replicates)
            write_atomically(path, rows.reset_index().to_parquet)
            progress.advance(1)
    return [pd.read_parquet(path).set_index("kind") for path in paths]


# -- judgement --


def coverage(covered: BoolArray) -> dict[str, Any]:
    """Share of intervals (n,) that hold what they should, its 95 % interval, and the p-value of so few."""
    n, k = covered.size, int(covered.sum())
    interval = stats.binomtest(k, n).proportion_ci(0.95)
    p_value = float(stats.binom.cdf(k, n, CONFIDENCE))
    return {"n": n, "coverage": k / n, "low": float(interval.low), "high": float(interval.high), "p_value": p_value}


def _within(values: FloatArray, true: Any) -> BoolArray:
    """Whether truths are between the ends of replicates' intervals."""
    low, high = np.quantile(values, ENDS, axis=0, method="weibull")
    return np.asarray((low <= true) & (true <= high))


def fitted_numbers(sets: pd.DataFrame) -> list[str]:
    """Names of numbers that differ between data sets, but for knots."""
    others = SEEN, *(f"hazard_table__{name}__" for name in HAZARD.values())
    return [name for name in map(str, sets) if not name.startswith(others) and sets[name].std() > 1e-9]


def judge_numbers(sets: Sequence[pd.DataFrame], mean: Mapping[str, float]) -> list[dict[str, Any]]:
    """Of each number, and of hazards in `STATES`: how often replicates' intervals hold that of the mean law.

    Sets that kept a number of the base, which has no standard error then, are left out, unless all did.
    """
    estimates, errors = (pd.DataFrame([each.loc[kind] for each in sets]) for kind in (ESTIMATE, ERROR))
    judged = list[dict[str, Any]]()

    def judge(name: str, law: float, found: Any, replicates: Sequence[FloatArray], told: BoolArray) -> None:
        held = np.array([_within(each, law) for each in replicates])[told | ~told.any()]
        judged.append({"number": name, "mean_law": law, "mean": float(np.mean(found)), "interval": coverage(held)})

    for name in fitted_numbers(estimates):
        if not name.startswith("hazard_table"):
            replicates = [each.loc[[REPLICATE], name].to_numpy() for each in sets]
            judge(name, mean[name], estimates[name], replicates, errors[name].notna().to_numpy())
    for state in STATES:
        values = [log_hazard(each.loc[[ESTIMATE, REPLICATE]], state) for each in sets]
        law = float(log_hazard(pd.DataFrame([mean]), state)[0])
        every = np.ones(len(sets), np.bool_)
        judge(f"log-hazard at {state}", law, [each[0] for each in values], [each[1:] for each in values], every)
    return judged


def judge_rates(sets: Sequence[pd.DataFrame], near: Surrogate, true: FloatArray) -> dict[str, Any]:
    """How often the replicates' intervals hold the environment's crash rates (drivers,), and ratios to the first.

    Sets that share recordings miss these together where recordings have by chance too many lane changes of a kind.
    """
    logs = np.array([near.log_rates(each.loc[[ESTIMATE, REPLICATE]]) for each in sets])
    judged: dict[str, Any] = {}
    for of, values, aims, wider in (
        ("rate", logs, np.log(true), 0.0),
        (f"ratio to {DRIVERS[0]}", logs - logs[:, :, :1], np.log(true / true[0]), np.log1p(ONE_LAW)),
    ):
        for d, driver in enumerate(DRIVERS):
            if of != "rate" and d == 0:
                continue
            low, high = np.quantile(values[:, 1:, d], ENDS, axis=1, method="weibull") + np.array([[-wider], [wider]])
            judged[f"{driver}: {of}"] = {
                "true": float(np.exp(aims[d])),
                "interval": coverage((low <= aims[d]) & (aims[d] <= high)),
                "median_estimate_over_true": float(np.exp(np.median(values[:, 0, d]) - aims[d])),
                "median_factor": float(np.exp(np.median(0.5 * (high - low)))),
            }
    return judged


def check(sets: Sequence[pd.DataFrame], near: Surrogate, drivers: Drivers) -> dict[str, float]:
    """How far log rates of a replicate of some sets come out wrong: root mean square, and most, over drivers."""
    rows = [each.loc[[REPLICATE]].iloc[[0]] for each in sets[:: max(len(sets) // N_CHECKED, 1)][:N_CHECKED]]
    off = [near.log_rates(row)[0] - np.log(drivers.rates(parameters_of(row.iloc[0].to_dict()))) for row in rows]
    return {"n": len(off), "root_mean_square": float(np.sqrt(np.square(off).mean())), "most": float(np.abs(off).max())}


def judged_data_sets(folder: Path, hours: Sequence[float], n: int, n_replicates: int, progress: Progress) -> Path:
    """Fit what is missing, and judge all of it, into roundtrip.json: the mean law is that of the largest sets."""
    sets = {each: data_sets(folder, each, n, n_replicates, progress) for each in sorted(hours)}
    largest = pd.DataFrame([each.loc[ESTIMATE] for each in sets[max(sets)]])
    drivers, mean = Drivers(), on_common_knots(largest)
    near, mean_rates = surrogate(drivers, largest, progress), drivers.rates(parameters_of(mean)) / drivers.true
    found: dict[str, Any] = {
        "command": "python -m studies roundtrip --out DIR",
        "traffic": f"{TRAFFIC.parameters}, ignore_share {IGNORE_SHARE:g}, level {TRAFFIC.lane_change_level:g}",
        "mean_law_over_environment": dict(zip(DRIVERS, mean_rates.tolist(), strict=True)),
    }
    for each, of in sets.items():
        found[f"{each:g} vehicle-hours"] = {
            "data_sets": len(of),
            "without_an_event": [int(sum(one[f"{SEEN}__{i}"].iloc[0] == 0 for one in of)) for i in range(N_STEPS)],
            "rates": judge_rates(of, near, drivers.true),
            "gradient": check(of, near, drivers),
            "numbers": judge_numbers(of, mean),
        }
    four_digits = json.loads(json.dumps(found), parse_float=lambda text: float(f"{float(text):.4g}"))
    write_json(folder / "roundtrip.json", four_digits)
    return folder / "roundtrip.json"
