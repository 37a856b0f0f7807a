"""The laws of traffic, fitted to observations.

Initial states and accelerations are fitted in the shipped families, the former as densities, the latter by the
probabilities of the 31 accelerations, so that a law is fitted as it is drawn from. The hazard of a lane change is the
exponential of a sum of piecewise linear functions of v, R1 and R1dot. Its log-likelihood, Σ log h over lane changes
- Σ h Δt over all seconds at risk, is that of moments in which nobody closes in within `FREE_TTC_S`. Below that, the
accepted share follows from k lane changes where E = Σ h Δt are expected.

Numbers that the data do not determine keep the value of the ``base``, a shipped environment.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, sparse, special

from harness.families.cut_in.parameters import SMALLEST_SHARE
from harness.fitting.maximum import Maximum, Prior, maximise
from harness.fitting.observations import AT_RISK, FOLLOWING, FREE, INITIAL, LEADS, Observations
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import ACCELERATIONS_MPS2, N_ACCELERATIONS, BoolArray, FloatArray, IntArray, RecordArray

Base = Mapping[str, float]
"""Numbers of an environment by ``section__name``."""
FREE_TTC_S = 8.0
TTC_EDGES_S = np.array([1.0, 2.0, 3.0, 5.0, FREE_TTC_S])
FEWEST = {"initial": 100, "free": 500, "following": 500, "leads": 20}
"""Fewest rows for which a law is fitted [assumed]."""
FEWEST_RECORDINGS = 10
"""With at least this many, recordings are the clusters, else vehicles [assumed]."""
OUTLIERS = 1e-4
"""Share of gaps that may lie anywhere in the fit range: the shifted log-normal law rules short ones out [assumed]."""
KNOTS = np.array([0.02, 0.2, 0.5, 0.8, 0.98])
"""Quantiles (means of those at lane changes and at risk) between which the log-hazard is straight."""
SMOOTH = 1.0, 3.0
"""Prior standard deviations of the log-hazard's bends (change over a quarter of the range) and steps [assumed]."""
Knots = tuple[FloatArray, FloatArray, FloatArray]
HAZARD_OF = ("v_mps", "r1_m", "r1dot_mps")
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Traffic:
    """Observations of all recordings; ``vehicle`` numbers all vehicles, ``recording`` (vehicles,) is that of each."""

    free: RecordArray
    following: RecordArray
    initial: RecordArray
    at_risk: RecordArray
    leads: RecordArray
    recording: IntArray

    @classmethod
    def of(cls, observations: Iterable[Observations]) -> Traffic:
        """Join recordings."""
        return cls.joined(cls._alone(i, each) for i, each in enumerate(observations))

    @classmethod
    def _alone(cls, number: int, seen: Observations) -> Traffic:
        arrays = {name: getattr(seen, name) for name in KINDS}
        n = 1 + max((int(rows["vehicle"].max()) for rows in arrays.values() if rows.size), default=-1)
        return cls(**arrays, recording=np.full(n, number))

    @classmethod
    def joined(cls, parts: Iterable[Traffic]) -> Traffic:
        """Join parts, whose recordings have different numbers."""
        parts = list(parts)
        before = np.cumsum([0, *(part.recording.size for part in parts)])
        whole = {}
        for name, dtype in KINDS.items():
            of_kind = [getattr(part, name) for part in parts]
            whole[name] = np.concatenate([np.empty(0, dtype), *of_kind])
            whole[name]["vehicle"] += np.repeat(before[:-1], [rows.size for rows in of_kind])
        recording = np.concatenate([np.empty(0, np.int64), *(part.recording for part in parts)])
        return cls(**whole, recording=recording)

    @property
    def n_recordings(self) -> int:
        """Recordings with observed vehicles."""
        return int(np.unique(self.recording).size)

    @property
    def by_recording(self) -> bool:
        """Whether recordings, and not vehicles, are resampled."""
        return self.n_recordings >= FEWEST_RECORDINGS

    @cached_property
    def cluster(self) -> IntArray:
        """Cluster of each vehicle."""
        return self.recording if self.by_recording else np.arange(self.recording.size)

    def members(self, rows: RecordArray, cell: IntArray | None = None) -> tuple[sparse.csr_array, IntArray]:
        """Counts by vehicle and row (or ``cell`` of similar rows), and the vehicles' clusters."""
        cell = np.arange(rows.size) if cell is None else cell
        shape = (self.recording.size, int(cell.max()) + 1)
        return sparse.csr_array((np.ones(rows.size), (rows["vehicle"], cell)), shape=shape), self.cluster


