"""`harness estimate` over millions of stored episodes: time, memory, and the same numbers as in memory.

    python -m benchmarks.stored_episodes runs/ten-million --episodes 1e7

makes a run of published NADE with the twin (unless the folder holds it already; some 650 bytes and 50 µs of one core
per episode), measures `harness estimate` with all estimators in one pass, and compares the first shard, streamed in
uneven pieces, with means and least squares over all of its rows in memory.
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.contenders import SCENARIOS, TWIN_CELLS
from benchmarks.resume import harness
from harness.campaign.files import load_campaign
from harness.estimators import Block, one_pass
from harness.estimators.block import EPISODE_COLUMNS, MOMENT_COLUMNS, block_from_tables
from harness.estimators.scv import fill_product_columns, n_columns
from harness.importance.build import mixture_weights
from harness.records.reader import read_shards

ASKED_S, ASKED_GIB, ASKED_EPISODES = 60.0, 2.0, 1e7
SHARD = 100_000
PIECES = 7
_AGREEMENT = 1e-9


def make_run(folder: Path, episodes: int) -> None:
    """Published NADE in the twin, without traces."""
    sizes = (f"world.cells={TWIN_CELLS}", f"run.shard_size={SHARD}", f"stop.episodes={episodes}")
    settings = ("world.engine=twin", "records.traces=none", "stop.rhw=null", *sizes)
    words = (word for setting in settings for word in ("--set", setting))
    harness("run", str(SCENARIOS / "overtaking_nade.yaml"), "--resume", "--out", str(folder), *words)


def largest_difference(folder: Path) -> float:
    """Largest relative difference between streamed estimates of the first shard and plain numpy on all of its rows."""
    campaign = load_campaign(folder / "campaign.yaml", check_files=False)
    episodes, moments = next(
        read_shards(folder, episode_columns=list(EPISODE_COLUMNS), moment_columns=list(MOMENT_COLUMNS))
    )
    block = block_from_tables(episodes, moments, method=campaign.testing.method, alpha=mixture_weights(campaign))
    edges = np.geomspace(1, len(block) + 1, PIECES).astype(int) - 1
    streamed = one_pass(block.take(slice(a, b)) for a, b in pairwise(edges)).estimates
    y, n = block.weighted_crashes(), len(block)
    z = np.concatenate([_residuals(block, y, level) for level in np.unique(block.n_control_steps)])
    in_memory = {
        ("nade", "crash_rate"): y.mean(),
        ("nade", "std_error"): np.sqrt(y.var(ddof=1) / n),
        ("scv", "crash_rate"): z.mean(),
        ("scv", "std_error"): np.sqrt(z.var(ddof=1) / n),
    }
    return max(abs(getattr(streamed[name], key) / value - 1.0) for (name, key), value in in_memory.items())


def _residuals(block: Block, y: np.ndarray, level: int) -> np.ndarray:
    """Z = Y - H·β of one stratum, by numpy's least squares on centred columns."""
    rows = block.n_control_steps == level
    ratios = block.first_ratios[rows]
    columns = np.empty((len(ratios), n_columns(int(level), ratios.shape[2])), order="F")
    fill_product_columns(ratios, int(level), columns)
    design = np.column_stack([np.ones(rows.sum()), columns - columns.mean(axis=0)])
    scale = np.linalg.norm(columns.mean(axis=0)) * np.sqrt(rows.sum())
    largest = np.linalg.norm(design, 2)
    tolerance = max(design.shape) * np.finfo(float).eps * max(1.0, scale / largest)
    coefficients = np.linalg.lstsq(design, y[rows], rcond=tolerance)[0]
    return y[rows] - design[:, 1:] @ coefficients[1:]


def main() -> None:
    """Make the run if it is not there, measure, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="run folder, made if it does not hold the run yet")
    parser.add_argument("--episodes", type=float, default=ASKED_EPISODES)
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    episodes = int(options.episodes)
    manifest = options.folder / "manifest.json"
    if not manifest.exists() or json.loads(manifest.read_text())["n_episodes"] != episodes:
        make_run(options.folder, episodes)
    disk = sum(path.stat().st_size for path in options.folder.rglob("*.parquet"))
    print(f"{episodes:,} episodes of published NADE, {disk / 1e9:.2f} GB, {disk / episodes:.0f} bytes each")
    for _ in range(options.repetitions):
        cost = harness("estimate", str(options.folder), "--json")
        scaled = cost.wall_s * ASKED_EPISODES / episodes
        print(
            f"  estimate: {cost.wall_s:.1f} s ({cost.cpu_s:.1f} s of CPU), {cost.gib:.2f} GiB; "
            f"per 1e7 episodes {scaled:.0f} s; asked <= {ASKED_S:.0f} s and {ASKED_GIB:.0f} GiB"
        )
    difference = largest_difference(options.folder)
    verdict = "equal" if difference <= _AGREEMENT else "DIFFERENT"
    print(f"  streamed and in memory: {verdict} (largest relative difference {difference:.1e})")


if __name__ == "__main__":
    main()
