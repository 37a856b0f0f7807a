"""A running hash of the AV's motion: whether a test's vehicle has done what it did in its shadow run, to the last bit.

Each word is mixed in by a multiplication, which carries low bits up, and a shift, which brings high bits down: the
finalizer of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014, doi:10.1145/2660193.2660195), one round per word. Two
motions that differ agree by chance with a probability of about 2^-64.
"""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled, compiled_inline
from harness.vocabulary import FloatArray, UInt64Array

_MULTIPLIER = np.uint64(0xBF58476D1CE4E5B9)
_SHIFT = np.uint64(31)


@compiled_inline
def mixed(so_far: np.uint64, word: np.uint64) -> np.uint64:
    """The hash, continued by the bits of one number."""
    z = (so_far ^ word) * _MULTIPLIER
    return z ^ (z >> _SHIFT)


@compiled
def _hash_motion(x: UInt64Array, v: UInt64Array, hashes: UInt64Array) -> None:
    for i in range(x.shape[0]):
        so_far = np.uint64(0)
        for step in range(hashes.shape[1]):
            so_far = mixed(mixed(so_far, x[i, step + 1]), v[i, step + 1])
            hashes[i, step] = so_far


def motion_hashes(x_m: FloatArray, v_mps: FloatArray) -> UInt64Array:
    """Hash of positions and speeds (n, steps + 1) after each step, shape (n, steps); initial states are left out."""
    hashes = np.zeros((x_m.shape[0], x_m.shape[1] - 1), np.uint64)
    _hash_motion(np.ascontiguousarray(x_m).view(np.uint64), np.ascontiguousarray(v_mps).view(np.uint64), hashes)
    return hashes
