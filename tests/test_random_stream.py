"""Random numbers by counter against numpy's Philox, word by word."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from harness.compiled import compiled
from harness.random_stream import DIAGNOSTIC, uniform, uniforms

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
