"""Ways of drawing lead braking and cut-outs agree, and what does not go together with them is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

import harness
from harness.campaign.drivers import Reaction
from harness.campaign.files import load_campaign
from harness.errors import CampaignError
from harness.resolved import resolve
from harness.sampling import prepare
from harness.vocabulary import CRASH
from harness.worlds.twin import TwinWorld
from tests.families.test_same_bits import LADDERS, SMALL, resolved_of, run, source_of
from tests.in_process import run_here
from tests.kernels import steps_late

OFTEN = {"lead_brakes": "brakes-2-late-1s", "cut_out": "never-brakes"}
"""Drivers who crash in some hundredths, and some thousandths, of all tests without a choice of events."""


def campaign_of(name: str, method: str, *more: str):
    who = LADDERS[name].surrogates[OFTEN[name]]
    av = f"av={json.dumps(who.model_dump())}"
    small = (*SMALL, f"testing.method={method}", "world.engine=twin", "records.traces=none", "run.shard_size=1000")
    return load_campaign("idm", [f"scenario={name}", av, *small, *more])


@pytest.mark.parametrize("name", LADDERS)
@pytest.mark.slow
def test_naturalistic_forced_and_shells_have_the_rate_of_the_pool(name, tmp_path):
    """Within four standard errors of both; a false alarm in 16,000."""
    pool, n = source_of(name).pool, 4000
    place = pool.names.index(OFTEN[name])
    rate, rate_se = pool.mu[place], np.sqrt(pool.mu_covariance[place, place])
    stop, share = f"stop={{episodes: {n}, rhw: null}}", {"forced": 1.0, "nde": pool.p_event}
    for method in ("nde", "forced"):
        run_here(campaign_of(name, method, stop), out := tmp_path / method)
        tests = harness.read(out).episodes()
        weighed = np.where(tests["outcome"] == "crash", np.exp(tests["log_weight"]), 0.0)
        assert abs(weighed.mean() - rate) < 4.0 * np.hypot(rate_se, weighed.std() / np.sqrt(n))
        happened = tests["event"] >= 0
        assert np.array_equal(happened, tests["event_step"].notna())
        spread = np.sqrt(share[method] * (1.0 - min(share[method], 1.0)) / n) + pool.p_event_se
        assert abs(happened.mean() - share[method]) < 4.0 * spread + 1e-12
        assert set(tests["outcome"]) <= {"crash", "timeout"}
    run_here(campaign_of(name, "shells", "stop.rhw=0.2"), out := tmp_path / "shells")
    found = json.loads((out / "estimates.json").read_text())["estimates"]["shells"]
    half = 0.5 * (found["ci_high"] - found["ci_low"])
    assert abs(found["crash_rate"] - rate) < 3.0 * half


@pytest.mark.parametrize("name", LADDERS)
def test_an_inattentive_driver_is_an_attentive_one_or_a_late_one(name):
    """C3: test by test, so that its rate is (1 - q) times the one's and q times the other's."""
    kinds = {"attentive": {}, "late": {"delay_s": 2.5}}
    q = {"inattention_probability": 0.4, "inattention_delay_s": 2.5}
    crashed = {}
    for kind, reaction in {**kinds, "both": q}.items():
        av = f"av={json.dumps({'model': 'idm', 'parameters': {'time_headway_s': 0.6}, 'reaction': reaction})}"
        resolved, source = resolved_of(name, None, av), source_of(name)
        rows = np.linspace(0, len(source.pool.events.at) - 1, 400).astype(np.int64)
        traffic = source.prescribed.of_rows(rows, np.zeros(len(rows), np.int64))
        crashed[kind] = run(TwinWorld, resolved, traffic).episode["outcome"] == CRASH
    late = steps_late(Reaction(**q), len(rows), seed=1) > 0
    assert 0.3 < late.mean() < 0.5
    assert np.array_equal(crashed["both"], np.where(late, crashed["late"], crashed["attentive"]))
    assert (crashed["late"] != crashed["attentive"]).sum() > 20


CONTROLLER = "examples.idm:IDM"
REFUSED = {
    "testing.method=step_mixture": r"testing\.method.*importance functions are those of cut-ins",
    f"av={{controller: '{CONTROLLER}', before_event: controller}}": r"av\.before_event.*means nothing there",
    "av={model: r157-fsm}": r"av\.model.*has not been tried",
    "environment.lane_change_level=2": "environment.*numbers of cut-ins",
    "pool.library=ladder-2": r"pool\.library, r157-fsm",
    "environment.parameters=ndd-overtaking-2": r"environment\.parameters",
    "scenario=lead_break": "Did you mean 'lead_brakes'",
}


@pytest.mark.parametrize("name", LADDERS)
@pytest.mark.parametrize("asked", REFUSED)
def test_what_does_not_go_together_is_refused_with_one_error(name, asked):
    with pytest.raises(CampaignError, match=REFUSED[asked]) as caught:
        prepare(resolve(load_campaign("idm", [f"scenario={name}", "stop.rhw=null", asked])))
    assert str(caught.value).count("expected") == 1


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("av={model: r157-cc, parameters: {time_headway_s: natural}}", r"av\.parameters\.time_headway_s"),
        ("pool.library=ladder-lead-1", "pool.library, r157-cc.*a natural headway"),
    ],
)
def test_headways_that_people_keep_are_those_of_vehicles_that_follow(asked, words):
    with pytest.raises(CampaignError, match=words) as caught:
        prepare(resolve(load_campaign("idm", [asked, "scenario=cut_in"])))
    assert str(caught.value).count("expected") == 1
