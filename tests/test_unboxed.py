"""Named tuples that kernels are given as one pointer: what compiled code reads is the tuple's own."""

import gc
import pickle
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from harness.compiled import compiled, compiled_inline
from harness.unboxed import unboxed


class Inner(NamedTuple):
    total: np.ndarray
    fixed: np.ndarray


class Bundle(NamedTuple):
    factor: float
    steps: int
    doubled: bool
    inner: Inner
    numbers: Any


def bundle(kind=np.float64):
    fixed = np.arange(12, dtype=kind).reshape(3, 4)
    fixed.flags.writeable = False
    numbers = np.array([(2.5, 7)], [("weight", float), ("count", int)])[0]
    return Bundle(0.5, 3, True, Inner(np.zeros(3), fixed), numbers)


@compiled
def add_up(b, more):
    for i in range(b.steps):
        b.inner.total[i] += b.factor * b.inner.fixed[i, 1] * (2.0 if b.doubled else 1.0) + more * b.numbers.weight
    return b.numbers.count


@compiled_inline
def total_of(inner):
    return inner.total.sum()


@compiled
def of_a_tuple_within(b):
    return total_of(b.inner)


@compiled
def wrong(b):
    return b.absent


def test_kernels_read_every_kind_of_field_and_write_to_the_same_arrays():
    plain = bundle()
    for_kernels = unboxed(plain)
    assert add_up(for_kernels, 0.0) == 7
    assert plain.inner.total.tolist() == [1.0, 5.0, 9.0]
    plain.inner.total[:] = 0.0
    assert add_up(for_kernels, 2.0) == 7
    assert plain.inner.total.tolist() == [6.0, 10.0, 14.0]


def test_a_record_that_owns_its_memory_is_read_as_well():
    """As one does that another process has sent: what numpy says of its address is that of a copy, gone at once."""
    sent = pickle.loads(pickle.dumps(bundle()))
    assert sent.numbers.flags.owndata
    for_kernels = unboxed(sent)
    others = [np.full(2, -1) for _ in range(1000)]
    assert add_up(for_kernels, 0.0) == 7
    assert len(others) == 1000


def test_a_tuple_within_is_handed_on_as_it_is():
    plain = bundle()
    plain.inner.total[:] = [1.0, 2.0, 4.0]
    assert of_a_tuple_within(unboxed(plain)) == 7.0


def test_a_layout_of_other_than_8_bytes_is_refused():
    class Flags(NamedTuple):
        one: bool
        other: bool

    with pytest.raises(TypeError, match="Flags"):
        unboxed(Flags(True, False))


def test_it_keeps_alive_what_it_points_to():
    one, fixed = unboxed(bundle()), bundle().inner.fixed
    gc.collect()
    others = [np.full_like(fixed, -1.0) for _ in range(100)]  # would take over memory that had been given back
    assert add_up(one, 0.0) == 7
    assert len(others) == 100


def test_the_same_types_are_compiled_once_and_others_again():
    add_up(unboxed(bundle()), 1.0)
    compiled_before = len(add_up.signatures)
    add_up(unboxed(bundle()), 2.0)
    assert len(add_up.signatures) == compiled_before
    add_up(unboxed(bundle(np.float32)), 1.0)
    assert len(add_up.signatures) == compiled_before + 1


def test_a_field_that_is_not_there_is_an_error_at_compile_time():
    with pytest.raises(numba.TypingError, match="absent"):
        wrong(unboxed(bundle()))
