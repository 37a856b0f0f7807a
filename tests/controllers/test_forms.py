"""The intelligent driver model gives the same motion in whatever form it is plugged in."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest

from examples.idm import IDM
from harness.controllers.hosts import BatchHost, Guard
from harness.controllers.protocol import Observation
from harness.errors import CampaignError
from harness.vocabulary import PASSED
from tests.worlds.running import LATERAL, drive, fmu_av, forced, motion

FORMS = {
    "per vehicle": "av={controller: 'examples.idm:IDM'}",
    "batch": "av={controller: 'examples.idm_batch:IDM'}",
    "TraCI-style": "av={controller: 'examples.idm_traci_style:IDM'}",
    "step listener": "av={controller: 'examples.idm_traci_style:Listener'}",
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("cells", [32, 7])
def test_every_form_gives_the_bits_of_the_built_in_model_in_any_number_of_cells(form, cells):
    assert motion(FORMS[form], cells=cells) == motion("av={model: idm}")


def test_over_arrays_it_knows_too_what_to_do_while_nobody_is_ahead():
    """Where cut-ins take time, controllers act from the onset on: then the gap is infinite and the speed ahead NaN."""
    assert motion(FORMS["batch"], LATERAL, n=30) == motion(FORMS["per vehicle"], LATERAL, n=30)


def test_an_fmu_gives_the_same_motion_and_gets_its_start_values_in_every_episode(fmu):
    built_in = drive("av={model: idm}")
    other = drive(f"av={fmu_av(fmu)}")
    assert other.failures == {}
    for i in built_in.traces:
        np.testing.assert_allclose(other.traces[i], built_in.traces[i], rtol=0, atol=1e-9)
    weaker = drive(f"av={fmu_av(fmu)}", "av.fmu.start_values={a_min: -1.5}")
    braking = [min(run.traces[i][:-1, 2, 2].min() for i in built_in.traces) for run in (weaker, built_in)]
    assert braking[0] == -1.5 > braking[1]


# -- what is seen of a BV that comes over --


HERE = "tests.controllers.test_forms"
SEEN: list[Observation] = []
"""What `Notes` has seen: of this module as the campaign imports it, which is another one than pytest's."""


def episodes(*overrides: str) -> np.ndarray:
    shard = drive(*overrides, n=400)
    assert shard.failures == {}
    return shard.results.episode


class Notes(IDM):
    """Keeps its speed and writes down what it sees."""

    def step(self, seen):
        SEEN.append(seen)
        return 0.0


@pytest.fixture(scope="module")
def built_in():
    return episodes(LATERAL)


def test_a_controller_that_sees_it_is_the_built_in_model_to_the_last_bit(built_in):
    yields = episodes(LATERAL, "av={controller: 'examples.sees_lateral:Yields'}")
    assert yields.tobytes() == built_in.tobytes()


def test_one_that_waits_for_the_overlap_is_another_vehicle(built_in):
    """The sibling that must fail; it is the built-in model that is blind until then."""
    waits = episodes(LATERAL, "av={controller: 'examples.sees_lateral:Yields', parameters: {perceives_m: 2.0}}")
    assert waits.tobytes() != built_in.tobytes()
    blind = episodes(LATERAL, "av.reaction.perceives_lateral_m=2.0")
    assert waits.tobytes() == blind.tobytes()


@pytest.mark.parametrize("lead_s", [0.0, 1.0])
def test_what_is_seen_of_a_lead(lead_s):
    SEEN = importlib.import_module(HERE).SEEN  # noqa: N806 - the other one
    SEEN.clear()
    episodes(f"environment.cut_in_lead_s={lead_s}", f"av={{controller: '{HERE}:Notes', warm_up_s: 0}}", "world.cells=1")
    assert len(SEEN) > 10_000
    assert all(seen.bv_overlaps == (seen.bv.lane == 0) == math.isfinite(seen.gap_m) for seen in SEEN)
    assert all((seen.bv_lateral_m == 1.7) and (seen.bv_lateral_speed_mps == 0.0) for seen in SEEN if seen.bv_overlaps)
    assert {seen.bv_lateral_speed_mps for seen in SEEN if not seen.bv_overlaps} == ({1.7} if lead_s else set())


# -- one that acts from the start meets the methods that do not need to know the AV's speed --


EARLY = "av={controller: 'tests.controllers.test_forms:Faster', before_cut_in: controller}"


class Faster(IDM):
    """Accelerates until someone is ahead, and remembers nothing but its steps."""

    def start(self, episode):
        self.steps = 0

    def step(self, seen):
        assert seen.time_s == pytest.approx(0.1 * self.steps)
        self.steps += 1
        ahead = np.isfinite(seen.gap_m)
        assert ahead == (seen.bv.lane == 0)
        assert ahead or np.isnan(seen.lead_speed_mps)
        return -3.0 if ahead else 0.5


@pytest.mark.parametrize("method", ["nde", "step_mixture"])
def test_a_controller_acts_from_the_first_step(method):
    shard = drive(EARLY, f"testing={{method: {method}}}", "environment.lane_change_level=350", n=300)
    assert shard.failures == {}
    passed = cut_in = 0
    for i, row in enumerate(shard.results.episode):
        trace, cut = shard.traces[i], row["cut_in_step"]
        np.testing.assert_array_equal(trace[: cut if cut >= 0 else -1, 2, 2], 0.5)
        cut_in += cut > 0
        if row["outcome"] == PASSED:
            r2 = trace[:, 1, 0] - 5.0 - trace[:, 2, 0]
            assert r2[-1] < -10.0 <= r2[-2]
            passed += 1
    assert min(passed, cut_in) > 0


def test_a_method_that_draws_the_path_ahead_refuses_it():
    with pytest.raises(CampaignError, match=r"draws the cut-in.*shells \(or forced\)"):
        forced(EARLY, "testing={method: episode_mixture}")


def test_tests_of_one_baseline_run_that_begin_together_have_streams_of_their_own():
    """Both are told the same index: the second was given the rest of the first one's numbers, and its test failed."""
    seen = []

    class Draws:
        def start_batch(self, cells, episodes, random):
            seen.extend(stream.uniform(size=4) for stream in random)

        def step_batch(self, observation): ...
        def close(self): ...

    av = forced(EARLY).av
    host = BatchHost(Draws(), av, 7, Guard(av.limits, None))
    assert host.start(np.arange(3), np.arange(3), np.array([3, 5, 3])) == {}
    host.close()
    np.testing.assert_array_equal(seen[0], seen[2])
    assert not np.any(seen[0] == seen[1])
