"""The benchmark compares like with like, and says so when it does not."""

from types import SimpleNamespace

import pytest

from benchmarks.contenders import Recorded, campaign
from benchmarks.one_at_a_time import in_libsumo
from benchmarks.speed import require_equal_rows
from harness.worlds.twin import TwinWorld


def test_one_episode_at_a_time_runs_the_episodes_of_the_twin():
    settings = campaign("nde", **{"environment.lane_change_level": 1e4, "records.moments": "none"})
    one_by_one = Recorded(settings, lambda _: in_libsumo())
    try:
        rows = one_by_one.rows(12)
    finally:
        one_by_one.close()
    twin = Recorded(settings, lambda _: TwinWorld(5))
    assert rows == twin.rows(12)
    assert rows != twin.rows(11)
    assert twin.run(0, 12).bytes_written > 0
    twin.close()


def test_contenders_with_other_rows_stop_the_benchmark():
    of = {"harness": b"1", "traci": b"2", "twin nde": b"2"}
    harness, traci, twin = (SimpleNamespace(name=name, rows=rows) for name, rows in of.items())
    require_equal_rows([harness, twin])
    with pytest.raises(RuntimeError, match="same episodes: harness, traci"):
        require_equal_rows([harness, traci])
