"""The cut-ins that could happen on a naturalistic path, their exact probabilities, and which drivers crash on them.

LV's and BV's motion before the cut-in does not depend on the AV; BV's motion after it is drawn from free driving, which
does not depend on the AV either. So a path is walked once, each of its cut-in times has a probability that is known
once the AV's motion is (it keeps its speed, or has been recorded), and each driver is only a follower behind a given
BV: about a microsecond.

Cut-ins a tenth of a second apart mostly end alike. So of each path only every `STRIDE`-th step is asked, from a random
one on, and counts for the ones around it: that keeps every sum over cut-ins unbiased, and with the same time for more
paths the crash rates become known about three times sooner.

Paths are enumerated where crashes are, by importance sampling in the five uniforms that an initial state is made from.

Each uniform gets a piecewise constant density of its own, fitted to a pilot run, as in Lepage's VEGAS (J. Comput.
Phys. 27, 1978, 192), mixed with a share of the naturalistic density that bounds every weight.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.families.cut_in import laws
from harness.families.cut_in.lateral import draw_lead
from harness.families.cut_in.laws import Environment, InitialStates
from harness.families.cut_in.path import Trajectory, empty_trajectory, leave, state_of, walk, weigh_cut_ins, who_crashes
from harness.processes import made_ahead
from harness.progress import Progress
from harness.random_stream import DIAGNOSTIC, INITIAL, LV_DRAWS, uniform, uniforms
from harness.vehicles.drivers import Followers
from harness.vehicles.kinematics import CONTACT_M, gap, next_speed
from harness.vocabulary import AV, CUT_IN, LV, STATE_COLUMNS, BoolArray, FloatArray, Int8Array, IntArray, RecordArray

FREE_DRAWS_PER_CUT_IN = 256
"""Stride of the uniforms for BV's free driving: each cut-in time of a path has draws of its own."""
STRIDE = 4
"""Steps between the cut-ins of a path that are asked; `benchmarks.pool_stride` says what other numbers would cost."""


class BaselineRuns(NamedTuple):
    """What vehicles did without a cut-in, on paths (n,); for one that keeps its speed, `HOLDING` (0,).

    ``n_steps``, ``failed`` (n,): steps that are on record, and whether the vehicle failed then. ``x_m``, ``v_mps``
    (n, steps + 1) are its positions and speeds, undefined beyond.
    """

    n_steps: IntArray
    failed: BoolArray
    x_m: FloatArray
    v_mps: FloatArray

    def mean_distance_m(self, weight: FloatArray) -> float:
        """Mean distance that the vehicle drives where nobody cuts in; paths have the ``weight`` (n,)."""
        whole, rows = ~self.failed, np.arange(len(self.n_steps))
        distance = self.x_m[rows, self.n_steps] - self.x_m[:, 0]
        return float((weight * distance)[whole].sum() / weight[whole].sum())

    def digest(self) -> str:
        """Hash of what is on record."""
        digest = hashlib.sha256(self.n_steps.tobytes() + self.failed.tobytes())
        known = np.arange(self.x_m.shape[1]) <= self.n_steps[:, None]
        for values in (self.x_m, self.v_mps):
            digest.update(values[known].tobytes())
        return digest.hexdigest()


HOLDING = BaselineRuns(np.zeros(0, np.int64), np.zeros(0, np.bool_), np.zeros((0, 1)), np.zeros((0, 1)))


class CutInsOnPaths(NamedTuple):
    """All cut-ins that are asked of paths: rows are paths, columns steps.

    ``probability`` (n, steps) is ``stride`` · P(BV cuts in in that step | path) where it is asked, else 0: with uniform
    offsets the sum over any set of cut-ins has its probability as mean. ``crashes`` (n, steps) has one bit per driver.
    ``p_after_failure`` (n,) is the most that the probability of a cut-in after a failure of the AV can be, wherever it
    may be then: every wish to change lanes is carried out.
    """

    probability: FloatArray
    crashes: IntArray
    p_after_failure: FloatArray


