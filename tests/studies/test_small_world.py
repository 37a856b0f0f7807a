"""The smaller case: backward induction against all paths and against drawn tests; identities; a wrong sibling fails."""

import numpy as np
import pytest

from harness.campaign.drivers import IDMParameters
from harness.campaign.vehicle import AutomatedVehicle
from harness.estimators.weighted import Nade
from harness.progress import Progress
from harness.vehicles.drivers import av_records
from harness.vehicles.kinematics import CONTACT_M
from studies.case_study import small_case
from studies.case_study import study as context
from studies.case_study.small_case import AV_MPS, _crashes, small_world
from studies.case_study.study import Context, SmallCase
from tests.chains.seed import SEED
from tests.estimators.small_blocks import fed
from tests.kernels import smallest_gaps
from tests.studies.here import Here

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def world():
    return small_world(1e4)


def test_backward_induction_is_the_sum_over_all_courses(world):
    """Forwards: the probability to reach each step of a course, times that of a cut-in there which ends in a crash."""
    stayed = np.cumprod(np.concatenate([np.ones_like(world.p[:1]), 1.0 - world.p[:-1]]), axis=0)
    total = np.sum(world.first[:, :, None] * world.second * stayed * world.p * world.crash)
    assert total == pytest.approx(world.crash_rate, rel=1e-12)


@pytest.mark.parametrize(("recursive", "epsilon"), [(True, 0.1), (False, 0.9)])
def test_drawn_tests_meet_rate_and_variance(world, recursive, epsilon):
    """Within four standard errors; forgetting the weights, the sibling, is seen."""
    proposals = world.proposals(epsilon, recursive=recursive)
    block = world.draw(proposals, 60_000, np.random.default_rng(SEED))
    found, weights = fed(Nade(), [block]).result(0.9), block.weights()
    assert abs(found.crash_rate - world.crash_rate) < 4.0 * found.std_error
    relvar = len(block) * (found.std_error / world.crash_rate) ** 2
    assert relvar == pytest.approx(world.relvar(proposals), rel=0.2)
    assert abs(weights.mean() - 1.0) < 4.0 * weights.std() / np.sqrt(len(block))
    assert abs(block.crash.mean() - world.crash_rate) > 4.0 * found.std_error


def test_the_case_is_answered(world, tmp_path, monkeypatch):
    monkeypatch.setattr(small_case, "_world", lambda level: world)
    monkeypatch.setattr(context, "worker_processes", lambda workers: Here())
    sizes = {"epsilons": [0.8], "thresholds": [0.0, 4.5e-4], "tests": 2_000, "draws": 3}
    step = SmallCase(kind="small_case", lane_change_level=1e4, **sizes, reported={"nade": 385.0, "scv": 12.0})
    found = small_case.answer_small_case(step, Context(tmp_path, 0.3, 0.9, {}, 1, Progress()))
    settings = [(challenge, threshold) for challenge in ("immediate", "recursive") for threshold in (0.0, 4.5e-4)]
    assert [(row["challenge"], row["threshold"]) for row in found["settings"]] == settings
    exact = world.relvar(world.proposals(0.8, recursive=False)) * (1.6448536 / 0.1) ** 2
    assert found["settings"][0]["nade_exact"] == pytest.approx(exact, rel=1e-6)
    assert found["figures"]["nade_range"]["value"] == found["settings"][0]["nade_exact"]  # nearest of all
    every = [row["nade_exact"] for row in found["settings"]]
    assert [found["figures"]["nade_range"][key] for key in ("low", "high")] == [min(every), max(every)]
    assert found["settings"][0]["difference"] < 1e-12
    assert [small_case.holds(*each) for each in ((56.0, 57.0), (82.7, 25_929.0), (None, 57.0))] == [True, False, False]


def test_who_runs_into_bv_is_as_the_model_says():
    """The default IDM behind a BV at 8 m/s, whose motion is tested in tests/vehicles, from gaps around the edge."""
    gaps = np.array([0.5, 2.0, 3.0, 3.5, 4.0, 4.9])
    found = _crashes([av_records(AutomatedVehicle())], np.full(6, 8.0), gaps, 80)[:, 0]
    assert found.tolist() == (smallest_gaps(IDMParameters(), AV_MPS, 8.0, gaps, steps=80) < CONTACT_M).tolist()
    assert 0.0 < found.mean() < 1.0
