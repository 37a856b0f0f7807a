"""What happens when workers fail: the error names the place, what was finished stays, and a resumed run is complete."""

from __future__ import annotations

import errno
import io
import itertools
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.cli import main
from harness.errors import EXIT_TOO_MANY_FAILED, CampaignError, WorldDisagreementError
from harness.progress import ShownProgress
from harness.runner import run as running
from harness.runner import workers
from harness.runner.workers import WorkerLostError
from harness.sampling.protocol import ShardRequest
from tests.in_process import workers_alive
from tests.runner import bad_workers
from tests.runner.conftest import MIXTURE_FILE, SMALL, TWIN
from tests.stored_runs import copy_of, manifest, sets, shard_files, unlike_columns

SHARDS_BEFORE_FAILURE = 3


def test_a_shard_that_kills_every_worker_ends_the_run_and_is_named(run, campaign, tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "serve", bad_workers.dying)
    monkeypatch.setattr(workers, "ATTEMPTS", 2)
    with pytest.raises(
        WorkerLostError, match=r"shard 0 \(from episode 0\): found 2 worker processes that died"
    ) as lost:
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


def test_a_full_disk_is_said_in_words_and_the_run_can_be_resumed(
    run_here, campaign, twin_run, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "run"
    write = Path.write_bytes

    def write_or_fail(path: Path, content: bytes) -> int:
        if path.parent.name == "moments" and len(shard_files(out)) == SHARDS_BEFORE_FAILURE:
            write(path, b"PAR1, and then the disk was full")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_or_fail)
        assert main(["run", str(MIXTURE_FILE), "--out", str(out), "--workers", "1", *sets(*SMALL, *TWIN)]) == 2
    complaint = capsys.readouterr().err
    assert "no space left" in complaint
    assert "--resume" in complaint
    assert len(shard_files(out)) == SHARDS_BEFORE_FAILURE
    assert manifest(out)["n_episodes"] == 80 * SHARDS_BEFORE_FAILURE
    assert manifest(out)["status"] == "interrupted"
    assert not list(out.rglob("*.part"))
    run_here(campaign(*TWIN), out, resume=True)
    assert unlike_columns(twin_run, out) == []


def test_a_disk_that_is_full_at_the_very_end(run_here, campaign, twin_run, tmp_path, monkeypatch):
    out = copy_of(twin_run, tmp_path / "run")
    (out / "estimates.json").unlink()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "estimates.json")

    with monkeypatch.context() as patch:
        patch.setattr(running, "write_sealed", full)
        with pytest.raises(OSError, match="No space left"):
            run_here(campaign(*TWIN), out, resume=True)
    assert not (out / "estimates.json").exists()
    run_here(campaign(*TWIN), out, resume=True)
    assert unlike_columns(twin_run, out) == []


def test_a_clock_that_jumps_back(run_here, campaign, twin_run, tmp_path, monkeypatch):
    """An hour at every look, in both sessions of a run: nothing but the time of day in a line of progress knows it."""
    hours, stream, out = itertools.count(start=500_000, step=-1), io.StringIO(), tmp_path / "run"
    monkeypatch.setattr("time.time", lambda: 3600.0 * next(hours))
    with ShownProgress(stream=stream, interval_s=0.01) as progress:
        run_here(campaign(*TWIN, "stop.episodes=240"), out, progress=progress)
        run_here(campaign(*TWIN), out, resume=True, progress=progress)
        progress.stage("episodes", 400, done=200)
        progress.advance(100)
        assert "300 of 400" in next(progress.lines())
    assert unlike_columns(twin_run, out) == []
    assert 0.0 <= manifest(out)["wall_time_s"] < 600.0
    assert " -" not in stream.getvalue()


# -- the worker's side of the pipe --


class Pipe:
    """A connection whose other end sends shards and then is closed."""

    def __init__(self, n_shards: int) -> None:
        self._specs = [ShardRequest(i, 10 * i, 10) for i in range(n_shards)]
        self.sent: list[object] = []

    def recv(self) -> tuple[ShardRequest, dict]:
        if not self._specs:
            raise EOFError
        return self._specs.pop(0), {}

    def send(self, answer: object) -> None:
        pickle.dumps(answer)
        self.sent.append(answer)


@pytest.fixture
def serve(campaign, tmp_path, monkeypatch):
    """Serve shards with stand-ins for preparing and running one; returns what was noted."""

    def served(pipe: Pipe, run: Callable = lambda spec: spec.index, prepare: Callable = lambda: None) -> list[str]:
        events = []

        class Runner:
            def __init__(self, *_: object) -> None:
                prepare()
                events.append("prepared")

            def run(self, spec: ShardRequest, fatal_episodes: dict) -> object:
                return run(spec)

            def close(self) -> None:
                events.append("closed")

        monkeypatch.setattr(workers, "ShardRunner", Runner)
        resolved = tmp_path / "resolved"
        resolved.write_bytes(pickle.dumps(campaign()))
        workers.serve(pipe, resolved, tmp_path, tmp_path / "black-box")
        return events

    return served


@pytest.mark.parametrize(("lost", "error"), [(None, None), ("recv", ConnectionResetError), ("send", BrokenPipeError)])
def test_a_worker_prepares_once_and_ends_quietly_with_its_parent(lost, error, serve, monkeypatch):
    def broken(*_: object) -> None:
        raise error

    pipe = Pipe(3)
    if lost:
        monkeypatch.setattr(pipe, lost, broken)
    assert serve(pipe) == ([] if lost == "recv" else ["prepared", "closed"])
    assert pipe.sent == ([] if lost else [0, 1, 2])


def raises(error: Exception) -> Callable[..., None]:
    def raising(*_: object) -> None:
        raise error

    return raising


def test_errors_reach_the_parent(serve):
    """As they are, a defect with the worker's traceback, and one that cannot be pickled in words."""
    refused = CampaignError("world.cells", found="300", expected="at most 256", mend="Use fewer.")
    strange = ValueError("of a strange kind")
    strange.handle = lambda: None
    prepared, defect, unpicklable = Pipe(1), Pipe(1), Pipe(1)
    serve(prepared, prepare=raises(refused))
    serve(defect, lambda spec: 1 / spec.index)
    serve(unpicklable, raises(strange))
    (error,) = prepared.sent
    assert (type(error), str(error)) == (CampaignError, "world.cells: found 300; expected at most 256. Use fewer.")
    (error,) = defect.sent
    assert isinstance(error, ZeroDivisionError)
    assert "lambda spec: 1 / spec.index" in pickle.loads(pickle.dumps(error)).__notes__[0]
    (error,) = unpicklable.sent
    assert isinstance(error, RuntimeError)
    assert "ValueError: of a strange kind" in str(error)