class Script(NamedTuple):
    """Maneuvers of LV and BV on paths (n,), as an episode records them.

    ``lv``, ``bv`` (n, draws), 31 marking the cut-in; ``n_lv``, ``n_bv`` (n,) how many there are. ``lead`` (n,) is how
    many steps earlier BV begins to move sideways.
    """

    lv: Int8Array
    bv: Int8Array
    n_lv: IntArray
    n_bv: IntArray
    lead: IntArray


def enumerate_cut_ins(
    seed: int,
    index: IntArray,
    state: RecordArray,
    environment: Environment,
    followers: Followers,
    runs: BaselineRuns = HOLDING,
    stride: int = 1,
    offset: IntArray | None = None,
) -> CutInsOnPaths:
    """Every ``stride``-th cut-in of paths, ``index`` and initial ``state`` (n,); ``offset`` (n,) is each one's first.

    Drivers take over from the AV after the step of the onset.
    """
    shape = index.size, int(environment.numbers["max_steps"])
    found = CutInsOnPaths(np.zeros(shape), np.zeros(shape, np.int64), np.zeros(index.size))
    first = np.zeros(index.size, np.int64) if offset is None else offset
    scratch = empty_trajectory(environment)
    known = unboxed(environment), unboxed(followers), unboxed(runs)
    _enumerate(seed, index, state, stride, first, *known, unboxed(scratch), unboxed(found))
    return found


@compiled_threads
def _enumerate(
    seed: int,
    index: IntArray,
    state: RecordArray,
    stride: int,
    offset: IntArray,
    environment: Environment,
    followers: Followers,
    runs: BaselineRuns,
    path: Trajectory,
    found: CutInsOnPaths,
) -> None:
    max_steps = environment.numbers.max_steps
    for i in range(index.size):
        if runs.n_steps.size == 0:
            steps = reach = walk(state[i], seed, index[i], 0, max_steps, True, environment, path)
        else:
            reach = walk(state[i], seed, index[i], 0, max_steps, False, environment, path)
            steps = min(runs.n_steps[i], reach)
            for step in range(steps + 1):
                path.x[step, AV], path.v[step, AV] = runs.x_m[i, step], runs.v_mps[i, step]
        weigh_cut_ins(steps, environment, path)
        hazard = 0.0
        for cut in range(steps):
            if path.hazard[cut] > 0.0 and cut % stride == offset[i]:
                found.probability[i, cut] = stride * (math.exp(-hazard) * -math.expm1(-path.hazard[cut]))
                if followers.drivers.size > 0:
                    found.crashes[i, cut] = who_crashes_after(cut, seed, index[i], followers, environment, path)
            hazard += path.hazard[cut]
        if runs.failed.size > 0 and runs.failed[i]:
            most = 0.0
            for step in range(steps, reach):
                wish = laws.opportunity(state_of(path.x[step], path.v[step]), environment)
                most += laws.cut_in_hazard(wish, 1.0, environment)
            found.p_after_failure[i] = math.exp(-hazard) * -math.expm1(-most)


@compiled_inline
def who_crashes_after(
    cut: int, seed: int, index: int, followers: Followers, environment: Environment, path: Trajectory
) -> int:
    """One bit for each driver that crashes if BV cuts in in a step of a path that has been walked."""
    leave(cut, environment.numbers.max_steps, seed, index, cut * FREE_DRAWS_PER_CUT_IN, 0, environment, path)
    if gap(path.x[cut + 1, LV], path.x_after[cut + 1]) < CONTACT_M:
        return 0  # the episode ends as bv_lv_contact
    return who_crashes(followers, cut, draw_lead(cut, seed, index, environment.lateral), environment, path)


def write_script(
    seed: int,
    index: IntArray,
    cut: IntArray,
    state: RecordArray,
    environment: Environment,
    draws_per_cut_in: int = FREE_DRAWS_PER_CUT_IN,
) -> Script:
    """What LV and BV do on paths, ``index`` and initial ``state`` (n,), with cut-ins in steps ``cut`` (n,), -1: none.

    After a cut-in LV goes on to draw, to the end of the episode. ``draws_per_cut_in`` is 0 for an episode.
    """
    scratch, n = empty_trajectory(environment), index.size
    lv, bv = np.zeros((2, n, scratch.lv.size), np.int8)
    n_lv, n_bv = np.zeros((2, n), np.int64)
    script = Script(lv, bv, n_lv, n_bv, np.zeros(n, np.int64))
    _write(seed, index, cut, state, draws_per_cut_in, unboxed(environment), unboxed(scratch), unboxed(script))
    return script


