"""Columns gathered of finished shards: the same answers without opening the shards, and never of another file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from harness.records import gathered
from harness.records.gathered import Gathered, gather, parts
from harness.runner import campaign_run, estimate_run, stored_estimates, stored_shards
from harness.runner.stored_shards import COLUMNS
from tests.runner.conftest import TWIN
from tests.runner.stored_runs import copy_of, manifest, shard_files, unlike_columns

WITHOUT_SCV = ("nade", "mixture_cv")
"""Which need no moments: these alone are estimated from gathered columns."""


def refuse(*_: object, **__: object) -> None:
    raise AssertionError("a shard was opened")


def flip(path: Path, at: int) -> None:
    """Change one bit, in a file of its own."""
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def held(folder: Path) -> list[int]:
    """Shards that the gathered columns speak for."""
    stored = manifest(folder)["shards"]
    keys = ("index", "first_episode", "n_episodes", "files")
    return [shard["index"] for shard in stored if Gathered(folder).find(*(shard[key] for key in keys))]


@pytest.fixture
def stored(twin_run, tmp_path):
    return copy_of(twin_run, tmp_path / "run")


def test_estimates_are_the_same_without_opening_a_shard(stored, monkeypatch):
    assert held(stored) == [0, 1, 2, 3, 4]
    monkeypatch.setattr(stored_estimates, "MOST_UNASKED", 0)  # surrogates are asked about the shards themselves
    (part,) = parts(stored)
    content = part.read_bytes()
    part.unlink()
    read = estimate_run(stored, estimators=WITHOUT_SCV)
    part.write_bytes(content)
    monkeypatch.setattr(stored_estimates, "read_shard", refuse)
    assert json.dumps(estimate_run(stored, estimators=WITHOUT_SCV)) == json.dumps(read)


def test_a_run_goes_on_without_opening_a_shard(run_here, campaign, twin_run, tmp_path, monkeypatch):
    out = tmp_path / "run"
    run_here(campaign(*TWIN, "stop.episodes=240"), out)
    with monkeypatch.context() as patch:
        patch.setattr(stored_shards, "read_table", refuse)
        run_here(campaign(*TWIN), out, resume=True)
    assert unlike_columns(twin_run, out) == []
    assert [path.name for path in parts(out)] == ["part-000000.parquet", "part-000001.parquet"]
    assert held(out) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("table", ["episodes", "moments", "traces"])
def test_a_single_bit_of_a_shard_is_enough(table, stored):
    path = shard_files(stored, table)[2]
    flip(path, path.stat().st_size // 2)
    assert held(stored) == [0, 1, 3, 4]
    path.unlink()
    assert held(stored) == [0, 1, 3, 4]


def test_a_damaged_part_is_passed_over(stored, monkeypatch):
    monkeypatch.setattr(stored_estimates, "MOST_UNASKED", 0)
    (part,) = parts(stored)
    size, expected = part.stat().st_size, estimate_run(stored, estimators=WITHOUT_SCV)
    whole = part.read_bytes()
    for at in (0, size // 2, size - 200, size - 1):
        part.write_bytes(whole)
        flip(part, at)
        assert estimate_run(stored, estimators=WITHOUT_SCV) == expected
    part.write_bytes(whole[: size // 2])
    assert estimate_run(stored, estimators=WITHOUT_SCV) == expected


def test_parts_of_other_sources_are_not_taken_over(stored, monkeypatch):
    keys = (0, 0, 80, {})
    assert Gathered(stored, same_sources=True).find(*keys)
    monkeypatch.setattr(gathered, "source_hash", lambda _: "another")
    assert Gathered(stored, same_sources=True).find(*keys) is None
    assert Gathered(stored).find(*keys)


def test_the_later_part_speaks(stored):
    shard = {**manifest(stored)["shards"][1], "n_retraced": 7}
    gather(stored, [shard], COLUMNS)
    assert Gathered(stored).find(1, 80, 80, {}).n_retraced == 7
    assert Gathered(stored).find(1, 80, 79, {}) is None


# -- a finished run, once more --


@pytest.fixture
def finished(run_here, campaign, twin_run, tmp_path):
    """A run, and what goes on with it."""

    out = copy_of(twin_run, tmp_path / "run")
    (out / "estimates.json").unlink()

    def again(*more: str):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("harness.runner.run_result.REPORT", "estimates.json")  # `run` writes no page
            return run_here(campaign(*TWIN, *more), out, resume=True)

    again()
    return out, again


def test_nothing_is_done_twice(finished, monkeypatch):
    out, again = finished
    before = (out / "manifest.json").read_bytes()
    monkeypatch.setattr(campaign_run, "Run", refuse)
    result = again()
    assert (out / "manifest.json").read_bytes() == before
    assert result.estimates == json.loads((out / "estimates.json").read_text())
    assert (result.stopped_by, result.exit_code) == ("episodes", 0)
    assert result.ending == manifest(out)["ending"]


@pytest.mark.parametrize("changed", ["estimates.json", "campaign.yaml", "traces/shard-000002.parquet"])
def test_what_was_changed_is_made_again(changed, finished, monkeypatch):
    out, again = finished
    flip(out / changed, -2)
    monkeypatch.setattr(campaign_run, "Run", refuse)
    with pytest.raises(AssertionError, match="was opened"):
        again()


@pytest.mark.parametrize("more", ["records.trace_share=0.1", "stop.confidence=0.95", "stop.episodes=480"])
def test_what_is_asked_for_anew_is_made(more, finished, monkeypatch):
    _, again = finished
    monkeypatch.setattr(campaign_run, "Run", refuse)
    with pytest.raises(AssertionError, match="was opened"):
        again(more)
