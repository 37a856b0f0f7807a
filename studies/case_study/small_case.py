"""The smaller case of the 2022 conference version, of which every course is listed, so that all is known exactly.

LV keeps 3 m/s, BV follows it from 8 m/s, AV keeps 13 m/s on the other lane, 5 m behind BV; only R1 is random at the
start. BV draws an acceleration each second and may cut in in each step; AV has passed it within two seconds. After the
cut-in BV keeps its speed, so that whether the vehicle, or a surrogate, crashes is certain. R1's distribution is that of
the nodes and weights of Gauss and Legendre: all that follows from it is smooth in R1.

What the conference version does not say (drivers, probabilities) is that of this project: its environment, whose fits
end at 20 m/s and are held constant below, and its default vehicle and surrogates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from harness.campaign.drivers import default_surrogates
from harness.campaign.sections import EnvironmentSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.estimators.block import MAX_CONTROL_STEPS, Block, SamplingPlan
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.loading import evaluate_laws, load_environment
from harness.families.cut_in.nade.challenge import roll_out
from harness.families.cut_in.nade.grid import GridPoints
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2, N_ACCELERATIONS
from harness.vehicles.drivers import av_records, driver_records
from harness.vehicles.kinematics import CONTACT_M, STEP_S
from harness.vocabulary import CRASH, TIMEOUT, BoolArray, FloatArray, RecordArray
from studies.case_study.counted import Claims, KnownMeans
from studies.case_study.figures import covered, exactly, is_settled, marked, mean_of, range_of, tests_for
from studies.case_study.study import Context, SmallCase

LV_MPS, BV_MPS, AV_MPS = 3.0, 8.0, 13.0
R1_M, R2_M = (30.0, 32.0), 5.0
STEPS, HOLD = 100, 10
NODES = 8


class Proposal(NamedTuple):
    """q_j(cut_in) by step and course (T, R, A, A, J), and where it is critical (T, R, A, A)."""

    q: FloatArray
    critical: BoolArray


@dataclass(frozen=True, eq=False)
class SmallWorld:
    """Every course of a test: R1 (R) and the accelerations that BV draws first and second (A each), without a cut-in.

    ``first`` (R, A) and ``second`` (R, A, A) are the probability of R1 with the first acceleration, and of the second
    given those. By step and course, (T, R, A, A): ``running``, as AV has not passed; the probability ``p`` to cut in,
    0 if it has; whether the vehicle under test would crash then, ``crash``, and which surrogates would, with a last
    axis (J).
    """

    first: FloatArray
    second: FloatArray
    running: BoolArray
    p: FloatArray
    crash: FloatArray
    surrogates: FloatArray

    def value(self, cutting: FloatArray, staying: FloatArray) -> FloatArray:
        """Induce backwards what a cut-in is worth in each step, and a factor of what comes later; (T, R, A, A, …)."""
        values = np.zeros_like(cutting)
        later = np.zeros_like(cutting[-1])
        for t in range(len(cutting) - 1, -1, -1):
            values[t] = later = cutting[t] + (staying[t].T * later.T).T
            if t == HOLD:
                later = np.broadcast_to(np.einsum("rab,rab...->ra...", self.second, later)[:, :, None], later.shape)
        return values

    def mean(self, value: FloatArray) -> float:
        """Mean over the beginnings of a test of a value (T, R, A, A) in its first step."""
        return float(np.sum(self.first * value[0, :, :, 0]))

    @cached_property
    def crash_rate(self) -> float:
        """μ."""
        return self.mean(self.value(self.p * self.crash, 1.0 - self.p))

    def proposals(self, epsilon: float, *, recursive: bool, threshold: float = 0.0) -> Proposal:
        """Importance functions; a later cut-in counts only for the recursive challenge.

        A situation is critical where V_j of any surrogate is above the threshold; elsewhere all draw from p.
        """
        p = np.broadcast_to(self.p[..., None], self.surrogates.shape)
        cutting = p * self.surrogates
        v = self.value(cutting, 1.0 - self.p) if recursive else cutting
        critical = np.any(v > threshold, axis=-1)
        aimed = epsilon * p + (1.0 - epsilon) * np.divide(cutting, v, out=p.copy(), where=v > 0.0)
        return Proposal(np.where(critical[..., None] & (v > 0.0), aimed, p), critical)

    def relvar(self, proposals: Proposal) -> float:
        """Var(Y)/μ² of a test under the step mixture with equal weights, by backward induction of E[Y² | situation]."""
        q = proposals.q.mean(axis=-1)
        cutting = np.divide(self.p**2, q, out=np.zeros_like(q), where=q > 0.0) * self.crash
        staying = np.divide((1.0 - self.p) ** 2, 1.0 - q, out=np.zeros_like(q), where=q < 1.0)
        return self.mean(self.value(cutting, staying)) / self.crash_rate**2 - 1.0

    def draw(self, proposals: Proposal, n: int, rng: np.random.Generator) -> Block:
        """Tests under the step mixture, as the estimators see those of any world."""
        j, running = self.surrogates.shape[-1], np.arange(n)
        begun = rng.choice(self.first.size, n, p=self.first.ravel() / self.first.sum())
        course = np.array([*np.unravel_index(begun, self.first.shape), np.zeros(n, np.int64)])
        log_weight, steps, ratios = np.zeros(n), np.zeros(n, np.int64), np.ones((n, MAX_CONTROL_STEPS, j))
        crash, cut_in, log_q = np.zeros(n, bool), np.zeros(n, bool), np.zeros((n, j))
        for t in range(len(self.p)):
            if t:
                u = rng.random(len(running))
                if t == HOLD:
                    total = np.cumsum(self.second[*course[:2, running]], axis=1)
                    course[2, running] = np.minimum((total <= u[:, None]).sum(axis=1), N_ACCELERATIONS - 1)
                running = running[self.running[t, *course[:, running]]]
            here = t, *course[:, running]
            p, q, critical = self.p[here], proposals.q[here], proposals.critical[here]
            cut = rng.random(len(running)) < q.mean(axis=1)
            chosen_p, chosen_q = np.where(cut, p, 1.0 - p), np.where(cut[:, None], q, 1.0 - q)
            sampled = chosen_q.mean(axis=1)
            log_weight[running] += np.log(chosen_p / sampled)
            log_q[running] += np.log(chosen_q / chosen_p[:, None])
            kept = critical & (steps[running] < MAX_CONTROL_STEPS)
            ratios[running[kept], steps[running[kept]]] = (chosen_q / sampled[:, None])[kept]
            steps[running] += critical
            crash[running], cut_in[running] = cut & (self.crash[here] > 0.0), cut
            running = running[~cut]
        columns = {"happened": cut_in, "log_q": log_q, "n_control_steps": steps, "first_ratios": ratios}
        drawn = SamplingPlan("step_mixture", np.full(j, 1.0 / j))
        return Block(0, np.where(crash, CRASH, TIMEOUT).astype(np.int8), log_weight, columns, drawn)


def small_world(level: float, *, nodes: int = NODES) -> SmallWorld:
    """All courses at a level of lane changing."""
    environment = load_environment(EnvironmentSettings(parameters="ndd-overtaking-1", lane_change_level=level))
    records = driver_records([each.parameters for each in default_surrogates().values()])
    drivers = [av_records(AutomatedVehicle()), *np.split(records, len(records))]
    x, weight = np.polynomial.legendre.leggauss(nodes)
    courses = nodes, N_ACCELERATIONS, N_ACCELERATIONS
    speed, r2 = np.full(courses, BV_MPS), np.full(courses, R2_M)
    r1 = np.broadcast_to((R1_M[0] + (x + 1.0) / 2.0 * (R1_M[1] - R1_M[0]))[:, None, None], courses)
    steps, drawn = list[tuple[BoolArray, FloatArray, FloatArray]](), list[FloatArray]()
    while np.any(running := r2 > 0.0):
        if len(steps) % HOLD == 0:  # BV draws: before AV has passed it does so twice
            pmf, _, _ = _laws(speed[:, :, 0].ravel(), r1[:, :, 0].ravel(), np.zeros((0, 2)), environment)
            drawn.append(pmf.reshape(courses))
        p = np.zeros(courses)
        p[running] = _cut_in(speed[running], r1[running], r2[running], environment)
        after = np.maximum(speed + ACCELERATIONS_MPS2[:, None if len(steps) < HOLD else ...] * STEP_S, 0.0)
        r1 = r1 + (LV_MPS - 0.5 * (speed + after)) * STEP_S
        r2 = r2 + (0.5 * (speed + after) - AV_MPS) * STEP_S
        speed, crash = after, np.zeros((*courses, len(drivers)))
        crash[running] = _crashes(drivers, speed[running], r2[running], STEPS - 1 - len(steps))
        steps.append((running, p, crash))
    all_running, all_p, crashes = map(np.stack, zip(*steps, strict=True))
    first = weight[:, None] / 2.0 * drawn[0][:, 0]
    return SmallWorld(first, drawn[1], all_running, all_p, crashes[..., 0], crashes[..., 1:])


def _cut_in(speed: FloatArray, r1: FloatArray, r2: FloatArray, environment: Environment) -> FloatArray:
    """Probability to cut in within the step, as `harness.families.cut_in.laws.cut_in_hazard` gives it."""
    n = environment.numbers
    _, chance, accepted = _laws(speed, r1, np.column_stack([r2, speed - AV_MPS]), environment)
    p_1s = np.minimum(chance * accepted, float(n["cut_in__max_probability_1s"]))
    return np.asarray(-np.expm1(float(n["scenario__step_s"]) * np.log1p(-p_1s)))


def _laws(
    speed: FloatArray, r1: FloatArray, approaches: FloatArray, environment: Environment
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """BV's distribution over accelerations behind LV (m, 31), its wish to change lanes (m,), and acceptance."""
    states = np.column_stack([speed, r1, LV_MPS - speed])
    pmf, _, chance, accepted = evaluate_laws(environment, states, approaches)
    return pmf[1], chance, accepted