@compiled_threads
def _write(
    seed: int,
    index: IntArray,
    cut: IntArray,
    state: RecordArray,
    draws_per_cut_in: int,
    environment: Environment,
    path: Trajectory,
    script: Script,
) -> None:
    n, lv, bv = environment.numbers, script.lv, script.bv
    for i in range(index.size):
        until = cut[i] + 1 if cut[i] >= 0 else n.max_steps
        steps = walk(state[i], seed, index[i], 0, until, False, environment, path)
        before = (steps - 1) // n.hold_steps + 1
        for m in range(before):
            lv[i, m], bv[i, m] = path.lv[m], path.bv[m]
        script.n_lv[i] = script.n_bv[i] = before
        if cut[i] < 0:
            continue
        bv[i, before] = CUT_IN
        drawn = leave(cut[i], n.max_steps, seed, index[i], cut[i] * draws_per_cut_in, 0, environment, path)
        for m in range(drawn):
            bv[i, before + 1 + m] = path.free[m]
        script.n_bv[i] += 1 + drawn
        script.lead[i] = draw_lead(cut[i], seed, index[i], environment.lateral)
        script.n_lv[i] = (n.max_steps - 1) // n.hold_steps + 1
        v = path.v[0, LV]
        for step in range(n.max_steps):
            m = step // n.hold_steps
            if step % n.hold_steps == 0 and m >= before:
                u = uniform(seed, index[i], LV_DRAWS, m)
                lv[i, m] = laws.drive_freely(u, v, environment)
            v = next_speed(v, laws.acceleration(lv[i, m]))


PILOT_PATHS = 2048
BLOCK_PATHS = 256
N_BINS = 16
NATURALISTIC_SHARE = 0.2
"""Weights are at most its inverse."""
AIMED_DRAW, OFFSET_DRAW = 0, 1
"""Draws of a path within the diagnostic stream."""


