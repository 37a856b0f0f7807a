"""What happens when workers fail: the error names the place, what was finished stays, and a resumed run is complete."""

from __future__ import annotations

import errno
import os
import pickle
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from harness import sampling
from harness.campaign.files import load_campaign
from harness.cli import main
from harness.errors import EXIT_TOO_MANY_FAILED, CampaignError, WorldDisagreementError
from harness.resolved import resolve
from harness.runner import underway as running
from harness.runner import workers
from harness.runner.workers import WorkerLostError
from harness.sampling.protocol import ShardRequest
from tests.in_process import one_process, workers_alive
from tests.runner import bad_workers
from tests.runner.conftest import MIXTURE_FILE, SMALL, TWIN
from tests.stored_runs import golden, manifest, part_files, sets, unlike_columns

PARTS_BEFORE_FAILURE = 3


def test_a_shard_that_kills_every_worker_ends_the_run_and_is_named(run, campaign, tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "serve", bad_workers.dying)
    monkeypatch.setattr(workers, "ATTEMPTS", 2)
    with pytest.raises(WorkerLostError, match=r"shard 0 .*: found 2 worker processes that died") as lost:
        run(campaign(*TWIN), tmp_path, workers=1)
    assert lost.value.exit_code == EXIT_TOO_MANY_FAILED
    assert "exit code -9" in lost.value.found
    assert manifest(tmp_path)["status"] == "interrupted"
    assert workers_alive() == []


def test_a_disagreement_in_a_worker_ends_the_run_and_all_workers(run, campaign, tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "serve", bad_workers.disobedient)
    with pytest.raises(WorldDisagreementError, match="SUMO, BV3, m"):
        run(campaign(*TWIN), tmp_path, workers=2)
    assert manifest(tmp_path)["status"] == "interrupted"
    assert workers_alive() == []


def test_one_that_is_interrupted_before_its_first_test_says_so(run_here, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "assumed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_here(golden("shells-twin"), tmp_path)
    assert manifest(tmp_path)["status"] == "interrupted"


def test_a_full_disk_is_told_and_the_run_can_be_resumed(run_here, campaign, twin_run, tmp_path, monkeypatch, capsys):
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
def test_errors_reach_the_parent(error, at, campaign, tmp_path, monkeypatch):
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
    workers.serve(pipe, campaign(), tmp_path)
    (found,) = answers
    assert type(found) is (RuntimeError if error is None else type(error))
    assert str(error or "ValueError: of a strange kind") in str(found)
    assert not isinstance(error, KeyError) or "in run\n" in found.__notes__[0]


# -- a worker's memory does not grow: after 2e5 episodes it is what it was after 1e4, within 10 % --


def test_an_interrupted_first_run_does_not_build_its_pool_to_the_end(monkeypatch):
    def build(_resolved, progress):
        for _ in range(6_000):
            progress.advance(1)
            time.sleep(0.01)

    def interrupted(_resolved):
        raise KeyboardInterrupt

    build.kernel = None

    monkeypatch.setattr(sampling, "source_of", lambda _campaign: build)
    monkeypatch.setattr(sampling, "is_cached", lambda _kernel: False)
    monkeypatch.setattr(sampling, "compile_kernels", interrupted)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        sampling.prepare(SimpleNamespace(campaign=None))
    assert time.monotonic() - began < 30.0


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
