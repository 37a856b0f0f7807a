"""The laws of traffic, fitted to observations.

Initial states and accelerations are fitted in the shipped families, the former as densities, the latter by the
probabilities of the 31 accelerations, so that a law is fitted as it is drawn from. Lane changes are in `hazard`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse, special

from harness.families.cut_in.fitting.maximum import LogLikelihood, Maximum, Prior, maximise
from harness.families.cut_in.fitting.observations import KINDS, Observations
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2, N_ACCELERATIONS
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import BoolArray, FloatArray, IntArray, RecordArray

BASE = "ndd-overtaking-2"
"""Shipped environment whose numbers are kept where they are not fitted, or the data do not determine them."""
Base = Mapping[str, float]
"""Its numbers by ``section__name``."""
FEWEST = {"initial": 100, "free": 500, "following": 500, "leads": 20}
"""Fewest rows for which a law is fitted [assumed]."""
FEWEST_RECORDINGS = 10
"""With at least this many, recordings are the clusters, else vehicles [assumed]."""
OUTLIERS = 1e-4
"""Share of gaps that may lie anywhere in the fit range: the shifted log-normal law rules short ones out [assumed]."""
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class ObservedTraffic:
    """Observations of all recordings; ``vehicle`` numbers all vehicles, ``recording`` (vehicles,) is that of each."""

    free: RecordArray
    following: RecordArray
    initial: RecordArray
    at_risk: RecordArray
    leads: RecordArray
    recording: IntArray

    @classmethod
    def of(cls, observations: Iterable[Observations]) -> ObservedTraffic:
        """Join recordings."""
        by_kind = {name: [np.empty(0, dtype)] for name, dtype in KINDS.items()}
        recording = list[int]()
        for i, observed in enumerate(observations):
            n_before = len(recording)
            for name, parts in by_kind.items():
                rows = getattr(observed, name).copy()
                rows["vehicle"] += n_before
                parts.append(rows)
                recording += [i] * (int(rows["vehicle"].max(initial=-1)) + 1 - len(recording))
        columns = {name: np.concatenate(parts) for name, parts in by_kind.items()}
        return cls(**columns, recording=np.array(recording, int))

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


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """Numbers of a law: ``names`` (m,), and ``values`` (…, m) by coefficients (…, p)."""

    names: tuple[str, ...]
    values: Callable[[FloatArray], FloatArray]
    maximum: Maximum

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


def _between(below: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> FloatArray:
    """P(low < X ≤ high) of a symmetric X by its distribution function, precise in the tails."""
    flipped = low > 0.0
    return np.asarray(below(np.where(flipped, -low, high)) - below(np.where(flipped, -high, low)))


def _log(p: FloatArray) -> FloatArray:
    return np.asarray(np.log(np.maximum(p, _TINY)))


def _columns(n: int, *columns: FloatArray | float) -> FloatArray:
    return np.column_stack([np.broadcast_to(column, n) for column in columns])


LINKS: dict[str, tuple[Callable[[float], float], Callable[[FloatArray], FloatArray]]] = {
    "v_scale_mps": (math.log, np.exp),
    "r1dot_df": (lambda df: math.log(df - 2.0), _df),
    "df": (lambda df: math.log(df - 2.0), _df),
}
"""Functions from number to coefficient and back, where they are not the same."""


def _fitted(
    section: str,
    spread: Mapping[str, float],
    log_likelihood: LogLikelihood,
    designs: Sequence[FloatArray],
    traffic: ObservedTraffic,
    rows: RecordArray,
    base: Base,
    starts: Sequence[FloatArray] = (),
    *,
    kept: str = "",
    counted: tuple[RecordArray, IntArray] | None = None,
) -> FittedLaw | None:
    """Fit a law whose numbers are its coefficients; the prior is around the base's numbers, with ``spread`` by name.

    With ``counted`` likelihood and designs are of kinds of rows (k,): these kinds, and the kind of each row (n,).
    """
    data, cell = counted or (rows, None)
    by_name = {name: base[f"{section}__{name}"] for name in spread}
    centre = [LINKS[name][0](value) if name in LINKS else value for name, value in by_name.items()]
    prior = Prior.of(centre, list(spread.values()))
    is_kept = np.array([name == kept for name in spread])
    maximum = maximise(log_likelihood, data, designs, *traffic.members(rows, cell), prior, starts, kept=is_kept)

    def values(theta: FloatArray) -> FloatArray:
        out = np.array(theta)
        for i, name in enumerate(spread):
            if name in LINKS:
                out[..., i] = LINKS[name][1](theta[..., i])
        return out

    return None if maximum is None else FittedLaw(tuple(f"{section}__{name}" for name in spread), values, maximum)


# -- initial states --


def fit_speed(traffic: ObservedTraffic, base: Base) -> FittedLaw | None:
    """v_BV: skew-normal, truncated to the fit range."""
    rows, spread = traffic.initial, {"v_location_mps": 10.0, "v_scale_mps": 1.0, "v_shape": 4.0}
    if rows.size < FEWEST["initial"]:
        return None
    ends = base["fit_range__v_min_mps"], base["fit_range__v_max_mps"]

    def log_likelihood(rows: RecordArray, location: FloatArray, log_scale: FloatArray, shape: FloatArray) -> FloatArray:
        scale = np.exp(log_scale)
        z = (rows["v_mps"] - location) / scale
        ends_z = [(end - location[:1]) / scale[:1] for end in ends]  # the same for all rows
        below, upto = (special.ndtr(end) - 2.0 * special.owens_t(end, shape[:1]) for end in ends_z)
        return np.asarray(special.log_ndtr(shape * z) - 0.5 * z * z - log_scale - np.log(upto - below))

    mean, sd = float(rows["v_mps"].mean()), float(rows["v_mps"].std())
    starts = [np.array([mean + side * sd, math.log(sd * (1.0 + 0.5 * abs(side))), -2.0 * side]) for side in (-1, 0, 1)]
    designs = [np.ones((rows.size, 1))] * 3
    return _fitted("initial_state", spread, log_likelihood, designs, traffic, rows, base, starts)


def fit_gap(traffic: ObservedTraffic, base: Base) -> FittedLaw | None:
    """R1 given v_BV: shifted log-normal, truncated to the fit range."""
    rows = traffic.initial
    spread = {"r1_shift_m": 5.0, "r1_shift_u_m": 5.0, "r1_log_mean": 1.5, "r1_log_mean_u": 1.0}
    spread |= {"r1_log_sd": 1.0, "r1_log_sd_u": 1.0}
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
    logs = np.log(rows["r1_m"] + 1.0)
    plain = np.array([0.0, 0.0, logs.mean(), 0.0, math.log(logs.std()), 0.0])
    return _fitted("initial_state", spread, log_likelihood, [design] * 3, traffic, rows, base, [plain])


def fit_rate(traffic: ObservedTraffic, base: Base, kept: str = "") -> FittedLaw | None:
    """R1dot given v_BV and R1: Student's t, truncated at the smallest time to collision; one number may be ``kept``."""
    least_s = base["initial_state__r1dot_min_ttc_s"]
    rows = traffic.initial[traffic.initial["r1dot_mps"] > -traffic.initial["r1_m"] / least_s]
    location = ("location_mps", "location_u", "location_w", "location_uw", "location_uu")
    scale = {"log_scale": 1.5, "log_scale_u": 1.0, "log_scale_w": 1.0, "log_scale_ww": 1.0}
    spread = {f"r1dot_{name}": each for name, each in (dict.fromkeys(location, 3.0) | scale | {"df": 1.5}).items()}
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
    of_mean, of_scale = (1.0, u, w, u * w, u * u), (1.0, u, w, w * w)
    designs = [_columns(rows.size, *each) for each in (of_mean, of_scale, (1.0,))]
    return _fitted("initial_state", spread, log_likelihood, designs, traffic, rows, base, kept=kept)