def aimed_points(density: FloatArray, u: FloatArray, choice: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, dimensions) drawn from a proposal, and their weights (n,): naturalistic density over the proposal's.

    The proposal is a product ``density`` (dimensions, N_BINS) on the unit cube, that within each bin with mean 1, mixed
    with the uniform one: ``choice`` (n,) are the uniforms that decide which points stay naturalistic. ``u``
    (n, dimensions) are those that become points.
    """
    edges = np.linspace(0.0, 1.0, N_BINS + 1)
    aimed = choice >= NATURALISTIC_SHARE
    points = u.copy()
    for d, levels in enumerate(density):
        cumulative = np.concatenate([[0.0], np.cumsum(levels) / N_BINS])
        cumulative[-1] = 1.0
        points[aimed, d] = np.interp(u[aimed, d], cumulative, edges)
    return points, weights_under(density, points)


def weights_under(density: FloatArray, points: FloatArray) -> FloatArray:
    """Naturalistic density over that of a proposal (see `aimed_points`) at points (n, dimensions), shape (n,)."""
    own = np.ones(len(points))
    for d, levels in enumerate(density):
        own *= levels[_bin_of(points[:, d])]
    weights: FloatArray = 1.0 / (NATURALISTIC_SHARE + (1.0 - NATURALISTIC_SHARE) * own)
    return weights


def fit_proposal(u: FloatArray, contribution: FloatArray) -> FloatArray:
    """Density of a proposal from the uniforms (n, dimensions) of a naturalistic pilot run, and each one's part (n,).

    The best density of one variable is the root of the contribution's mean square within each bin.
    """
    density = np.ones((u.shape[1], N_BINS))
    for d in range(u.shape[1]):
        bins = _bin_of(u[:, d])
        counts = np.bincount(bins, minlength=N_BINS)
        squares = np.bincount(bins, contribution * contribution, minlength=N_BINS) / np.maximum(counts, 1)
        root = np.sqrt(squares)
        smooth = np.convolve(np.concatenate([root[:1], root, root[-1:]]), [0.25, 0.5, 0.25], "valid")
        if smooth.sum() > 0.0:
            density[d] = smooth * (N_BINS / smooth.sum())
    return density


def _bin_of(u: FloatArray) -> IntArray:
    return np.minimum((u * N_BINS).astype(np.int64), N_BINS - 1)


def contributions(rates: FloatArray, share: FloatArray | float = 1.0) -> FloatArray:
    """What each path adds to all rates together, each relative to its mean, shape (n,).

    ``rates`` (n, columns) are those of the paths; a column counts by its ``share``.
    """
    mean = rates.mean(0)
    relative = rates / np.where(mean > 0.0, mean, 1.0)
    found: FloatArray = np.sqrt((relative * relative * share).sum(1))
    return found


@dataclass(frozen=True, eq=False)
class EnumeratedPaths:
    """Initial states (n,) of some paths, and their cut-ins.

    ``index`` (n,) are their numbers, ``weight`` (n,) the naturalistic over the proposal's density. ``mass`` (n, steps)
    is the probability of the cut-ins that one in this step stands for, times the weight; ``crashes`` (n, steps) has one
    bit per surrogate, as the library orders them.
    """

    index: IntArray
    state: RecordArray
    weight: FloatArray
    mass: FloatArray
    crashes: IntArray

    def rates(self, n_surrogates: int) -> FloatArray:
        """Per path: its weighted probability that each surrogate crashes, and of a cut-in; shape (n, D + 1)."""
        columns = [np.where(self.crashes & (1 << d), self.mass, 0.0).sum(1) for d in range(n_surrogates)]
        return np.column_stack([*columns, self.mass.sum(1)])


@dataclass(frozen=True, eq=False)
class Enumerator:
    """Enumerates consecutive paths of one environment, on all cores; the number of cores changes no bit."""

    environment: Environment
    followers: Followers
    seed: int
    proposal: FloatArray | None = None
    stride: int = STRIDE

    def __post_init__(self) -> None:
        # Compiled here, by one thread: of two that want a new kernel at once, the second would have to wait for
        # whatever else is compiled meanwhile.
        self._block(0, 0)

    def aimed(self, rates: FloatArray, share: FloatArray | float = 1.0) -> Enumerator:
        """The same, aimed at what contributes to the rates (n, columns) of its first paths; see `contributions`."""
        proposal = fit_proposal(self.uniforms(0, len(rates)), contributions(rates, share))
        return replace(self, proposal=proposal)

    def uniforms(self, first: int, n: int) -> FloatArray:
        """Uniforms of the initial states of consecutive paths, shape (n, 5)."""
        return uniforms(self.seed, first, n, INITIAL, len(STATE_COLUMNS))

    def weights(self, first: int, n: int) -> FloatArray:
        """Weights of consecutive naturalistic paths under the proposal, shape (n,)."""
        return np.ones(n) if self.proposal is None else weights_under(self.proposal, self.uniforms(first, n))

    def run(self, first: int, n: int, progress: Progress) -> EnumeratedPaths:
        """Paths ``first … first + n - 1``; ``n`` is a multiple of `BLOCK_PATHS`."""
        blocks: list[EnumeratedPaths] = []
        for block in made_ahead(self._block, range(first, first + n, BLOCK_PATHS)):
            blocks.append(block)
            progress.advance(BLOCK_PATHS)
        return EnumeratedPaths(*map(np.concatenate, zip(*(vars(block).values() for block in blocks), strict=True)))

    def _block(self, first: int, n: int = BLOCK_PATHS) -> EnumeratedPaths:
        u, weight = self.uniforms(first, n), np.ones(n)
        drawn = uniforms(self.seed, first, n, DIAGNOSTIC, 2)
        offset = (drawn[:, OFFSET_DRAW] * self.stride).astype(np.int64)
        if self.proposal is not None:
            u, weight = aimed_points(self.proposal, u, drawn[:, AIMED_DRAW])
        index, state = first + np.arange(n), InitialStates(self.environment.numbers).from_uniforms(u)
        asked = self.environment, self.followers
        found = enumerate_cut_ins(self.seed, index, state, *asked, stride=self.stride, offset=offset)
        return EnumeratedPaths(index, state, weight, found.probability * weight[:, None], found.crashes)
