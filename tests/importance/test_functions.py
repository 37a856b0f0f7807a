"""Importance functions by exact summation, at states that campaigns recorded and at arbitrary ones.

    Σ_a q_j = 1,   E_q[p/q | s] = Σ_{a: q_j > 0} p = 1,   E_q[C p/q | s] = V_j.

With ε = 0 maneuvers that cannot lead to a crash are never drawn: the second sum is then the exposure of the others.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from harness.campaign.campaign import Campaign
from harness.families.cut_in.nade.functions import as_challenge, harmless_cells
from harness.families.cut_in.nade.grid import interpolate_maneuvers
from harness.families.cut_in.nade.tables import Tables
from harness.families.cut_in.vocabulary import CUT_IN, STATE_COLUMNS, STAY
from harness.vehicles.kinematics import CONTACT_M
from tests.episode.twin_runs import prepared, run
from tests.kernels import accumulated, after_cut_in, before_event, drawn

CHALLENGES = {"immediate": "SM-I", "recursive": "default"}  # and the surrogates
EPSILONS = (0.0, 0.1, 1.0)
settings = pytest.mark.parametrize(
    ("challenge", "epsilon"), [(challenge, epsilon) for challenge in CHALLENGES for epsilon in EPSILONS]
)

speeds = st.floats(5.0, 45.0)
r2dots = st.floats(-24.0, 6.0)
states = st.tuples(speeds, st.floats(0.0, 200.0), st.floats(-10.0, 10.0), st.floats(1e-6, 110.0), r2dots)
maneuvers = st.integers(0, 30)
steps = st.integers(0, 19).map(lambda second: 10 * second)


def policy_of(challenge, epsilon):
    """Environment and importance functions, at a level where cutting in is not always negligible."""
    source = prepared("step_mixture", challenge, level=1e4, surrogates=CHALLENGES[challenge])
    return source.resolved.environment, source.importance._replace(epsilon=epsilon)


def recorded(challenge):
    """States, maneuvers and steps of BV's redraw times: before the cut-in, and after it."""
    done = run("step_mixture", challenge, n=1_500, moments="all", surrogates=CHALLENGES[challenge])
    moment = done.moment
    state = np.column_stack([moment[name] for name in STATE_COLUMNS])
    before = np.isin(moment["maneuver"], (CUT_IN, STAY)) & (moment["step"] % 10 == 0)
    return done, state, before, moment["maneuver"] < CUT_IN


