"""Episodes do not depend on what runs beside them or before them: cells, ranges and order leave no trace."""

import numpy as np
import pytest

from harness.worlds.twin import TwinWorld
from tests.episode.twin_runs import prepared

N = 600
TABLES = ("episode", "log_q", "martingale", "lv_path", "bv_path")


def rows(ready, first, n, cells):
    done = ready.loop(TwinWorld(cells)).run(first, ready.states(first, n)).results
    used = int(done.moment_count[0])
    order = np.lexsort((done.moment["step"][:used], done.moment["row"][:used]))
    moment = done.moment[:used][order].copy()
    moment["row"] += first
    return [*episodes(done), moment, done.moment_q[:used][order], done.moment_v[:used][order]]


def episodes(done):
    """Tables with a row per episode; of the paths what their lengths say (behind it lies what the cell did before)."""
    tables = {name: getattr(done, name) for name in TABLES}
    for path, length in (("lv_path", "n_lv"), ("bv_path", "n_bv")):
        used = np.arange(tables[path].shape[1]) < done.episode[length][:, None]
        tables[path] = np.where(used, tables[path], -1)
    return list(tables.values())


def same(one, other):
    return [a.tobytes() == b.tobytes() for a, b in zip(one, other, strict=True)]


@pytest.fixture(scope="module", params=["nde", "forced", "step_mixture", "episode_mixture"])
def ready(request):
    moments = "none" if request.param == "nde" else "all"
    return prepared(request.param, level=1e3, moments=moments)


@pytest.fixture(scope="module")
def reference(ready):
    return rows(ready, 0, N, 64)


@pytest.mark.parametrize("cells", [1, 7, 512])
def test_any_number_of_cells(ready, reference, cells):
    n = N if cells > 1 else 60
    short = reference if n == N else rows(ready, 0, n, 64)
    assert all(same(rows(ready, 0, n, cells), short))


def test_any_split_into_ranges(ready, reference):
    starts, sizes = (0, 100, 101, 350), (100, 1, 249, 250)
    parts = [rows(ready, start, size, 64) for start, size in zip(starts, sizes, strict=True)]
    assert all(same([np.concatenate(tables) for tables in zip(*parts, strict=True)], reference))


def test_a_loop_can_be_used_again(ready, reference):
    loop = ready.loop(TwinWorld(64))
    loop.run(5_000, ready.states(5_000, 100))
    again = loop.run(0, ready.states(0, N)).results
    assert all(same(episodes(again), reference[: len(TABLES)]))
