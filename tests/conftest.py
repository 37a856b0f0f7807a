"""Settings that all tests share: property tests neither hang on the clock nor on chance, nor leave a database behind.

With ``HARNESS_TEST_SEED`` set, Hypothesis looks elsewhere on every run, as the statistical tests do with that seed.
"""

import os

from hypothesis import HealthCheck, settings

settings.register_profile(
    "harness",
    deadline=None,
    derandomize="HARNESS_TEST_SEED" not in os.environ,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],  # the first example may compile kernels
)
settings.load_profile("harness")
