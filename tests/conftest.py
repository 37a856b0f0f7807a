"""Settings that all tests share: property tests neither hang on the clock nor on chance, nor leave a database behind.

With ``HARNESS_TEST_SEED`` set, Hypothesis looks elsewhere on every run, as the statistical tests do with that seed.
"""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "harness",
    deadline=None,
    derandomize="HARNESS_TEST_SEED" not in os.environ,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],  # the first example may compile kernels
)
settings.load_profile("harness")


@pytest.fixture(scope="session")
def fmu(tmp_path_factory):
    """The IDM of the examples as an FMU."""
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu builds the FMU")
    examples = Path(__file__).parents[1] / "examples"
    folder = tmp_path_factory.mktemp("fmu")
    return builder.FmuBuilder.build_FMU(examples / "idm_fmu.py", dest=folder, project_files=[examples / "idm.py"])