KINDS = {"free": FREE, "following": FOLLOWING, "initial": INITIAL, "at_risk": AT_RISK, "leads": LEADS}


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """Numbers of a law: ``names`` (m,), and ``values`` (…, m) by coefficients (…, p)."""

    names: tuple[str, ...]
    values: Callable[[FloatArray], FloatArray]
    maximum: Maximum
    rows: int

    @property
    def estimate(self) -> dict[str, float]:
        """Numbers by name."""
        return dict(zip(self.names, self.values(self.maximum.theta).tolist(), strict=True))

    @cached_property
    def std_error(self) -> dict[str, float]:
        """Standard errors of the numbers, by clusters; 0 where kept."""
        theta = self.maximum.theta
        steps = 1e-5 * np.eye(theta.size)
        slopes = (self.values(theta + steps) - self.values(theta - steps)) / 2e-5
        variance = ((slopes.T @ self.maximum.covariance()) * slopes.T).sum(axis=1)
        return dict(zip(self.names, np.sqrt(np.maximum(variance, 0.0)).tolist(), strict=True))


def _df(eta: FloatArray) -> FloatArray:
    """Degrees of freedom, at least 2, by their coefficient."""
    return 2.0 + np.exp(np.minimum(eta, 6.9))


def _scaled(base: Base, v: FloatArray) -> FloatArray:
    """Scaled speed u of the fits."""
    return np.asarray((v - base["fit_range__v_centre_mps"]) / base["fit_range__v_scale_mps"])


def _log(p: FloatArray) -> FloatArray:
    return np.asarray(np.log(np.maximum(p, _TINY)))


def _columns(n: int, *columns: FloatArray | float) -> FloatArray:
    return np.column_stack([np.broadcast_to(column, n) for column in columns])


# -- initial states --


def fit_speed(traffic: Traffic, base: Base) -> FittedLaw | None:
    """v_BV: skew-normal, truncated to the fit range."""
    rows, names = traffic.initial, ("v_location_mps", "v_scale_mps", "v_shape")
    if rows.size < FEWEST["initial"]:
        return None
    ends = base["fit_range__v_min_mps"], base["fit_range__v_max_mps"]

    def log_likelihood(rows: RecordArray, location: FloatArray, log_scale: FloatArray, shape: FloatArray) -> FloatArray:
        scale = np.exp(log_scale)
        z = (rows["v_mps"] - location) / scale
        ends_z = [(end - location[:1]) / scale[:1] for end in ends]  # the same for all rows
        below, upto = (special.ndtr(end) - 2.0 * special.owens_t(end, shape[:1]) for end in ends_z)
        return np.asarray(special.log_ndtr(shape * z) - 0.5 * z * z - log_scale - np.log(upto - below))

    location, scale, shape = (base[f"initial_state__{name}"] for name in names)
    mean, sd = float(rows["v_mps"].mean()), float(rows["v_mps"].std())
    starts = [np.array([mean + side * sd, math.log(sd * (1.0 + 0.5 * abs(side))), -2.0 * side]) for side in (-1, 0, 1)]
    prior = Prior.of([location, math.log(scale), shape], [10.0, 1.0, 4.0])
    ones = [np.ones((rows.size, 1))] * 3
    found = maximise(log_likelihood, rows, ones, *traffic.members(rows), prior, [prior.centre, *starts])
    return _law("initial_state", names, found, rows, {1: np.exp})