def _crashes(drivers: Sequence[RecordArray], speed: FloatArray, r2: FloatArray, steps: int) -> FloatArray:
    """Who runs into BV, which keeps its speed, in so many steps after that of the cut-in: (m, drivers)."""
    states, back = np.unique(np.column_stack([speed, r2]), axis=0, return_inverse=True)
    found = np.zeros((len(states), len(drivers)))
    for row, (v, gap) in enumerate(states):
        points = GridPoints(np.array([v]), np.array([gap]), np.array([v - AV_MPS]))
        for k, driver in enumerate(drivers):
            smallest = np.empty((2, 1, 1, 1), np.float32)
            of_maneuvers = np.empty((1, 1, 1, N_ACCELERATIONS), np.float32)
            roll_out(driver, 0, max(steps, 1), points, smallest, of_maneuvers, np.empty_like(smallest))
            found[row, k] = gap < CONTACT_M or (steps > 0 and smallest[1, 0, 0, 0] < CONTACT_M)
    return found[back.ravel()]


_world = cache(small_world)
TRUE_WITHIN = 2.0
"""Factor between NADE's claim and the exact number up to which claims of a setting count, as in the page's verdicts."""


def answer_small_case(step: SmallCase, context: Context) -> dict[str, Any]:
    """Exact rate and variances, and what drawn tests claim, for every challenge, threshold and epsilon."""
    settings = list(enumerate(product((False, True), step.thresholds, step.epsilons)))
    rows = context.by_workers(settings, partial(claims_of_setting, step, context.confidence))
    world = _world(step.lane_change_level)
    figures = {"nde": exactly(tests_for(1.0 / world.crash_rate - 1.0, step.rhw, context.confidence))}
    gains = [marked(row["gain_known"], settled=is_settled(row["nade_claimed"])) for row in rows]
    figures["gain_known"] = range_of(sorted(filter(is_settled, gains), key=lambda gain: -(gain["value"] or 0.0)))
    for name, wanted in step.reported.items():  # NADE's exact numbers, or what SCV claims: the nearest first
        found = [exactly(row["nade_exact"]) if name == "nade" else row["scv_claimed"] for row in rows]
        known = [one for one in found if one["value"] and is_settled(one)]
        figures[f"{name}_range"] = range_of(sorted(known, key=lambda one: abs(math.log(one["value"] / wanted))))
    return {"crash_rate": world.crash_rate, "settings": rows, "figures": figures}


