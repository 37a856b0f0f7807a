"""Random numbers by counter: any uniform of any episode, without drawing those before it.

Every random number of a campaign is ``uniform(key, episode, stream, index)``: Philox4x64-10 (Salmon et al., "Parallel
random numbers: as easy as 1, 2, 3", SC 2011, doi:10.1145/2063384.2063405) with the campaign seed as key and
(index, episode, stream) as counter. So an episode does not depend on K, on workers, on what ran before it, or on how
many numbers another part of it used. Tests hold it against ``numpy.random.Philox``, word by word.
"""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled, compiled_inline
from harness.vocabulary import FloatArray

INITIAL, LV_DRAWS, BV_DRAWS, BV_FREE_DRAWS, EVENT, AV_DRAWS, DIAGNOSTIC, LATERAL = range(8)
"""Streams. A stream is one purpose, so that adding a purpose never shifts the numbers of another."""

_M0 = np.uint64(0xD2E7470EE14C6C93)
_M1 = np.uint64(0xCA5A826395121157)
_W0 = np.uint64(0x9E3779B97F4A7C15)
_W1 = np.uint64(0xBB67AE8584CAA73B)
_LOW = np.uint64(0xFFFFFFFF)
_32 = np.uint64(32)
_11 = np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2**-53


@compiled_inline
def _multiply_high(a: np.uint64, b: np.uint64) -> np.uint64:
    """High 64 bits of the 128-bit product."""
    a_low, a_high = a & _LOW, a >> _32
    b_low, b_high = b & _LOW, b >> _32
    low = a_low * b_low
    middle = a_high * b_low + (low >> _32)
    cross = a_low * b_high + (middle & _LOW)
    return a_high * b_high + (middle >> _32) + (cross >> _32)


@compiled_inline
def philox_block(
    key0: np.uint64, key1: np.uint64, c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Four 64-bit words of Philox4x64-10 for the words of one key and counter."""
    for _ in range(10):
        high0 = _multiply_high(_M0, c0)
        low0 = _M0 * c0
        high1 = _multiply_high(_M1, c2)
        low1 = _M1 * c2
        c0, c1, c2, c3 = high1 ^ c1 ^ key0, low1, high0 ^ c3 ^ key1, low0
        key0 = key0 + _W0
        key1 = key1 + _W1
    return c0, c1, c2, c3


@compiled_inline
def uniform(seed: int, episode: int, stream: int, index: int) -> float:
    """One uniform in [0, 1) with 53 random bits: number ``index`` of an episode's stream."""
    i = np.uint64(index)
    w0, w1, w2, w3 = philox_block(
        np.uint64(seed), np.uint64(0), i >> np.uint64(2), np.uint64(episode), np.uint64(stream), np.uint64(0)
    )
    which = i & np.uint64(3)
    word = w0
    if which == np.uint64(1):
        word = w1
    elif which == np.uint64(2):
        word = w2
    elif which == np.uint64(3):
        word = w3
    return float(word >> _11) * _TO_UNIT


@compiled
def _fill_uniforms(seed: int, first_episode: int, stream: int, out: FloatArray) -> None:
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = uniform(seed, first_episode + i, stream, j)


def uniforms(seed: int, first_episode: int, n_episodes: int, stream: int, count: int) -> FloatArray:
    """Uniforms in [0, 1), shape (n_episodes, count): row i for episode ``first_episode + i``."""
    out = np.empty((n_episodes, count))
    _fill_uniforms(seed, first_episode, stream, out)
    return out


def controller_random(seed: int, episode: int) -> np.random.Generator:
    """Random numbers of the AV's controller in an episode, by numpy: a stream of the same generator."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, episode, AV_DRAWS, 0]))