def fit_gap(traffic: Traffic, base: Base) -> FittedLaw | None:
    """R1 given v_BV: shifted log-normal, truncated to the fit range."""
    rows = traffic.initial
    names = ("r1_shift_m", "r1_shift_u_m", "r1_log_mean", "r1_log_mean_u", "r1_log_sd", "r1_log_sd_u")
    if rows.size < FEWEST["initial"]:
        return None
    least, most = base["fit_range__r1_min_m"], base["fit_range__r1_max_m"]

    def log_likelihood(rows: RecordArray, shift: FloatArray, mean: FloatArray, log_sd: FloatArray) -> FloatArray:
        def below(gap: FloatArray | float) -> FloatArray:
            z = (np.log(np.maximum(gap - shift, 1e-9)) - mean) * np.exp(-log_sd)
            return np.asarray(special.ndtr(z))

        inside = np.maximum(below(most) - below(least), _TINY)
        p = (below(rows["r1_m"] + 0.5) - below(rows["r1_m"] - 0.5)) / inside  # the density itself is unbounded
        return _log((1.0 - OUTLIERS) * p + OUTLIERS / (most - least))

    design = _columns(rows.size, 1.0, _scaled(base, rows["v_mps"]))
    centre = np.array([base[f"initial_state__{name}"] for name in names])
    prior = Prior.of(centre.tolist(), [5.0, 5.0, 1.5, 1.0, 1.0, 1.0])
    logs = np.log(rows["r1_m"] + 1.0)
    plain = np.array([0.0, 0.0, logs.mean(), 0.0, math.log(logs.std()), 0.0])
    found = maximise(log_likelihood, rows, [design] * 3, *traffic.members(rows), prior, [centre, plain])
    return _law("initial_state", names, found, rows)


def fit_rate(traffic: Traffic, base: Base, df: float | None = None) -> FittedLaw | None:
    """R1dot given v_BV and R1: Student's t, truncated at the smallest time to collision.

    Degrees of freedom are fitted unless they are given.
    """
    least_s = base["initial_state__r1dot_min_ttc_s"]
    rows = traffic.initial[traffic.initial["r1dot_mps"] > -traffic.initial["r1_m"] / least_s]
    location = ("location_mps", "location_u", "location_w", "location_uw", "location_uu")
    names = tuple(f"r1dot_{each}" for each in (*location, "log_scale", "log_scale_u", "log_scale_w", "log_scale_ww"))
    if rows.size < FEWEST["initial"]:
        return None

    def log_likelihood(rows: RecordArray, mean: FloatArray, log_scale: FloatArray, eta: FloatArray) -> FloatArray:
        df, scale = _df(eta), np.exp(-log_scale)
        z = (rows["r1dot_mps"] - mean) * scale
        slowest = (-rows["r1_m"] / least_s - mean) * scale
        peak = np.log(special.poch(0.5 * df, 0.5)) - 0.5 * np.log(df * math.pi)
        log_density = peak - 0.5 * (df + 1.0) * np.log1p(z * z / df) - log_scale
        return log_density - _log(special.stdtr(df, -slowest))

    u = _scaled(base, rows["v_mps"])
    w = (rows["r1_m"] - base["fit_range__r1_centre_m"]) / base["fit_range__r1_scale_m"]
    designs = [_columns(rows.size, 1.0, u, w, u * w, u * u), _columns(rows.size, 1.0, u, w, w * w)]
    centre = [base[f"initial_state__{name}"] for name in names]
    eta = math.log((df or base["initial_state__r1dot_df"]) - 2.0)
    prior = Prior.of([*centre, eta], [3.0] * 5 + [1.5, 1.0, 1.0, 1.0, 1.5])
    designs.append(np.ones((rows.size, 1)))
    kept = (np.arange(prior.centre.size) == len(names)) & (df is not None)
    found = maximise(log_likelihood, rows, designs, *traffic.members(rows), prior, kept=kept)
    return _law("initial_state", (*names, "r1dot_df"), found, rows, {len(names): _df})


def _law(
    section: str,
    names: Sequence[str],
    found: Maximum | None,
    rows: RecordArray,
    transforms: Mapping[int, Callable[[FloatArray], FloatArray]] | None = None,
) -> FittedLaw | None:
    """A law whose numbers are its coefficients, some transformed."""

    def values(theta: FloatArray) -> FloatArray:
        out = np.array(theta)
        for i, transform in (transforms or {}).items():
            out[..., i] = transform(theta[..., i])
        return out

    named = tuple(f"{section}__{name}" for name in names)
    return None if found is None else FittedLaw(named, values, found, rows.size)


# -- accelerations --