def claims_of_setting(
    step: SmallCase, confidence: float, setting: tuple[int, tuple[bool, float, float]]
) -> dict[str, Any]:
    """One setting: its exact variance, and what NADE and SCV claim; its place among all seeds its tests."""
    world, n = _world(step.lane_change_level), step.tests_of_draw
    place, (recursive, threshold, epsilon) = setting
    proposals = world.proposals(epsilon, recursive=recursive, threshold=threshold)
    others = Claims()
    others.add(world.draw(proposals, step.tests, np.random.default_rng([2, place])))
    known, many = KnownMeans(others.scv), list[dict[str, Any]]()
    for k in range(step.draws):
        found, block = Claims(), world.draw(proposals, n, np.random.default_rng([3, place, k]))
        found.add(block)
        known.add(block)
        many.append(found.row(step.rhw, confidence))
    exact = tests_for(world.relvar(proposals), step.rhw, confidence)
    nade, scv = (mean_of((each[f"{name}_tests"] for each in many), confidence) for name in ("nade", "scv"))
    once = others.row(step.rhw, confidence)
    means_something = once["settled"] and holds(nade["value"], exact)
    return {
        "challenge": "recursive" if recursive else "immediate",
        "threshold": threshold,
        "epsilon": epsilon,
        "mean_weight": once["mean_weight"],
        "difference": once["difference"],
        "nade_exact": exact,
        "nade_claimed": marked(nade, settled=means_something),
        "scv_claimed": marked(scv, settled=means_something),
        "nade_covers": covered([each["nade_rate"] for each in many], world.crash_rate),
        **known.row(confidence),
    }


def holds(claimed: float | None, exact: float) -> bool:
    """Whether NADE claims what is known to be true, about."""
    return claimed is not None and exact / TRUE_WITHIN <= claimed <= exact * TRUE_WITHIN
