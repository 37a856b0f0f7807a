"""The study as a user runs it: made once, resumed, refused where it is wrong, and every number of its page traced."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness.campaign.drivers import IDMParameters
from harness.campaign.vehicle import AutomatedVehicle
from harness.estimators.scv import Scv
from harness.estimators.weighted import Nade
from harness.progress import Progress
from harness.vehicles.drivers import av_records
from harness.vehicles.kinematics import CONTACT_M
from studies.__main__ import main
from studies.case_study import small_case, tested
from studies.case_study import study as context
from studies.case_study.counted import KnownMeans, spread
from studies.case_study.figures import exactly, figure, marked, ratio_of_means, ratio_of_variances, verdict
from studies.case_study.repeated import variants_of
from studies.case_study.small_case import AV_MPS, _crashes, small_world
from studies.case_study.steps import step_keys
from studies.case_study.study import Context, Made, SmallCase, load_study
from studies.case_study.theorems import bound
from studies.chains.chain import CHAINS, Episodes
from studies.chains.sampler import with_optimal_function
from tests.chains import SEED
from tests.estimators.small_blocks import blocks, fed
from tests.kernels import smallest_gaps
from tests.stored_runs import SCENARIOS
from tests.studies.here import Here

pytestmark = pytest.mark.slow

SHIPPED = SCENARIOS / "case_study" / "study.yaml"
STUDY = f"""
format: case-study
version: 1
name: small
title: Small
steps:
  nde:
    kind: twin_tests
    campaign: {SCENARIOS}/overtaking_nde.yaml
    set: [environment.lane_change_level=1e4]
    tests: 6_000
  nade:
    kind: run
    campaign: {SCENARIOS}/overtaking_nade.yaml
    set: [environment.lane_change_level=1e4, testing.epsilon=0.9, world.engine=twin, records.traces=none,
          stop.episodes=1_200, run.shard_size=500]
  curves: {{kind: convergence, of: [nde, nade], reference: nade}}
  adjusted: {{kind: control_variates, of: nade, sizes: [700, 1_200, 5_000]}}
  required:
    {{kind: required_tests, of: [nde, nade], shuffles: 4, scv: nade, scv_tests: 600, scv_shuffles: 2, scv_ratio: 4.0}}
  variants:
    kind: variants
    title: Variants
    campaign: {SCENARIOS}/overtaking_nade.yaml
    set: [environment.lane_change_level=1e4, testing.epsilon=0.9]
    tests: 200
    replications: 3
    avs: [alpha-0.5]
    settings: {{same: []}}
    epsilons: [0.1, 0.9]
    reference: nade
    shuffles: 3
    each_of:
      - {{immediate: [], recursive: [testing.challenge=recursive, testing.epsilon=0.1]}}
      - {{step: [], episode: [testing.method=episode_mixture]}}
  theorems: {{kind: theorems, draws: 3, tests: 200}}
quick:
  nde: {{tests: 2_000}}
picture: {{NDE: {{ours: required.nde, paper: 1e5}}, NADE: {{ours: nade.tests_for_rhw}}}}
claims:
  - {{says: "a | bound", where: V-B, paper: 1, ours: theorems.variance_over_bound, at_most: true}}
  - {{says: wrong, where: nowhere, paper: 123.0, ours: theorems.best_over_plain, why: it was made up}}