def bins(acceleration_mps2: FloatArray) -> IntArray:
    """Index of the nearest of the 31 accelerations; the end points take the tails."""
    nearest = np.rint((acceleration_mps2 - ACCELERATIONS_MPS2[0]) / 0.2)
    return np.asarray(np.clip(nearest, 0, N_ACCELERATIONS - 1), np.int64)


def _t_between(low: FloatArray, high: FloatArray, df: FloatArray) -> FloatArray:
    """P(low < T ≤ high), precise in the tails."""
    flipped = low > 0.0
    below, upto = np.where(flipped, -high, low), np.where(flipped, -low, high)
    return np.asarray(special.stdtr(df, upto) - special.stdtr(df, below))


def _in_bin(rows: RecordArray, mean: FloatArray, log_scale: FloatArray, df: FloatArray) -> FloatArray:
    """Probability of the ``bin`` of each row, with the mass above its ``cap`` moved to that."""
    k, scale = rows["bin"], np.exp(-log_scale)
    edge = ACCELERATIONS_MPS2[k] + 0.1
    low = np.where(k == 0, -np.inf, (edge - 0.2 - mean) * scale)
    high = np.where(k == rows["cap"], np.inf, (edge - mean) * scale)
    return _t_between(low, high, df)


_BINNED = np.dtype([("bin", np.int64), ("cap", np.int64)])


def _binned(k: IntArray, cap: IntArray | int) -> RecordArray:
    out = np.empty(k.size, _BINNED)
    out["bin"], out["cap"] = np.minimum(k, cap), cap
    return out


