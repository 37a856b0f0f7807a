"""Enumerated cut-ins are what episodes would be: same motion, same crashes, probabilities that add up."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chisquare

from harness.campaign.sections import PoolSettings
from harness.pool.library import load_library
from harness.pool.shells import design_shells
from harness.pool.walk import STRIDE, Enumerator
from harness.progress import Progress
from harness.traffic.initial_state import InitialStates
from harness.vocabulary import CRASH
from tests.chains.seed import SEED
from tests.pool.walked import driven, enumerated, p_cut_in_of_paths

LIBRARY = load_library("ladder-1")
NAMES = list(LIBRARY.surrogates)
ENVELOPE = NAMES.index(LIBRARY.envelope)


def test_a_slower_vehicle_is_no_envelope(environment):
    """The sibling that must fail: with a vehicle at constant speed as envelope, crashes would be missed."""
    _, crashes = enumerated(LIBRARY, environment, 150, enclosed=False)
    constant = NAMES.index("never-brakes")
    assert np.any(((crashes >> constant) & 1 == 0) & (crashes != 0))


@pytest.mark.parametrize("surrogate", NAMES)
def test_a_prescribed_episode_ends_as_the_pool_says(campaign, pool, surrogate):
    """LV's and BV's paths, the cut-in and the surrogate's answer, driven by the episode loop instead of the pool."""
    rows, episode, log_p = driven(campaign, pool, LIBRARY, surrogate)
    assert np.array_equal(episode["outcome"] == CRASH, pool.cut_ins.crashes[rows, pool.names.index(surrogate)])
    assert np.array_equal(episode["cut_in_step"], pool.cut_ins.step[rows])
    assert np.allclose(episode["log_weight"], log_p, rtol=1e-15)


def test_the_probabilities_of_a_path_add_up_to_that_of_a_cut_in(environment):
    """Against an independent walk of the same path: 1 - exp(-hazard)."""
    probability, _ = enumerated(LIBRARY, environment, 40)
    expected = p_cut_in_of_paths(SEED, InitialStates(environment.numbers).draw(SEED, 0, 40), environment)
    assert np.allclose(probability.sum(1), expected, rtol=1e-12, atol=0.0)


def test_a_stride_asks_the_same_cut_ins_and_each_stands_for_as_many(environment):
    """Over all offsets every cut-in is asked once, with the same answer, so that any sum has the same mean."""
    probability, crashes = enumerated(LIBRARY, environment, 40)
    strided = [enumerated(LIBRARY, environment, 40, stride=STRIDE, offset=offset) for offset in range(STRIDE)]
    assert np.array_equal(np.sum([p for p, _ in strided], axis=0), STRIDE * probability)
    assert np.array_equal(np.sum([c for _, c in strided], axis=0), crashes)
    assert np.max([p > 0.0 for p, _ in strided], axis=0).sum() > 1000


def test_blocks_use_every_offset_about_equally(environment):
    paths = Enumerator(environment, LIBRARY.followers_in(environment), 5).run(0, 2048, Progress())
    asked = paths.mass > 0.0
    offsets = [np.flatnonzero(row) % STRIDE for row in asked if row.any()]
    assert all(np.unique(found).size == 1 for found in offsets)
    counts = np.bincount([found[0] for found in offsets], minlength=STRIDE)
    assert chisquare(counts).pvalue > 1e-3  # seed fixed; another one would fail it once in a thousand


def test_the_number_of_cores_changes_no_bit(environment, monkeypatch):
    enumerator = Enumerator(environment, LIBRARY.followers_in(environment), PoolSettings().seed)
    many = enumerator.run(0, 512, Progress())
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    one = enumerator.run(0, 512, Progress())
    assert np.array_equal(many.mass, one.mass)
    assert np.array_equal(many.crashes, one.crashes)


def test_strata_of_a_vehicle_that_may_accelerate_harder_include_what_the_envelope_survives(pool):
    within = design_shells(pool, limit_mps2=2.0)
    beyond = design_shells(pool, limit_mps2=2.5)
    assert within.p_impossible == pytest.approx(pool.shell_p[-1])
    assert beyond.p_impossible == pytest.approx(0.0, abs=1e-17)
    assert beyond.p[-1] == pytest.approx(within.p[-1] + pool.shell_p[-1])