# -- accelerations --


def bins(acceleration_mps2: FloatArray) -> IntArray:
    """Index of the nearest of the 31 accelerations; the end points take the tails."""
    nearest = np.rint((acceleration_mps2 - ACCELERATIONS_MPS2[0]) / 0.2)
    return np.asarray(np.clip(nearest, 0, N_ACCELERATIONS - 1), np.int64)


def _in_bin(rows: RecordArray, mean: FloatArray, log_scale: FloatArray, eta: FloatArray) -> FloatArray:
    """Probability of the ``bin`` of each row, with the mass above its ``cap`` moved to that."""
    k, scale, df = rows["bin"], np.exp(-log_scale), _df(eta)
    edge = ACCELERATIONS_MPS2[k] + 0.1
    low = np.where(k == 0, -np.inf, (edge - 0.2 - mean) * scale)
    high = np.where(k == rows["cap"], np.inf, (edge - mean) * scale)
    return _between(lambda t: special.stdtr(df, t), low, high)


def _binned(k: IntArray, cap: IntArray | int) -> RecordArray:
    """Accelerations ``bin`` (n,), at most the ``cap`` (n,)."""
    out = np.empty(k.size, [("bin", np.int64), ("cap", np.int64)])
    out["bin"], out["cap"] = np.minimum(k, cap), cap
    return out


