"""Means of weights and ratios: right where they are known, never more than a diagnostic."""

import numpy as np
import pytest

from harness.estimators.one_pass import Diagnostics
from harness.vocabulary import BV_LV_CONTACT
from studies.chains.chain import overtaking
from studies.chains.sampler import blocks
from tests.chains.seed import SEED

from .small_blocks import block, fed

CHAIN = overtaking("short", skill=0.5, surrogates=[0.5, 0.2], level=0.02, horizon=5)


def test_means_are_those_of_numpy():
    parts = list(blocks(CHAIN, "episode_mixture", [3_000, 2_000], SEED))
    result = fed(Diagnostics(), parts).result(("forced", "one", "two"))
    weights = np.concatenate([part.weights() for part in parts])
    cut_in = np.concatenate([part.cut_in for part in parts])
    ratios = np.concatenate([part.mixture_ratios() for part in parts])
    for found, values in (
        (result["mean_weight"], weights),
        (result["mean_weight_cut_in"], weights * cut_in),
        (result["mean_ratio"]["forced"], ratios[:, 0]),
        (result["mean_ratio"]["two"], ratios[:, 2]),
    ):
        assert found["mean"] == pytest.approx(values.mean(), rel=1e-12)
        assert found["std_error"] == pytest.approx(values.std(ddof=1) / np.sqrt(5_000), rel=1e-9)
    assert result["n_cut_ins"] == cut_in.sum()


def test_a_small_mean_weight_of_the_step_mixture_is_explained_not_failed():
    careless = fed(Diagnostics(), [block([False] * 10, [-5.0] * 10)]).result()
    assert "still missing" in careless["heavy_tail"]
    assert "never tests" in careless["note"]
    assert "heavy_tail" not in fed(Diagnostics(), [block([False] * 10)]).result()
    assert "heavy_tail" not in fed(Diagnostics(), [block([False] * 10, [-5.0] * 10, method="forced")]).result()


def test_contacts_are_weighted_and_failures_counted():
    base = block([False] * 4, [-1.0, 0.0, 0.0, 0.0], failed=[False, True, False, False])
    result = fed(Diagnostics(), [base.ending(np.array([True, False, False, False]), BV_LV_CONTACT)]).result()
    assert result["bv_lv_contact_share"]["mean"] == pytest.approx(np.exp(-1.0) / 4)
    assert (result["n_failed"], result["n_bv_lv_contacts"]) == (1, 1)


def test_weights_that_overflow_do_not_stop_the_estimate():
    result = fed(Diagnostics(), [block([False, False], [800.0, 0.0])]).result()
    assert result["mean_weight"]["mean"] == np.inf