def held(done, moment):
    """BV's maneuver at a redraw time before the cut-in."""
    return done.shard.traffic.drawn.bv_path[moment["row"], moment["step"] // 10]


def require_identities(proposals, epsilon):
    p, q, v, critical = proposals
    p = p[:, None, :]
    np.testing.assert_allclose(q.sum(axis=-1), 1.0, rtol=0, atol=1e-12)
    assert (q >= 0.0).all()
    assert (q <= 1.0 + 1e-12).all()
    mean_ratio = np.where(q > 0.0, p, 0.0).sum(axis=-1)
    if epsilon > 0.0:
        np.testing.assert_allclose(mean_ratio, 1.0, rtol=0, atol=1e-12)
        assert (q >= epsilon * p * (1.0 - 1e-12)).all()
    assert (mean_ratio <= 1.0 + 1e-12).all()
    np.testing.assert_array_equal(np.where(v[..., None] == 0.0, q, 0.0), np.where(v[..., None] == 0.0, p, 0.0))
    if epsilon == 1.0:
        np.testing.assert_allclose(q, np.broadcast_to(p, q.shape), rtol=1e-12, atol=1e-300)
    np.testing.assert_array_equal(critical, (v > 0.0).any(axis=1))
    assert (v >= 0.0).all()
    assert (v <= 1.0 + 1e-6).all()


@pytest.mark.slow
@settings
@given(st.lists(st.tuples(states, maneuvers, steps), min_size=1, max_size=20))
def test_identities_anywhere(challenge, epsilon, situations):
    environment, importance = policy_of(challenge, epsilon)
    state, maneuver, step = (np.array(column) for column in zip(*situations, strict=True))
    require_identities(before_event(state, maneuver, step, environment, importance), epsilon)
    require_identities(after_cut_in(state, environment, importance, step), epsilon)


@pytest.mark.parametrize("challenge", [pytest.param("immediate", marks=pytest.mark.slow), "recursive"])
def test_records_hold_what_was_drawn_from(challenge):
    """p, V_j and q_j of the maneuver taken, recomputed from the recorded state alone: equal in every bit."""
    done, state, before, after = recorded(challenge)
    environment, importance = done.prepared.resolved.environment, done.prepared.importance
    rows = done.moment[before]
    found = before_event(state[before], held(done, rows), rows["step"], environment, importance)
    taken = (rows["maneuver"] == STAY).astype(int)
    each = np.arange(len(rows))
    np.testing.assert_array_equal(done.moment_v[before], found.v)
    np.testing.assert_array_equal(done.moment_q[before], found.q[each, :, taken])
    np.testing.assert_array_equal(rows["p"], found.p[each, taken])
    rows, each = done.moment[after], np.arange(after.sum())
    found = after_cut_in(state[after], environment, importance, rows["step"])
    np.testing.assert_array_equal(done.moment_v[after], found.v)
    np.testing.assert_array_equal(done.moment_q[after], found.q[each, :, rows["maneuver"]])
    np.testing.assert_array_equal(rows["p"], found.p[each, rows["maneuver"]])
    np.testing.assert_allclose(done.moment_q @ done.alpha, done.moment["q_sampled"], rtol=1e-12)


@pytest.mark.parametrize("component", [1, 2, 3])
def test_draws_follow_the_mixture_or_the_component(component):
    """Equal steps of the uniform give every acceleration its probability to within one step."""
    source = prepared("step_mixture", "recursive")
    found = after_cut_in([(30.0, 40.0, 0.0, 11.0, -8.0)], source.resolved.environment, source.importance)
    q, alpha = found.q[0], np.array([0.5, 0.3, 0.2])
    assert found.critical[0]
    u = (np.arange(100_000) + 0.5) / 100_000
    by_step = np.bincount(drawn(u, -1, alpha, q), minlength=31) / u.size
    np.testing.assert_allclose(by_step, alpha @ q, rtol=0, atol=1.001e-5)
    by_component = np.bincount(drawn(u, component, alpha, q), minlength=31) / u.size
    np.testing.assert_allclose(by_component, q[component - 1], rtol=0, atol=1.001e-5)
    assert np.abs(by_step - by_component).max() > 1e-3


# -- grid cells that are skipped: those, and only those, in which interpolation could find no challenge --

SHAPE = (1, 3, 4, 5, 31)


def scattered(recursive):
    """Many harmless values, and here and there one that just is not."""
    rng = np.random.default_rng(20261121)
    rare = rng.random(SHAPE) < 1.0 / 400.0
    if recursive:
        return np.where(rare, np.nextafter(0, 1, dtype=np.float32), 0.0).astype(np.float32)
    near = (CONTACT_M + rng.exponential(1.0, SHAPE)).astype(np.float32)
    return np.where(rare, np.float32(CONTACT_M - 1e-6), np.maximum(near, np.float32(CONTACT_M + 1e-6)))


@pytest.mark.parametrize("recursive", [True, False])
def test_harmless_cells_are_those_without_a_challenge_wherever_they_are_read(recursive):
    table = scattered(recursive)
    by_time = np.stack([table.max(-1) if recursive else table.min(-1)] * 2, axis=1)
    harmless = harmless_cells(Tables(by_time, table, by_time, by_time), recursive=recursive)[:, -1]
    rng = np.random.default_rng(1)
    out = np.empty(31)
    found = np.argwhere(harmless[0])
    assert 5 < len(found) < harmless.size
    for i, g, k in found:
        for a, b, c in [*rng.random((20, 3)), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]:
            interpolate_maneuvers(table[0], (i, a, g, b, k, c), out)
            assert [as_challenge(value, recursive) for value in out] == [0.0] * 31
    challenging = np.any(table[0] > 0.0 if recursive else table[0] < CONTACT_M, axis=-1)
    for i, g, k in np.ndindex(harmless.shape[1:]):
        assert harmless[0, i, g, k] == (not challenging[i : i + 2, g : g + 2, k : k + 2].any())


# -- likelihood ratios: the predictive mixture telescopes to the mixture over whole episodes; fixed weights do not --


EPSILON = Campaign(name="default").testing.epsilon
ratio = st.one_of(st.just(0.0), st.floats(1e-6, 1e6))
weights = st.lists(st.floats(0.05, 1.0), min_size=4, max_size=4).map(lambda w: np.array(w) / sum(w))


@st.composite
def sequences(draw, possible=ratio):
    n = draw(st.integers(1, 30))
    ratios = np.array(draw(st.lists(st.lists(possible, min_size=4, max_size=4), min_size=n, max_size=n)))
    ratios[:, 3] = np.maximum(ratios[:, 3], 1e-3)  # what was drawn is possible under some component
    return ratios


def log(x):
    with np.errstate(divide="ignore"):
        return np.log(x)


@given(weights, sequences())
def test_the_episode_mixture_telescopes(alpha, ratios):
    """Π_t Σ_j w_j,t r_j,t with posterior weights is Σ_j α_j Π_t r_j,t: the ratio of whole episodes."""
    log_ratio, _, sampled = accumulated(True, alpha, ratios, np.zeros((len(ratios), 3)))
    np.testing.assert_allclose(log_ratio, log(ratios).sum(axis=0), rtol=1e-12, atol=1e-12)
    assert np.log(sampled).sum() == pytest.approx(logsumexp(log_ratio, b=alpha), rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("of_episodes", [False, True])
@given(weights, sequences(st.floats(0.1, 10.0)), st.integers(0, 2**32 - 1))
def test_martingale_terms(of_episodes, alpha, ratios, seed):
    """Σ_t W_t C_j - W_{t-1} V_j, W being one over the ratio sampled so far; V = 0 adds nothing."""
    v = np.random.default_rng(seed).random((len(ratios), 3))
    v[::3] = 0.0
    _, martingale, sampled = accumulated(of_episodes, alpha, ratios, v)
    weight = np.concatenate([[1.0], 1.0 / np.cumprod(sampled)])[:, None]
    challenge = v * (ratios[:, 1:] - EPSILON) / (1.0 - EPSILON)
    terms = weight[1:] * challenge - weight[:-1] * v
    scale = (weight[1:] * np.abs(challenge) + weight[:-1] * v).sum(axis=0) + 1e-300
    assert (np.abs(martingale - terms.sum(axis=0)) <= 1e-9 * scale).all()


@pytest.mark.parametrize("of_episodes", [False, True])
@given(weights, st.integers(0, 2**32 - 1))
def test_the_mean_of_martingale_sums_over_all_episodes_is_zero(of_episodes, alpha, seed):
    """Three steps of three maneuvers, any challenge, and a forced function that some maneuvers are impossible under."""
    rng, steps, maneuvers = np.random.default_rng(seed), 3, range(3)
    means, wrong = np.zeros(3), np.zeros(3)
    laws = {}
    for path in itertools.chain.from_iterable(itertools.product(maneuvers, repeat=t) for t in range(steps)):
        p, challenge = rng.dirichlet(np.ones(3)), rng.random((3, 3)) * rng.integers(0, 2, (3, 3))
        forced = rng.dirichlet(np.ones(3)) * np.array([0.0, 1.0, 1.0])
        v = challenge @ p
        aimed = np.divide(challenge, v[:, None], out=np.ones((3, 3)), where=v[:, None] > 0.0)
        ratios = np.vstack([forced / forced.sum() / p, EPSILON + (1.0 - EPSILON) * aimed])
        laws[path] = p, ratios, challenge, v
    for path in itertools.product(maneuvers, repeat=steps):
        along = [(laws[path[:t]], path[t]) for t in range(steps)]
        ratios = np.array([law[1][:, a] for law, a in along])
        v, seen = np.array([law[3] for law, _ in along]), np.array([law[2][:, a] for law, a in along])
        _, martingale, sampled = accumulated(of_episodes, alpha, ratios, v)
        probability = np.prod([law[0][a] for law, a in along]) * np.prod(sampled)
        means += probability * martingale
        wrong += probability * accumulated(of_episodes, alpha, ratios, seen)[1]
    assert np.all(np.abs(means) < 1e-12)
    challenged = np.array([law[2].std(axis=1) for law in laws.values()]).max() > 0.0
    assert np.abs(wrong).max() > 1e-9 or not challenged  # told what comes, instead of what was to be expected
