"""Estimators on the exact Markov chains of `studies.chains`.

The seed of statistical tests: set HARNESS_TEST_SEED to see that they do not depend on it.
"""

import os

SEED = int(os.environ.get("HARNESS_TEST_SEED", "20240917"))