"""


def written(folder: Path) -> dict[str, tuple[int, bytes]]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    file = tmp_path_factory.mktemp("study") / "study.yaml"
    file.write_text(STUDY)
    folder = file.parent / "out"
    assert main(["case", str(file), "--out", str(folder), "--workers", "1"]) == 0
    return file, folder


@pytest.fixture(scope="module")
def made(study):
    file, folder = study
    keys = step_keys(load_study(file))
    return {
        name: Made(place := folder / "steps" / f"{name}-{key}", json.loads((place / "result.json").read_text()))
        for name, key in keys.items()
    }


def test_a_second_run_changes_nothing(study, capsys):
    file, folder = study
    before = written(folder)
    assert main(["case", str(file), "--out", str(folder), "--workers", "2"]) == 0
    assert written(folder) == before
    assert capsys.readouterr().out.count("there already") == 7


def test_a_change_makes_only_what_depends_on_it(study):
    file, _ = study
    other = file.with_name("other.yaml")
    other.write_text(STUDY.replace("stop.episodes=1_200", "stop.episodes=1_300"))
    keys, changed = step_keys(load_study(file)), step_keys(load_study(other))
    of_nade = {"nade", "curves", "adjusted", "required", "variants"}
    assert {name for name in keys if keys[name] != changed[name]} == of_nade
    quick = step_keys(load_study(file, quick=True))
    assert {name for name in keys if keys[name] != quick[name]} == {"nde", "curves", "required"}


def test_claims_say_where_they_are_from_and_are_judged(study, made):
    _, folder = study
    right, wrong = json.loads((folder / "claims.json").read_text())["claims"]
    assert right["found"] == made["theorems"].result["figures"]["variance_over_bound"]
    assert (right["verdict"], right["why"]) == ("reproduced", "")
    assert (wrong["verdict"], wrong["why"]) == ("not reproduced", "it was made up")
    page = (folder / "case_study.md").read_text()
    assert r"a \| bound" in page
    assert "- 2: it was made up" in page
    pictures = {path.stem for path in (folder / "plots").iterdir() if path.read_bytes().startswith(b"\x89PNG")}
    assert pictures == {"tests", "curves", "adjusted", "adjusted_growth", "adjusted_results", "variants"}
    assert all(f"](plots/{name}.png)" in page for name in pictures)


def test_steps_agree_with_the_run_that_they_keep(made):
    nade = made["nade"]
    estimates = json.loads((nade.folder / "run" / "estimates.json").read_text())["estimates"]["nade"]
    assert nade.result["figures"]["crash_rate"]["value"] == pytest.approx(estimates["crash_rate"], rel=1e-12)
    assert nade.result["figures"]["crashes"]["value"] == estimates["n_crashes"]
    rows = made["adjusted"].result["sizes"]
    assert [row["n"] for row in rows] == [700, 1_200]
    assert rows[-1]["nade_rate"]["value"] == pytest.approx(estimates["crash_rate"], rel=1e-12)
    assert all(row["difference"] < 1e-12 and row["gain_claimed"] >= 1.0 for row in made["adjusted"].result["looks"])
    assert sum(row["n"] for row in made["adjusted"].result["strata"]) == 1_200
    curves = pq.read_table(made["curves"].folder / "curves.parquet").to_pandas()
    last = curves[curves["step"] == "nade"].iloc[-1]
    assert last["n"] == 1_200
    assert last["crash_rate"] == pytest.approx(estimates["crash_rate"], rel=1e-12)
    assert last["half_width"] == pytest.approx(1.6448536 * estimates["std_error"], rel=1e-6)


def test_the_theorems_hold_on_exact_chains(made):
    figures = made["theorems"].result["figures"]
    most = {"largest_bias": 1e-10, "variance_over_bound": 1.0, "best_over_plain": 1.0 + 1e-9,
            "largest_error_known": 1e-12, "claimed_error_estimated": 1e-12}  # fmt: skip
    assert all(figures[name]["value"] <= limit for name, limit in most.items())
    assert figures["scatter_estimated"]["value"] > 0.01
    assert figures["variance_over_bound"]["value"] == pytest.approx(0.012246779639791351, rel=1e-9)


def test_the_bound_of_theorem_2_by_hand():
    """Two equal weights. Of l = 1: μ = 1/4, least variance 7/96, at weight 1/2; of l = 2: μ = 1/8, 49/512, at 1/4."""
    p, steps, crash = np.array([[0.375, 0, 0], [0.125, 0, 1], [0.25, 1, 1], [0.125, 1, 0], [0.125, 2, 1]]).T
    ratios = np.ones((5, 2, 2))
    ratios[2, 0], ratios[3, 0] = (1.5, 0.5), (0.5, 1.5)
    unused = np.zeros_like(ratios)  # what surrogates predict
    episodes = Episodes(p, ratios, unused, unused, steps.astype(int), np.ones(5), crash.astype(bool))
    uncontrolled = 0.125 * 0.875
    first = 2 * min(0.375 * (1 / 1.5 - 0.25) ** 2 + 0.0625 / 16, 0.125 * 1.75**2 + 0.1875 / 16) + 3 * (0.25 * 2) ** 2
    second = 4 * 0.125 * 0.875**2 + 3 * (0.125 * 4) ** 2
    assert bound(episodes) == pytest.approx(3 * (uncontrolled + first + second), rel=1e-12)


def test_the_shipped_study_is_right_and_its_claims_ask_for_what_there_is():
    for quick in (False, True):
        study = load_study(SHIPPED, quick=quick)
        assert set(step_keys(study)) == set(study.steps)
        variants = [step for step in study.steps.values() if step.kind == "variants"]
        assert quick or all(set(step.shown) <= set(variants_of(step)) for step in variants)
    assert len(study.claims) >= 15


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (figure(10.0, 6.0, 19.0), "reproduced"),
        (figure(10.0, 4.0, 19.0), "cannot be told"),
        (figure(30.0, 21.0), "not reproduced"),
        (figure(10.0), "cannot be told"),
        (figure(None, 21.0), "not reproduced"),
        (exactly(20.0), "reproduced"),
        (marked(exactly(20.1), settled=False), "cannot be told"),
    ],
)
def test_a_verdict_is_of_the_whole_interval(found, expected):
    assert verdict(10.0, found, within=2.0, tolerance=None, at_most=False) == expected


def test_ratios_of_paired_repetitions():
    assert ratio_of_means([2.0, 4.0], [1.0, 2.0], 0.9) == exactly(2.0)
    found = ratio_of_means([2.0, 4.0, 6.0], [2.0, 2.0, 2.0], 0.9)
    assert found["low"] < found["value"] == 2.0 < found["high"]
    assert found["low"] * found["high"] == pytest.approx(4.0)
    assert ratio_of_means([2.0], [1.0], 0.9) == figure(2.0)
    assert ratio_of_means([np.nan], [1.0], 0.9) == figure(None)
    rates = [1.0, 2.0, 4.0]
    assert ratio_of_variances(rates, rates, 0.9) == exactly(1.0)
    assert ratio_of_variances(rates, [1.0, 1.0, 1.0], 0.9) == figure(None)


def test_the_spread_after_adjustment_is_what_algorithm_1_claims():
    (block,) = blocks(CHAINS["decisive"], "step_mixture", [2_000], 1)
    found, scv = spread(block).to_pandas(), Scv()
    scv.add(block)
    for level, fit in scv.fits():
        z = found[found.control_steps == level].z.to_numpy()
        squares = np.sum((z - fit.intercept) ** 2) + (fit.n - len(z)) * fit.intercept**2
        assert squares == pytest.approx(fit.residual_squares, rel=1e-9, abs=1e-20)


def test_known_means_gain_what_theorem_3_promises():
    """In the theorem's world nothing is left of the variance of tests that the fit has not seen."""
    world, rng, scv = with_optimal_function(), np.random.default_rng(1), Scv()
    scv.add(world.block("step_mixture", world.maneuvers(2_000, rng)))
    known = KnownMeans(scv)
    for _ in range(5):
        known.add(world.block("step_mixture", world.maneuvers(500, rng)))
    assert known.row(0.9)["gain_known"]["value"] > 1e6


def test_relative_variance_of_known_weights():
    """Every tenth test crashes with weight 1 or 3 in turn: ΣY = 2 n/10, ΣY² = 5 n/10."""
    n = 4_000
    episode = np.arange(0, n, 10)
    weight = np.where(episode % 20 == 0, 1.0, 3.0)
    tests = tested.Tests(n, float(n), episode, weight)
    found = tested.relative_variance(tests)
    assert found["value"] == pytest.approx(0.5 / 0.2**2 - 1.0, rel=1e-12)
    assert found["low"] == pytest.approx(found["value"], rel=1e-9)
    assert tested.crash_rate(tests, 0.9)["value"] == pytest.approx(0.2)


# -- the smaller case --


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
