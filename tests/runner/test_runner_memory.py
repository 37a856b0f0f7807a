"""A worker's memory does not grow: after 2e5 episodes it is what it was after 1e4, within 10 %."""

from __future__ import annotations

from multiprocessing import get_context
from pathlib import Path

import pytest

from harness.campaign.files import load_campaign
from tests.runner.conftest import MIXTURE_FILE

SHARD, WARM_UP, EPISODES = 1_000, 10_000, 200_000


def resident_mb() -> float:
    """Resident memory of this process, as the kernel counts it."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024.0


def run_shards(connection, folder: Path) -> None:
    """Work like a worker process, and say after every shard how much memory that takes."""
    from harness.resolved import resolve
    from harness.runner.workers import ShardRunner
    from harness.sampling.protocol import ShardRequest

    runner = ShardRunner(resolve(load_campaign(MIXTURE_FILE)), folder)
    for index in range(EPISODES // SHARD):
        runner.run(ShardRequest(index, index * SHARD, SHARD))
        for path in folder.rglob("*.parquet"):
            path.unlink()
        connection.send(resident_mb())


@pytest.mark.slow
def test_memory_of_a_worker_stays_within_ten_percent(tmp_path, record_property):
    ours, theirs = get_context("spawn").Pipe()
    worker = get_context("spawn").Process(target=run_shards, args=(theirs, tmp_path), daemon=True)
    worker.start()
    theirs.close()
    resident = [ours.recv() for _ in range(EPISODES // SHARD)]
    worker.join()
    after_warm_up = resident[WARM_UP // SHARD - 1 :]
    record_property("resident_mb", after_warm_up[:: WARM_UP // SHARD])
    print(f"resident MB every {WARM_UP} episodes:", *(f"{mb:.1f}" for mb in after_warm_up[:: WARM_UP // SHARD]))  # noqa: T201
    assert max(after_warm_up) <= 1.1 * after_warm_up[0]
