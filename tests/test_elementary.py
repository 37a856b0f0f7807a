"""exp, log, log1p and expm1 are the C library's, and all that decides tests follows from these alone."""

import math
from functools import partial

import numpy as np
import pytest

from harness import elementary
from harness.campaign.files import load_campaign
from harness.families import R157
from harness.pool.build import build_pool
from harness.random_stream import INITIAL, uniforms
from harness.resolved import resolve

NAMES = ("exp", "log", "log1p", "expm1")


def nudged(function, *arguments, **keywords):
    """As a processor's own may: off by one unit in the last place, or not."""
    found = function(*arguments, **keywords)
    x = np.asarray(found, np.float64)
    bump = (x.view(np.int64) >> 5) % 3 - 1
    return np.where(bump == 0, x, np.nextafter(x, np.copysign(math.inf, bump))).astype(x.dtype)[()]


@pytest.mark.parametrize("name", NAMES)
def test_they_are_those_of_the_c_library(name):
    x = np.random.default_rng(1).uniform(1e-3, 20.0, (50, 4))
    found = getattr(elementary, name)(x)
    assert found.tolist() == [[getattr(math, name)(each) for each in row] for row in x.tolist()]
    assert getattr(elementary, name)(1.5) == getattr(math, name)(1.5)


def test_beyond_where_they_are_defined_they_are_as_numpys():
    assert elementary.log([0.0, math.inf]).tolist() == [-math.inf, math.inf]
    assert np.isnan(elementary.log([-1.0, math.nan])).all()
    assert elementary.exp([-math.inf, 800.0]).tolist() == [0.0, math.inf]


def resolved_of(scenario):
    overrides = [f"scenario={scenario}", "testing.method=shells", "world.engine=twin", "pool.relative_error=0.2"]
    return resolve(load_campaign("idm", overrides))


def starts(resolved):
    return resolved.family.start(
        resolved.environment, uniforms(1, 0, 100, INITIAL, resolved.family.n_uniforms)
    ).tobytes()


def pool(resolved):
    """Arrays of a pool but for what BLAS computes, which tells the pool's error."""
    found = vars(build_pool(resolved, "any")).items()
    return {key: of.tobytes() for key, of in found if isinstance(of, np.ndarray) and key != "mu_covariance"}


@pytest.mark.slow
@pytest.mark.parametrize("scenario", R157)
def test_another_processor_makes_the_same_tests(scenario, monkeypatch):
    """Whatever numpy makes of the last digit; were these off by that, tests would be others."""
    here = resolved_of(scenario)
    for name in (*NAMES, "power", "exp2", "log2", "sin", "cos", "tanh"):
        monkeypatch.setattr(np, name, partial(nudged, getattr(np, name)))
    there = resolved_of(scenario)
    found = starts(there), pool(there)
    monkeypatch.undo()
    assert found == (starts(here), pool(here))
    for name in NAMES:
        monkeypatch.setattr(elementary, name, partial(nudged, getattr(elementary, name)))
    assert starts(resolved_of(scenario)) != found[0]
