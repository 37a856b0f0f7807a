"""Parts of kernels, for tests to call by themselves."""

import numba


def alone(part):
    """What is made to be inlined into kernels (`harness.compiled.compiled_inline`), compiled as they are.

    Not cached: under its name stands what kernels inline, which cannot be called.
    """
    return numba.njit(part, error_model="numpy", _nrt=False)