def fit_free_driving(traffic: ObservedTraffic, base: Base) -> FittedLaw | None:
    """Accelerations in free driving: Student's t, mixed with a share that brakes."""
    rows = traffic.free
    spread = {"location_mps2": 0.5, "log_scale": 1.5, "log_scale_u": 1.0, "log_scale_uu": 1.0, "df": 1.5}
    spread |= {"brake_logit": 3.0, "brake_logit_u": 2.0, "brake_slope_s2pm": 1.0}
    if rows.size < FEWEST["free"]:
        return None
    # Rows of about the same speed and acceleration are counted together: some thousand kinds.
    v = np.rint(4.0 * rows["v_mps"]).astype(np.int64)
    kinds, cell = np.unique(v * N_ACCELERATIONS + bins(rows["acceleration_mps2"]), return_inverse=True)
    u, k = _scaled(base, kinds // N_ACCELERATIONS / 4.0), kinds % N_ACCELERATIONS
    brakes = base["free_driving__brake_max_mps2"] + 1e-9 >= ACCELERATIONS_MPS2

    def log_likelihood(rows: RecordArray, *predictors: FloatArray) -> FloatArray:
        *student, logit, slope = predictors
        share = special.expit(logit)
        powers = np.exp(slope[:, None] * ACCELERATIONS_MPS2[brakes])
        braking = np.where(brakes[rows["bin"]], np.exp(slope * ACCELERATIONS_MPS2[rows["bin"]]), 0.0)
        return _log((1.0 - share) * _in_bin(rows, *student) + share * braking / powers.sum(axis=1))

    designs = [_columns(k.size, *each) for each in ((1.0,), (1.0, u, u * u), (1.0,), (1.0, u), (1.0,))]
    counted = _binned(k, N_ACCELERATIONS - 1), cell
    return _fitted("free_driving", spread, log_likelihood, designs, traffic, rows, base, counted=counted)


def guard_caps(r1: FloatArray, r1dot: FloatArray, base: Base) -> IntArray:
    """Index of the largest acceleration that the guard allows (`harness.families.cut_in.laws.guard_cap`)."""
    h, own_braking = base["guard__horizon_s"], base["guard__own_braking_mps2"]
    cap = np.full(r1.size, -1)
    for acceleration in ACCELERATIONS_MPS2:
        closing = acceleration + base["guard__lead_braking_mps2"]
        rate = np.maximum(0.0, closing * h - r1dot)
        cap += r1 + r1dot * h - 0.5 * closing * h * h - rate * rate / (2.0 * own_braking) >= base["guard__margin_m"]
    return np.asarray(np.maximum(cap, 0), np.int64)


def fit_car_following(traffic: ObservedTraffic, base: Base) -> FittedLaw | None:
    """Accelerations behind a leader; guard and behaviour near standstill are kept.

    The mean's coefficients are those of R1dot and R1, three of the gap's polynomial in u, and the closing gain.
    """
    rows = traffic.following[traffic.following["r1_m"] >= base["car_following__near_gap_m"]]
    if rows.size < FEWEST["following"]:
        return None
    n = {key.removeprefix("car_following__"): value for key, value in base.items()}
    v0, dv = base["fit_range__v_centre_mps"], base["fit_range__v_scale_mps"]
    median, slope, bend = n["median_gap_m"], n["median_gap_v"], n["median_gap_vv"]
    gaps = np.array([median + slope * v0 + bend * v0 * v0, (slope + 2.0 * bend * v0) * dv, bend * dv * dv])
    centre = [n["gain_rate_per_s"], n["gain_gap_per_s2"], *(n["gain_gap_per_s2"] * gaps), n["closing_gain"]]
    centre += [n["log_scale"], n["log_scale_rate"], math.log(n["df"] - 2.0)]
    prior = Prior.of(centre, [0.5, 0.01, 0.3, 0.3, 0.3, 1.0, 1.5, 1.0, 1.5])

    r1, r1dot, u = rows["r1_m"], rows["r1dot_mps"], _scaled(base, rows["v_mps"])
    needed_mps2 = r1dot * r1dot / (2.0 * np.maximum(r1 - n["standstill_m"], n["smallest_gap_m"]))
    closing = (r1dot < 0.0) & (needed_mps2 > n["closing_threshold_mps2"])
    mean = np.where(closing[:, None], 0.0, _columns(rows.size, r1dot, r1, -1.0, -u, -u * u, 0.0))
    mean[closing, -1] = -needed_mps2[closing]
    scale = _columns(rows.size, 1.0, np.minimum(np.abs(r1dot), n["rate_cap_mps"]))
    binned = _binned(bins(rows["acceleration_mps2"]), guard_caps(r1, r1dot, base))

    def log_likelihood(rows: RecordArray, *predictors: FloatArray) -> FloatArray:
        return _log(_in_bin(rows, *predictors))

    def values(theta: FloatArray) -> FloatArray:
        rate, gain, b0, b1, b2, closing, log_scale, log_scale_rate, eta = np.moveaxis(theta, -1, 0)
        gain = np.maximum(gain, 1e-5)
        g0, g1, g2 = b0 / gain, b1 / gain / dv, b2 / gain / dv**2
        gap = g0 - g1 * v0 + g2 * v0 * v0, g1 - 2.0 * g2 * v0, g2
        numbers = np.maximum(rate, 0.0), gain, *gap, np.maximum(closing, 0.0), _df(eta), log_scale, log_scale_rate
        return np.stack(np.broadcast_arrays(*numbers), axis=-1)

    def fitted(kept: BoolArray | None = None) -> Maximum | None:
        designs = [mean, scale, np.ones((rows.size, 1))]
        return maximise(log_likelihood, binned, designs, *traffic.members(rows), prior, kept=kept)

    maximum = fitted()
    if maximum is not None and maximum.theta[1] < 3.0 * math.sqrt(maximum.covariance()[1, 1]):
        maximum = fitted(np.arange(prior.centre.size) == 1)  # gaps are divided by it
    names = ("gain_rate_per_s", "gain_gap_per_s2", "median_gap_m", "median_gap_v", "median_gap_vv", "closing_gain")
    named = tuple(f"car_following__{name}" for name in (*names, "df", "log_scale", "log_scale_rate"))
    return None if maximum is None else FittedLaw(named, values, maximum)


def fit_leads(traffic: ObservedTraffic, base: Base) -> FittedLaw | None:
    """Time from onset of lateral motion to overlap: log-normal, at most the longest, in steps."""
    rows, longest_s = traffic.leads, base["lateral__longest_lead_s"]
    if rows.size < FEWEST["leads"]:
        return None
    edge = longest_s - 0.5 * STEP_S

    def log_likelihood(rows: RecordArray, mean: FloatArray, log_sd: FloatArray) -> FloatArray:
        lead = np.minimum(rows["lead_s"], longest_s)
        low, high = np.maximum(lead - 0.5 * STEP_S, _TINY), np.where(lead >= edge, np.inf, lead + 0.5 * STEP_S)
        z = [(np.log(np.minimum(each, 1e300)) - mean) * np.exp(-log_sd) for each in (np.minimum(low, edge), high)]
        return _log(_between(special.ndtr, *z))

    logs = np.log(np.clip(rows["lead_s"], STEP_S, longest_s))
    prior = Prior.of([float(logs.mean()), math.log(max(float(logs.std()), 0.05))], [3.0, 2.0])
    maximum = maximise(log_likelihood, rows, [np.ones((rows.size, 1))] * 2, *traffic.members(rows), prior)

    def values(theta: FloatArray) -> FloatArray:
        return np.stack([base["lateral__distance_m"] * np.exp(-theta[..., 0]), np.exp(theta[..., 1])], axis=-1)

    names = "lateral__speed_median_mps", "lateral__speed_log_sd"
    return None if maximum is None else FittedLaw(names, values, maximum)


LAWS: dict[str, tuple[Callable[[ObservedTraffic, Base], FittedLaw | None], str]] = {
    "speed": (fit_speed, "speeds of BV"),
    "gap": (fit_gap, "gaps to LV"),
    "rate": (fit_rate, "speed differences to LV"),
    "free driving": (fit_free_driving, "accelerations in free driving"),
    "car following": (fit_car_following, "accelerations behind a leader"),
    "lead": (fit_leads, "leads of lane changes"),
}
"""Laws that may be kept from the base: how each is fitted, and what it is a law of."""
