"""How a campaign ends: where it stops, what it says then, what workers that fail leave, and going on from there."""

from __future__ import annotations

import errno
import os
import pickle
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from harness import estimate
from harness.campaign.files import load_campaign
from harness.cli import main
from harness.errors import (
    EXIT_BUDGET_SPENT,
    EXIT_DONE,
    EXIT_TOO_MANY_FAILED,
    CampaignError,
    RunFolderError,
    WorldDisagreementError,
)
from harness.processes import fit_to_travel
from harness.progress import Progress
from harness.resolved import resolve
from harness.runner import workers
from harness.runner.stored import write_report
from harness.runner.workers import WorkerLostError
from harness.sampling.protocol import ShardRequest
from tests.in_process import one_process, run_here, run_with_workers, workers_alive
from tests.runner import bad_workers
from tests.runner.conftest import MIXTURE_FILE, SHELLS, SMALL, TWIN, campaign
from tests.stored_runs import answer_in, copy_of, estimates, manifest, part_files, sets, unlike_columns

LOOSE, TIGHT = "stop.rhw=0.3", "stop.rhw=0.15"
COMMON = (
    *("world.engine=twin", "stop.episodes=4000", "stop.min_crashes=20", "run.shard_size=50", "testing.method=forced"),
    "av={model: fvdm}",  # crashes often: the largest weight is a hundred times the rate
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folders of the same campaign, run afresh to either precision."""
    folder = tmp_path_factory.mktemp("stop")
    for name, rhw in (("loose", LOOSE), ("tight", TIGHT)):
        result = run_here(campaign(*COMMON, rhw), folder / name)
        assert (result.exit_code, result.stopped_by) == (EXIT_DONE, "rhw")
        assert estimates(folder / name)["estimates"]["nade"]["rhw"] <= float(rhw.split("=")[1])
        assert manifest(folder / name)["n_episodes"] < 4000
    return folder


class Bar(Progress):
    """Where the bar of tests begins and ends."""

    def stage(self, name, total, *, done=0):
        if name == "tests":
            self.begin = self.end = done

    def advance(self, n, **counts):
        self.end += n


def test_a_run_resumed_to_a_smaller_rhw_extends_the_same_records(runs, tmp_path):
    out, bar = copy_of(runs / "loose", tmp_path / "run"), Bar()
    before = {path: path.stat().st_mtime_ns for path in part_files(out)[:-1]}  # to the last one tests are added
    run_here(campaign(*COMMON, TIGHT), out, resume=True, progress=bar)
    assert (bar.begin, bar.end) == tuple(manifest(runs / name)["n_episodes"] for name in ("loose", "tight"))
    assert {path: path.stat().st_mtime_ns for path in before} == before, "finished shards are not written again"
    assert unlike_columns(runs / "tight", out) == []


class Interrupted(Progress):
    """As soon as a test would be driven."""

    def stage(self, name, _total, **_done):
        if name == "tests":
            raise KeyboardInterrupt


def test_what_was_interrupted_before_any_test_begins_anew(tmp_path):
    asked = campaign(*COMMON, "stop.rhw=null", "stop.episodes=50")
    with pytest.raises(KeyboardInterrupt):
        run_here(asked, tmp_path / "run", progress=Interrupted())
    assert (manifest(tmp_path / "run")["status"], manifest(tmp_path / "run")["n_episodes"]) == ("interrupted", 0)
    run_here(asked, tmp_path / "run")
    with pytest.raises(RunFolderError, match="already begun"):
        run_here(asked, tmp_path / "run")


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_resumption_that_would_give_up_tests_is_refused_and_costs_nothing(runs, tmp_path):
    """Nor the last shard of a spent budget, which a longer one would replace: the rule is content before it."""
    wide, out = copy_of(runs / "tight", tmp_path / "wide"), tmp_path / "run"
    run_here(campaign(*COMMON, "stop.rhw=null", "stop.episodes=130"), out)
    for folder, asked in ((wide, (LOOSE,)), (out, ("stop.rhw=5", "stop.min_crashes=1"))):
        before = files(folder)
        with pytest.raises(RunFolderError, match="finished tests, of which the campaign as it is asked for now would"):
            run_here(campaign(*COMMON, *asked), folder, resume=True)
        assert files(folder) == before


def test_a_resumption_that_is_interrupted_before_it_has_caught_up_leaves_no_file(runs, tmp_path):
    """Nor what it had read by then, in a file beside the one that the manifest lists."""
    interrupted = Progress()
    interrupted.advance = Mock(side_effect=[None, None, KeyboardInterrupt])
    out = copy_of(runs / "loose", tmp_path / "run")
    before = files(out)
    with pytest.raises(KeyboardInterrupt):
        run_here(campaign(*COMMON, TIGHT), out, resume=True, progress=interrupted)
    assert files(out) == before


def test_a_spent_budget_is_exit_code_4_and_can_be_enlarged(runs, tmp_path):
    out = tmp_path / "run"
    result = run_here(campaign(*COMMON, "stop.episodes=130", "stop.rhw=0.01"), out)
    assert (result.exit_code, result.stopped_by) == (EXIT_BUDGET_SPENT, "episodes")
    assert (manifest(out)["n_episodes"], (out / "estimates.json").exists()) == (130, True)
    result = run_here(campaign(*COMMON, LOOSE), out, resume=True)
    assert (result.exit_code, result.stopped_by) == (EXIT_DONE, "rhw")
    assert unlike_columns(runs / "loose", out) == []


# -- a limit ends a run of shells as soon as it is known on which side of it the crash rate lies --


@pytest.mark.parametrize(
    ("changes", "code", "verdict"),
    [
        (("accept.crash_rate_below=4e-7",), 0, "accepted"),
        pytest.param(("accept.crash_rate_below=5e-8",), 5, "rejected", marks=pytest.mark.slow),
        (("accept.crash_rate_below=1.4e-7", "stop.episodes=300"), 4, "undecided"),
        (("accept.times_reference={driver: r157-cc, at_most: 0.3}",), 5, "rejected"),
        pytest.param(
            ("testing.shells.statement=library", "accept.crash_rate_below=4e-7"), 0, "accepted", marks=pytest.mark.slow
        ),
    ],
)
def test_a_limit_ends_it_with_a_decision(tmp_path, changes, code, verdict):
    decided = run_here(campaign(*SHELLS, "world.engine=twin", *changes), tmp_path / "run")
    found = decided.estimates["decision"]
    assert (decided.exit_code, found["verdict"]) == (code, verdict)
    row, key = answer_in(decided.folder)["rows"][0], "times_reference" if "r157-cc" in changes[0] else "crash_rate"
    assert decided.estimates["unmet"][0]["numbers"]["asked"].startswith(key)
    assert (found["driver"] == "r157-cc") == ("r157-cc" in row["value"]) == ("r157-cc" in changes[0])
    assert (decided.stopped_by == "accept") == (code != 4)
    assert estimate(decided.folder)["decision"] == found
    how = "the same command with --resume --set stop.episodes=600 goes on"
    assert (how in answer_in(decided.folder)["scope"]) == (code == 4)
    if code == 5:
        assert row["value"] in write_report(decided.folder).read_text(encoding="utf-8")
    assert found["statement"] == ("library" if "library" in changes[0] else "assumption_free")
    n_outside = decided.estimates["estimates"]["shells"]["details"]["within"]["n_episodes_outside"]
    assert n_outside == 0 or "library" not in changes[0]


@pytest.mark.slow
def test_a_rate_far_enough_below_a_reference_drivers_ends_it_too(tmp_path):
    """Where precision is out of reach; the same folder goes on when that is no longer asked."""
    asked = partial(campaign, *SHELLS, "world.engine=twin", "stop.rhw=0.01", "stop.episodes=2000")
    far = run_here(asked("stop.below_reference=2"), tmp_path / "far")
    assert (far.exit_code, far.stopped_by, far.estimates["decision"]) == (0, "below_reference", None)
    assert far.estimates["unmet"] == [{"key": "below_reference", "numbers": {"limit": 2.0}}]
    assert answer_in(far.folder)["scope"].endswith("stopped: clearly below the competent driver")
    n = far.estimates["n_episodes"]
    others = run_here(asked("stop.below_reference=0.3"), tmp_path / "other")
    assert (others.exit_code, others.estimates["n_episodes"]) == (4, 2000)
    on = run_here(asked(), far.folder, resume=True)
    assert n < on.estimates["n_episodes"] == 2000
    assert unlike_columns(on.folder, others.folder) == []


# -- where workers fail --


PARTS_BEFORE_FAILURE = 3


def test_a_shard_that_kills_every_worker_ends_the_run_and_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "serve", bad_workers.dying)
    monkeypatch.setattr(workers, "ATTEMPTS", 2)
    with pytest.raises(WorkerLostError, match=r"shard 0 .*: found 2 worker processes that died") as lost:
        run_with_workers(campaign(*TWIN), tmp_path, workers=1)
    assert lost.value.exit_code == EXIT_TOO_MANY_FAILED
    assert "exit code -9" in lost.value.found
    assert manifest(tmp_path)["status"] == "interrupted"
    assert workers_alive() == []


def test_a_disagreement_in_a_worker_ends_the_run_and_all_workers(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "serve", bad_workers.disobedient)
    with pytest.raises(WorldDisagreementError, match="SUMO, BV3, m"):
        run_with_workers(campaign(*TWIN), tmp_path, workers=2)
    assert manifest(tmp_path)["status"] == "interrupted"
    assert workers_alive() == []


def test_a_full_disk_is_told_and_the_run_can_be_resumed(twin_run, tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"
    write = Path.write_bytes

    def write_or_fail(path: Path, content: bytes) -> int:
        if path.parent.name == "moments" and len(part_files(out)) == PARTS_BEFORE_FAILURE + 1:
            write(path, b"PAR1, and then the disk was full")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write(path, content)

    with one_process(), monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_or_fail)
        assert main(["run", str(MIXTURE_FILE), "--out", str(out), "--workers", "1", *sets(*SMALL, *TWIN)]) == 2
    complaint = capsys.readouterr().err
    assert "no space left" in complaint
    assert "--resume" in complaint
    assert len(part_files(out)) == PARTS_BEFORE_FAILURE
    assert manifest(out)["n_episodes"] == 80 * PARTS_BEFORE_FAILURE
    assert manifest(out)["status"] == "interrupted"
    assert not list(out.rglob("*.part"))
    run_here(campaign(*TWIN), out, resume=True)
    assert unlike_columns(twin_run, out) == []


# -- the worker's side of the pipe --


@pytest.mark.parametrize("at", ["__init__", "run"])
@pytest.mark.parametrize("error", [CampaignError("world.cells", "300", "at most 256", "Use fewer."), KeyError(1), None])
def test_errors_reach_the_parent(error, at, tmp_path, monkeypatch):
    """As they are, a defect with the worker's traceback, and one that cannot be pickled in words."""
    strange = ValueError("of a strange kind")
    strange.handle = lambda: None
    raising = Mock(side_effect=error or strange)
    monkeypatch.setattr(workers, "ShardRunner", raising if at == "__init__" else Mock(return_value=Mock(run=raising)))
    answers = []
    pipe = SimpleNamespace(
        recv=Mock(side_effect=[(ShardRequest(0, 0, 10), {}, False), EOFError]),
        send=lambda answer: answers.append(pickle.loads(pickle.dumps(answer))),
    )
    workers.serve(pipe, SimpleNamespace(campaign=campaign()), tmp_path)
    (found,) = answers
    assert type(found) is (RuntimeError if error is None else type(error))
    assert str(error or "ValueError: of a strange kind") in str(found)
    assert not isinstance(error, KeyError) or "in run\n" in found.__notes__[0]


def resident_mb() -> list[float]:
    """Memory of this process, as the kernel counts it, after 10,000 and 200,000 tests that it has run as a worker."""
    runner, resident = workers.ShardRunner(resolve(load_campaign(MIXTURE_FILE)), Path()), []
    for index in range(200):
        runner.run(ShardRequest(index, index * 1_000, 1_000))
        if index + 1 in (10, 200):
            resident.append(int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0]) / 1024.0)
    return resident


@pytest.mark.slow
def test_memory_of_a_worker_stays_within_ten_percent():
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        early, late = process.submit(resident_mb).result()
    assert late <= 1.1 * early


def test_a_worker_without_memory_says_so():
    """Also where none is left to pickle its error, as under a limit that a vehicle has set."""
    error = MemoryError()
    error.unpicklable = lambda: None
    assert isinstance(fit_to_travel(error), MemoryError)