def fit_free_driving(traffic: Traffic, base: Base) -> FittedLaw | None:
    """Accelerations in free driving: Student's t, mixed with a share that brakes."""
    rows = traffic.free
    t = ("location_mps2", "log_scale", "log_scale_u", "log_scale_uu", "df")
    names = (*t, "brake_logit", "brake_logit_u", "brake_slope_s2pm")
    if rows.size < FEWEST["free"]:
        return None
    # Rows of about the same speed and acceleration are counted together: some thousand kinds.
    v = np.rint(4.0 * rows["v_mps"]).astype(np.int64)
    kinds, cell = np.unique(v * N_ACCELERATIONS + bins(rows["acceleration_mps2"]), return_inverse=True)
    u, k = _scaled(base, kinds // N_ACCELERATIONS / 4.0), kinds % N_ACCELERATIONS
    brakes = base["free_driving__brake_max_mps2"] + 1e-9 >= ACCELERATIONS_MPS2

    def log_likelihood(
        rows: RecordArray,
        mean: FloatArray,
        log_scale: FloatArray,
        eta: FloatArray,
        logit: FloatArray,
        slope: FloatArray,
    ) -> FloatArray:
        share = special.expit(logit)
        powers = np.exp(slope[:, None] * ACCELERATIONS_MPS2[brakes])
        braking = np.where(brakes[rows["bin"]], np.exp(slope * ACCELERATIONS_MPS2[rows["bin"]]), 0.0)
        p = (1.0 - share) * _in_bin(rows, mean, log_scale, _df(eta)) + share * braking / powers.sum(axis=1)
        return _log(p)

    one, linear = np.ones((k.size, 1)), _columns(k.size, 1.0, u)
    designs = [one, _columns(k.size, 1.0, u, u * u), one, linear, one]
    centre = [base[f"free_driving__{name}"] for name in names]
    centre[4] = math.log(centre[4] - 2.0)
    prior = Prior.of(centre, [0.5, 1.5, 1.0, 1.0, 1.5, 3.0, 2.0, 1.0])
    binned = _binned(k, N_ACCELERATIONS - 1)
    found = maximise(log_likelihood, binned, designs, *traffic.members(rows, cell), prior)
    return _law("free_driving", names, found, rows, {4: _df})


def follows(rows: RecordArray, base: Base) -> tuple[RecordArray, FloatArray, FloatArray, BoolArray]:
    """Inputs of car following: bins and caps, designs of mean (n, 6) and log scale (n, 2), and the rows used.

    The mean's coefficients are those of R1dot and R1, three of the gap's polynomial in u, and the closing gain.
    """
    r1, r1dot = rows["r1_m"], rows["r1dot_mps"]
    used = r1 >= base["car_following__near_gap_m"]
    room = np.maximum(r1 - base["car_following__standstill_m"], base["car_following__smallest_gap_m"])
    needed = r1dot * r1dot / (2.0 * room)
    closing = (r1dot < 0.0) & (needed > base["car_following__closing_threshold_mps2"])
    u = _scaled(base, rows["v_mps"])
    mean = _columns(rows.size, r1dot, r1, -1.0, -u, -u * u, 0.0)
    mean[closing] = 0.0
    mean[closing, -1] = -needed[closing]
    scale = _columns(rows.size, 1.0, np.minimum(np.abs(r1dot), base["car_following__rate_cap_mps"]))
    binned = _binned(bins(rows["acceleration_mps2"]), guard_caps(r1, r1dot, base))
    return binned, mean, scale, used


def guard_caps(r1: FloatArray, r1dot: FloatArray, base: Base) -> IntArray:
    """Index of the largest acceleration that the guard allows (`harness.families.cut_in.laws.guard_cap`)."""
    h, own = base["guard__horizon_s"], base["guard__own_braking_mps2"]
    cap = np.full(r1.size, -1)
    for acceleration in ACCELERATIONS_MPS2:
        closing = acceleration + base["guard__lead_braking_mps2"]
        rate = np.maximum(0.0, closing * h - r1dot)
        cap += r1 + r1dot * h - 0.5 * closing * h * h - rate * rate / (2.0 * own) >= base["guard__margin_m"]
    return np.asarray(np.maximum(cap, 0), np.int64)


def fit_car_following(traffic: Traffic, base: Base) -> FittedLaw | None:
    """Accelerations behind a leader; guard and behaviour near standstill are kept."""
    binned, mean, scale, used = follows(traffic.following, base)
    rows = traffic.following[used]
    if rows.size < FEWEST["following"]:
        return None
    n = {key.removeprefix("car_following__"): value for key, value in base.items()}
    v0, dv = base["fit_range__v_centre_mps"], base["fit_range__v_scale_mps"]
    median, slope, bend = n["median_gap_m"], n["median_gap_v"], n["median_gap_vv"]
    gaps = np.array([median + slope * v0 + bend * v0 * v0, (slope + 2.0 * bend * v0) * dv, bend * dv * dv])
    centre = [n["gain_rate_per_s"], n["gain_gap_per_s2"], *(n["gain_gap_per_s2"] * gaps), n["closing_gain"]]
    centre += [n["log_scale"], n["log_scale_rate"], math.log(n["df"] - 2.0)]
    prior = Prior.of(centre, [0.5, 0.01, 0.3, 0.3, 0.3, 1.0, 1.5, 1.0, 1.5])

    def log_likelihood(rows: RecordArray, mean: FloatArray, log_scale: FloatArray, eta: FloatArray) -> FloatArray:
        return _log(_in_bin(rows, mean, log_scale, _df(eta)))

    def values(theta: FloatArray) -> FloatArray:
        rate, gain, b0, b1, b2, closing, log_scale, log_scale_rate, eta = np.moveaxis(theta, -1, 0)
        gain = np.maximum(gain, 1e-5)
        g0, g1, g2 = b0 / gain, b1 / gain / dv, b2 / gain / dv**2
        gap = g0 - g1 * v0 + g2 * v0 * v0, g1 - 2.0 * g2 * v0, g2
        numbers = np.maximum(rate, 0.0), gain, *gap, np.maximum(closing, 0.0), _df(eta), log_scale, log_scale_rate
        return np.stack(np.broadcast_arrays(*numbers), axis=-1)

    def fitted(kept: BoolArray | None = None) -> Maximum | None:
        designs = [mean[used], scale[used], np.ones((rows.size, 1))]
        return maximise(log_likelihood, binned[used], designs, *traffic.members(rows), prior, kept=kept)

    found = fitted()
    if found is not None and found.theta[1] < 3.0 * math.sqrt(found.covariance()[1, 1]):
        found = fitted(np.arange(prior.centre.size) == 1)  # gaps are divided by it
    names = ("gain_rate_per_s", "gain_gap_per_s2", "median_gap_m", "median_gap_v", "median_gap_vv", "closing_gain")
    named = tuple(f"car_following__{name}" for name in (*names, "df", "log_scale", "log_scale_rate"))
    return None if found is None else FittedLaw(named, values, found, rows.size)


# -- lane changes --


def fit_hazard(traffic: Traffic) -> tuple[FittedLaw, Knots] | None:
    """Hazard of a lane change where nobody closes in within `FREE_TTC_S`, and the knots of v, R1 and R1dot.

    Coefficients are an intercept and effects at all knots but the middle one of each.
    """
    rows = traffic.at_risk[traffic.at_risk["ttc_s"] > FREE_TTC_S]
    n_changes = int(rows["changes"].sum())
    if not n_changes:
        return None
    first, second, third = (_knots(rows, name) for name in HAZARD_OF)
    knots = first, second, third

    def log_likelihood(rows: RecordArray, eta: FloatArray) -> FloatArray:
        # Decided once a second (`cut_in.laws`); beyond a chance of 1/2 straight on, as a bend has no maximum.
        rate = -np.log1p(-np.minimum(np.exp(eta), 0.5)) + np.maximum(eta + math.log(2.0), 0.0)
        return np.asarray(np.where(rows["changes"], np.log(rate), 0.0) - rate * rows["duration_s"])

    def values(theta: FloatArray) -> FloatArray:
        effects, at = [], 1
        for each in knots:
            part, middle = theta[..., at : at + each.size - 1], each.size // 2
            none = np.zeros((*theta.shape[:-1], 1))
            effects += [part[..., :middle], none, part[..., middle:]]
            at += each.size - 1
        effects[:3] = [effect + theta[..., :1] for effect in effects[:3]]  # of v, with the intercept
        return np.concatenate(effects, axis=-1)

    weights = linalg.block_diag(np.array([[0.01]]), *(_penalty(each) for each in knots))
    centre = np.zeros(weights.shape[1])
    centre[0] = math.log(n_changes / rows["duration_s"].sum())
    prior = Prior(centre, weights, smooths=True)
    found = maximise(log_likelihood, rows, [hazard_design(knots, rows)], *traffic.members(rows), prior)
    axes = zip(("v_log", "r1_log", "r1dot_log"), knots, strict=True)
    names = tuple(f"hazard_table__{name}__{i}" for name, each in axes for i in range(each.size))
    return None if found is None else (FittedLaw(names, values, found, rows.size), knots)


def hazard_design(knots: Knots, rows: RecordArray) -> FloatArray:
    """Design matrix (n, p) of the log-hazard in some states (n,)."""
    columns = [np.ones(rows.size)]
    for name, at in zip(HAZARD_OF, knots, strict=True):
        columns += [np.interp(rows[name], at, hat) for j, hat in enumerate(np.eye(at.size)) if j != at.size // 2]
    return np.column_stack(columns)


def _knots(rows: RecordArray, name: str) -> FloatArray:
    """Rounded quantiles (means of those at crossings and at risk), at least a twentieth of their range apart."""
    at = 0.5 * (np.quantile(rows[name], KNOTS) + np.quantile(rows[name][rows["changes"]], KNOTS))
    found = [round(float(at[0]), 1)]
    for each in np.round(at[1:], 1).tolist():
        if each - found[-1] > 0.05 * (at[-1] - at[0]):
            found.append(each)
    return np.array(found)


def _penalty(knots: FloatArray) -> FloatArray:
    """Pseudo-observations, about 0, of bends and steps of an effect; the middle knot is left out."""
    if knots.size == 1:
        return np.empty((0, 0))
    identity = np.eye(knots.size)
    slopes = np.diff(identity, axis=0) / np.diff(knots)[:, None]
    bends = np.diff(slopes, axis=0) * (knots[-1] - knots[0]) / 4.0
    weights = np.vstack([bends / SMOOTH[0], np.diff(identity, axis=0) / SMOOTH[1]])
    return np.delete(weights, knots.size // 2, axis=1)


@dataclass(frozen=True, eq=False)
class Acceptance:
    """Lane changes by time to collision with the vehicle behind, in bins with the edges `TTC_EDGES_S`.

    ``events`` (6,) are those seen, ``exposure`` (6,) those expected with nobody closing in: Σ h Δt. ``design``
    holds rows of the hazard (n, p) in all bins but the last, with ``bin`` and ``duration_s`` (n,).
    """

    events: IntArray
    exposure: FloatArray
    design: FloatArray
    bin: IntArray
    duration_s: FloatArray

    @classmethod
    def of(cls, traffic: Traffic, hazard: FittedLaw, knots: Knots) -> Acceptance:
        """Count lane changes and what is expected."""
        rows = traffic.at_risk
        design = hazard_design(knots, rows)
        at = np.searchsorted(TTC_EDGES_S, rows["ttc_s"], side="right")
        n = TTC_EDGES_S.size + 1
        events = np.bincount(at[rows["changes"]], minlength=n).astype(np.int64)
        wished = np.exp(design @ hazard.maximum.theta) * rows["duration_s"]
        near = at < n - 1
        exposure = np.bincount(at, wished, minlength=n).astype(np.float64)
        return cls(events, exposure, design[near], at[near].astype(np.int64), rows["duration_s"][near])

    def exposures(self, theta: FloatArray) -> FloatArray:
        """Expected lane changes (b, 5) in all bins but the last, by coefficients (b, p) of the hazard."""
        hazard = np.exp(self.design @ theta.T) * self.duration_s[:, None]
        return np.asarray(np.stack([hazard[self.bin == j].sum(axis=0) for j in range(TTC_EDGES_S.size)], axis=1))

    @property
    def shares(self) -> FloatArray:
        """Estimates (6,), at most 1. Without an event half of one is counted, up to the shares of longer times."""
        events, exposure = self.events[:-1], np.maximum(self.exposure[:-1], 1e-12)
        shares = np.append(np.minimum(np.maximum(events, 0.5) / exposure, 1.0), 1.0)
        for step in np.flatnonzero(events == 0)[::-1]:
            shares[step] = shares[step:].min()
        return shares

    def drawn(self, theta: FloatArray, random: np.random.Generator) -> FloatArray:
        """Shares (b, 5) drawn by the uncertainty of counts, for hazards with coefficients (b, p).

        Drivers accept a shorter time no more often than a longer one, but draws are not ordered like that. Where shares
        are equal, as for drivers who do not look, ordered draws would be too small at the shortest times.
        """
        counts = random.gamma(self.events[:-1] + 0.5, size=(len(theta), TTC_EDGES_S.size))
        return np.clip(counts / np.maximum(self.exposures(theta), 1e-12), SMALLEST_SHARE, 1.0)

    @property
    def std_errors(self) -> FloatArray:
        """Standard errors of the shares (6,), by counts; 0 of the last."""
        near = np.sqrt(self.events[:-1] + 0.5) / np.maximum(self.exposure[:-1], 1e-12)
        return np.append(np.minimum(near, 1.0), 0.0)


def fit_leads(traffic: Traffic, base: Base) -> FittedLaw | None:
    """Time from onset of lateral motion to overlap: log-normal, at most the longest, in steps."""
    rows, longest_s = traffic.leads, base.get("lateral__longest_lead_s")
    if rows.size < FEWEST["leads"] or longest_s is None:
        return None
    edge = longest_s - 0.5 * STEP_S

    def log_likelihood(rows: RecordArray, mean: FloatArray, log_sd: FloatArray) -> FloatArray:
        lead = np.minimum(rows["lead_s"], longest_s)
        low, high = np.maximum(lead - 0.5 * STEP_S, _TINY), np.where(lead >= edge, np.inf, lead + 0.5 * STEP_S)
        z = [(np.log(np.minimum(each, 1e300)) - mean) * np.exp(-log_sd) for each in (np.minimum(low, edge), high)]
        flipped = z[0] > 0.0
        below, upto = np.where(flipped, -z[1], z[0]), np.where(flipped, -z[0], z[1])
        return _log(special.ndtr(upto) - special.ndtr(below))

    logs = np.log(np.clip(rows["lead_s"], STEP_S, longest_s))
    prior = Prior.of([float(logs.mean()), math.log(max(float(logs.std()), 0.05))], [3.0, 2.0])
    found = maximise(log_likelihood, rows, [np.ones((rows.size, 1))] * 2, *traffic.members(rows), prior)

    def speed(mean: FloatArray) -> FloatArray:
        return base["lateral__distance_m"] * np.exp(-mean)

    return _law("lateral", ("speed_median_mps", "speed_log_sd"), found, rows, {0: speed, 1: np.exp})
