"""Laws of traffic: probabilities against the formulas, draws against the probabilities, noise, guard, cut-in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

from harness.compiled import compiled
from harness.families.cut_in.laws import InitialStates, t_table
from harness.random_stream import DIAGNOSTIC, uniform, uniforms
from tests.chains import SEED
from tests.kernels import bv_accelerations, cut_in_terms, environment, t_distribution

speeds = st.floats(0.0, 60.0)
gaps = st.floats(-0.001, 200.0)
rates = st.floats(-25.0, 25.0)
STATES = [(30.0, 35.0, 0.3), (24.0, 12.0, -2.5), (33.0, 4.0, -1.0), (28.0, 60.0, -9.0), (20.0, 110.0, 6.0)]
STATES += [(38.0, 8.0, 0.0)]
UNIFORMS = (np.arange(100_000) + 0.5) / 100_000
DEGREES_OF_FREEDOM = [1.5, 3.39, 4.98, 16.0, 200.0]

# -- the formulas written out a second time, with published numbers: no parameter file is read, no kernel called --

ACCELERATIONS = np.linspace(-4.0, 2.0, 31)
EDGES = np.concatenate([[-np.inf], (ACCELERATIONS[1:] + ACCELERATIONS[:-1]) / 2, [np.inf]])


def fit_u(v):
    return (np.clip(v, 20.0, 40.0) - 30.0) / 10.0


def free_driving_pmf(v):
    """Probabilities of the 31 accelerations at a speed."""
    u = fit_u(v)
    weight = special.expit(-4.80 - 1.57 * u)
    noise = np.diff(stats.t.cdf(EDGES, 16, 0.061, np.exp(-1.416 - 0.262 * u + 0.423 * u**2)))
    brake = np.where(ACCELERATIONS <= -1.0 + 1e-9, np.exp(0.18 * ACCELERATIONS), 0.0)
    return (1.0 - weight) * noise + weight * brake / brake.sum()


def guard_room(a, r1, r1dot):
    """Gap (m) left to BV, should LV brake with 1 m/s² for a second and BV then stop closing at 3 m/s²."""
    gap_later = r1 + r1dot - (a + 1.0) / 2.0
    closing_later = np.maximum(0.0, -r1dot + a + 1.0)
    return gap_later - closing_later**2 / 6.0


def guard_caps(r1, r1dot):
    """Indices that may be the largest acceleration leaving a metre (0 when none does): several only within rounding."""
    room = guard_room(ACCELERATIONS, r1, r1dot)
    surely, perhaps = (np.flatnonzero(room >= 1.0 + rounding).max(initial=0) for rounding in (1e-9, -1e-9))
    return range(surely, perhaps + 1)


def car_following_mean(v, r1, r1dot):
    clamped = np.clip(v, 20.0, 40.0)
    mean = 0.16 * r1dot + 0.002 * (np.clip(r1, 0.0, 115.0) - (0.084 * clamped**2 - 3.605 * clamped + 65.59))
    needed = r1dot**2 / (2.0 * max(r1 - 2.0, 0.5))
    if r1dot < 0.0 and needed > 0.3:
        mean = -1.2 * needed
    return min(mean, -1.0) if r1 < 5.0 else mean


def car_following_pmf(v, r1, r1dot, cap):
    """Probabilities of the 31 accelerations of BV behind LV, what the guard forbids moved to its cap."""
    scale = np.exp(-1.849 + 0.248 * min(abs(r1dot), 4.0))
    wanted = np.diff(stats.t.cdf(EDGES, 3.39, car_following_mean(v, r1, r1dot), scale))
    allowed = np.where(np.arange(31) <= cap, wanted, 0.0)
    allowed[cap] += wanted[cap + 1 :].sum()
    return allowed


def opportunity(v, r1, r1dot, level):
    u, q = fit_u(v), np.clip(r1dot, -10.0, 10.0) / 5.0
    gap = np.clip(r1, 0.0, 115.0)
    wish = -8.744 - 0.318 * u - 0.727 * np.log(gap + 1.0) + 0.159 * q + 0.451 * q**2 + 0.618 * u**2
    return level * np.exp(wish)


def acceptance(r2, r2dot):
    if r2 <= 0.0:
        return 0.0
    accept = 1.0 if r2dot >= 0.0 else special.expit((r2 / -r2dot - 8.0) / 0.5)
    return 0.01 + 0.99 * accept


def step_probability(p_1s):
    return 1.0 - (1.0 - np.minimum(p_1s, 0.5)) ** 0.1


@pytest.mark.parametrize("follows", [False, True])
@given(speeds, gaps, rates)
def test_probabilities_are_the_formula_and_the_guard_caps_at_the_largest_safe_acceleration(follows, speed, r1, r1dot):
    pmf, cap, _ = (each[0] for each in bv_accelerations((speed, r1, r1dot), follows=follows))
    expected = car_following_pmf(speed, r1, r1dot, cap) if follows else free_driving_pmf(speed)
    assert cap in (guard_caps(r1, r1dot) if follows else [30])
    assert pmf.sum() == pytest.approx(1.0, abs=1e-12)
    assert (pmf >= 0.0).all()
    np.testing.assert_allclose(pmf, expected, rtol=0, atol=2e-8)
    assert (pmf[cap + 1 :] == 0.0).all()


@pytest.mark.parametrize("follows", [False, True])
@pytest.mark.parametrize("state", STATES)
def test_draws_invert_the_distribution(state, follows):
    """Equal steps of the uniform give every acceleration its probability to within one step, 1e-5."""
    pmf, cap, drawn = (each[0] for each in bv_accelerations(state, UNIFORMS, follows=follows))
    assert (np.diff(drawn) >= 0).all()
    assert np.abs(np.bincount(drawn, minlength=31) / UNIFORMS.size - pmf).max() < 1.001e-5
    assert drawn.max() <= cap


@pytest.mark.parametrize("df", DEGREES_OF_FREEDOM)
def test_noise_is_within_1e_8_of_scipys_and_rises_from_0_to_1(df):
    table = t_table(df)
    z = np.concatenate([np.random.default_rng(0).uniform(-70.0, 70.0, 200_000), np.linspace(-4.0, 4.0, 20_001)])
    z.sort()
    found, within = t_distribution(z, table), np.abs(z) <= 64.0
    assert np.abs(found - stats.t.cdf(z, df))[within].max() < 1e-8
    assert (np.diff(found) >= 0.0).all()
    assert t_distribution(np.array([-np.inf, -64.1, 64.1, np.inf]), table).tolist() == [0.0, 0.0, 1.0, 1.0]


av_gaps = st.floats(-10.0, 110.0)
levels = st.sampled_from([1e-3, 1.0, 100.0, 350.0, 1e4, 1e6, 1e8])


@given(speeds, gaps, rates, av_gaps, rates, levels)
def test_the_hazard_is_the_formula(v, r1, r1dot, r2, r2dot, level):
    wish, accepted, hazard = cut_in_terms((v, r1, r1dot, r2, r2dot), level)[0]
    assert wish == pytest.approx(opportunity(v, r1, r1dot, level), rel=1e-12)
    assert accepted == pytest.approx(acceptance(r2, r2dot), rel=1e-12)
    p_1s = wish * accepted
    assert -np.expm1(-hazard) == pytest.approx(step_probability(p_1s), rel=1e-9, abs=1e-16)
    assert 0.0 <= hazard <= 0.1 * np.log(2.0) * (1.0 + 1e-15)  # never above one half a second


# -- initial states against distribution functions by scipy, with the published numbers --


open_unit = st.floats(1e-9, 1.0 - 1e-9)
inside_v = st.floats(20.0, 40.0)
SPEED = stats.skewnorm(-2.41, 33.86, 5.174)


def speed_distribution(v):
    low, high = SPEED.cdf(20.0), SPEED.cdf(40.0)
    return (SPEED.cdf(v) - low) / (high - low)


def test_speeds_are_skew_normal_and_the_avs_part_is_uniform():
    states = InitialStates(environment().numbers).draw(SEED, 0, 20_000)
    av = {"r2_m": stats.uniform(20.0, 80.0).cdf, "r2dot_mps": stats.uniform(-10.0, 5.0).cdf}
    for column, distribution in {**av, "v_bv_mps": speed_distribution}.items():
        assert stats.kstest(states[column], distribution).pvalue > 1e-4


def gap_distribution(v):
    """R1 at a speed: shift + LogNormal, as scipy has it, and its probabilities at 0 and 115 m."""
    u = (v - 30.0) / 10.0
    free = stats.lognorm(np.exp(-0.191 + 0.191 * u), 9.66 + 6.43 * u, np.exp(3.282 + 0.311 * u))
    return free, free.cdf(0.0), free.cdf(115.0)


def rate_distribution(v, r1):
    u, w = (v - 30.0) / 10.0, (r1 - 40.0) / 40.0
    location = 0.331 - 0.687 * u - 0.219 * w - 0.904 * u * w - 0.230 * u**2
    return stats.t(4.98, location, np.exp(-0.015 - 0.109 * u + 0.808 * w - 0.327 * w**2))


@given(inside_v, open_unit)
def test_gaps_invert_their_distribution(v, probability):
    found = InitialStates(environment().numbers).given_speed(v, np.array([probability]), np.array([0.5]))["r1_m"][0]
    free, low, high = gap_distribution(v)
    assert (free.cdf(found) - low) / (high - low) == pytest.approx(probability, abs=1e-9)


@given(inside_v, open_unit, open_unit)
def test_rates_invert_their_distribution_beyond_three_seconds_to_collision(v, gap_u, probability):
    state = InitialStates(environment().numbers).given_speed(v, np.array([gap_u]), np.array([probability]))[0]
    free = rate_distribution(v, state["r1_m"])
    low = free.cdf(-state["r1_m"] / 3.0)
    assert (free.cdf(state["r1dot_mps"]) - low) / (1.0 - low) == pytest.approx(probability, abs=1e-9)


# -- random numbers by counter against numpy's Philox, word by word --


natural = st.integers(0, 2**62)
streams = st.integers(0, DIAGNOSTIC)


@compiled
def uniforms_at(seed, episode, stream, indices, out):
    for i in range(indices.size):
        out[i] = uniform(seed, episode, stream, indices[i])


def numpy_words(key, counter, count=4):
    """Words of numpy's generator, which steps its 256-bit counter before it uses it."""
    before = (sum(c << (64 * i) for i, c in enumerate(counter)) - 1) % 2**256
    return np.random.Philox(key=key[0] + (key[1] << 64), counter=before).random_raw(count)


def at(seed, episode, stream, indices):
    out = np.empty(len(indices))
    uniforms_at(seed, episode, stream, np.array(indices, np.int64), out)
    return out


@given(natural, natural, streams, st.lists(natural, min_size=1, max_size=9))
def test_any_uniform_without_its_predecessors(seed, episode, stream, indices):
    found = at(seed, episode, stream, indices)
    for value, index in zip(found, indices, strict=True):
        words = numpy_words((seed, 0), (index >> 2, episode, stream, 0))
        assert value == (int(words[index & 3]) >> 11) / 2**53
        assert 0.0 <= value < 1.0


@given(natural, natural, streams, st.integers(1, 40))
def test_a_row_is_what_numpys_generator_draws(seed, episode, stream, count):
    before = ((episode << 64) + (stream << 128) - 1) % 2**256
    generator = np.random.Generator(np.random.Philox(key=seed, counter=before))
    # numpy carries its counter into the episode's word after 2**64 blocks: never within a row.
    np.testing.assert_array_equal(uniforms(seed, episode, 1, stream, count)[0], generator.random(count))
