"""Shards on a Ray cluster of this machine: the same records as by processes of the run's own, whatever is killed.

Several machines, and cables that are pulled: `python -m benchmarks.ray_cluster`.
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import pytest

from benchmarks.kills import descendants, orphans, started_by
from harness.errors import EXIT_TOO_MANY_FAILED, HarnessError
from tests.in_process import run_here, run_with_workers, workers_alive
from tests.runner.conftest import SHELLS, TWIN, campaign
from tests.runner.test_shells_runs import FORCED, SHADOWS, of
from tests.stored_runs import manifest, part_files, unlike_columns

ray = pytest.importorskip("ray")
import harness.runner.ray as on_ray  # noqa: E402 - not without the extra
from harness.processes import WorkerDeath  # noqa: E402

ROOT = Path(__file__).parents[2]
ON_RAY, WORKER = "run.executor=ray", b"multiprocessing.forkserver"
EARLY = "before_event: controller, limits: {max_acceleration_mps2: 2}"


@pytest.fixture(scope="module", autouse=True)
def _cluster():
    """One for all tests of this file: runs use the cluster that their process is connected to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.setattr("harness.runner.kept.PART_TESTS", 80)  # files tell how far it is
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(address="local", num_cpus=2, include_dashboard=False, logging_level="ERROR", log_to_driver=False)
        yield
        ray.shutdown()


def below(word: bytes) -> list[int]:
    """Processes that this one has started, itself or by others, with a word in their command."""
    return [pid for pid in descendants(os.getpid()) if started_by(pid, word)]


def test_a_run_begun_here_goes_on_there_with_the_same_records(twin_run, tmp_path):
    run_here(campaign(*TWIN, "stop.episodes=160"), tmp_path / "run")
    run_with_workers(campaign(*TWIN, ON_RAY), tmp_path / "run", resume=True)
    assert unlike_columns(twin_run, tmp_path / "run") == []
    assert manifest(tmp_path / "run")["workers"] == 2  # the cluster's room
    assert manifest(tmp_path / "run")["cpu"] == manifest(twin_run)["cpu"]
    assert orphans(workers_alive(), 10.0) == []


def test_shadow_runs_come_to_the_machines(tmp_path):
    settings = (*SHELLS, *SHADOWS, f"av={of('Speeds')}", TWIN[0])
    a = run_with_workers(campaign(*settings), tmp_path / "local", workers=2)
    b = run_with_workers(campaign(*settings, ON_RAY), tmp_path / "ray")
    assert unlike_columns(a.folder, b.folder) == []
    assert a.estimates == b.estimates


def test_killed_actors_and_workers_take_nothing_along(tmp_path):
    settings = (*FORCED, TWIN[0], "stop.episodes=12000", "run.shard_size=400")
    a = run_with_workers(campaign(*settings), tmp_path / "local", workers=2)
    struck: list[int] = []

    def strike() -> None:
        for victim, n_done in ((b"ray::OnMachine", 1), (WORKER, 6)):
            while len(part_files(tmp_path / "ray")) < n_done:
                time.sleep(0.02)
            struck.extend(below(victim)[:1])
            os.kill(struck[-1], signal.SIGKILL)

    thread = threading.Thread(target=strike)
    thread.start()
    b = run_with_workers(campaign(*settings, ON_RAY), tmp_path / "ray")
    thread.join()
    assert len(struck) == 2
    assert unlike_columns(a.folder, b.folder) == []


@pytest.mark.parametrize("struck", [b"", b"ray::OnMachine"], ids=["none", "actor"])
def test_what_a_controller_starts_ends_with_the_run_and_no_file_is_left(struck, tmp_path, monkeypatch):
    """One in a session of its own, one adopted; the vehicle acts early, so that machines are handed baseline runs."""
    monkeypatch.chdir(ROOT)
    note, out, left = tmp_path / "started", tmp_path / "ray", set(Path(tempfile.gettempdir()).glob("harness-*"))
    acting = f"{{controller: 'tests.controllers.misbehaving:StartsPrograms', parameters: {{note: {note}}}, {EARLY}}}"
    settings = (*FORCED, *SHADOWS, TWIN[0], f"av={acting}", "world.cells=8", "stop.episodes=3000")

    def strike() -> None:
        while len(part_files(out)) < 2:
            time.sleep(0.02)
        for pid in below(struck)[:1] if struck else []:
            os.kill(pid, signal.SIGKILL)

    thread = threading.Thread(target=strike)
    thread.start()
    run_with_workers(campaign(*settings, ON_RAY), out)
    thread.join()
    started = {int(pid) for pid in note.read_text().split()}
    assert len(started) >= 2 * 8 * 2
    assert orphans(sorted(started), 10.0) == []
    assert set(Path(tempfile.gettempdir()).glob("harness-*")) <= left


def test_a_shard_that_is_lost_thrice_with_its_machine_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(on_ray.RayWorker, "answer", lambda self: self.kill() or WorkerDeath(None, None))
    with pytest.raises(HarnessError, match="3 worker processes that died, the last with its machine") as lost:
        run_with_workers(campaign(*TWIN, ON_RAY), tmp_path / "run")
    assert lost.value.exit_code == EXIT_TOO_MANY_FAILED


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("resources.gpus=0.25", r"run\.ray\.resources: found a cluster of 2 CPUs and 0 GPUs"),
        ("runtime_env={working_dir: nowhere-at-all}", r"run\.ray\.runtime_env"),
    ],
)
def test_what_the_cluster_cannot_give(tmp_path, asked, said):
    with pytest.raises(HarnessError, match=said):
        run_with_workers(campaign(*TWIN, ON_RAY, f"run.ray.{asked}"), tmp_path / "run")
    assert asked.startswith("runtime_env") or not (tmp_path / "run/manifest.json").exists()


def test_another_version_on_a_machine_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(on_ray, "source_hash", lambda: "0123456789abcdef")
    with pytest.raises(HarnessError, match="a machine with sources of its kernels"):
        run_with_workers(campaign(*TWIN, ON_RAY), tmp_path / "run")
