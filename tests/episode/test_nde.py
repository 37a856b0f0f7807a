"""Plain episodes: BV keeps off LV, nothing fails, and every end is one of those that were agreed on."""

import numpy as np
import pytest

from harness.vocabulary import BV_LV_CONTACT, CRASH, FAILED, PASSED, TIMEOUT
from tests.episode.twin_runs import run


@pytest.mark.parametrize("settings", [{"n": 100_000}, {"n": 50_000, "hold_s": 0.1}], ids=["1.0 s", "0.1 s"])
def test_how_episodes_end(settings):
    done = run("nde", level=1e6, **settings)
    outcome, steps = done.episode["outcome"], done.episode["n_steps"]
    assert not (outcome == FAILED).any()
    assert steps.min() > 0
    assert steps.max() == 200
    assert (steps[outcome == TIMEOUT] == 200).all()
    assert (outcome == BV_LV_CONTACT).mean() < 1e-4
    assert done.cut_in[outcome == CRASH].all()
    assert not done.cut_in[outcome == PASSED].any()
    assert not done.cut_in[outcome == BV_LV_CONTACT].any()
    # Speeds are those at the end of the step: an AV that brakes may graze BV and already be the slower one.
    assert (done.episode["impact_speed_mps"][outcome == CRASH] > -0.6).all()
    assert (done.episode["impact_speed_mps"][outcome == CRASH] > 0.0).mean() > 0.99
    assert np.isnan(done.episode["impact_speed_mps"][outcome != CRASH]).all()
    assert (done.episode["cut_in_r2_m"][done.cut_in] > 0.0).all()
    assert {CRASH, PASSED, TIMEOUT} <= set(outcome.tolist())
