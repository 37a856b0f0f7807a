"""The seed of statistical tests; set HARNESS_TEST_SEED to see that they do not hang on it."""

import os

SEED = int(os.environ.get("HARNESS_TEST_SEED", "20240917"))
