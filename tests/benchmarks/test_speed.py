"""The benchmark compares like with like, and says so when it does not."""

import pytest

from benchmarks.contender_process import Measurement
from benchmarks.contenders import CONTENDERS, Recorded, campaign
from benchmarks.one_at_a_time import in_libsumo
from benchmarks.speed import RATES, RATIOS, Ratio, ratio, require_equal_rows
from harness.worlds.twin import TwinWorld


def measured(episodes, cpu_s, wall_s=1.0, cell_steps=100):
    return Measurement(episodes, cell_steps, wall_s, cpu_s, 0, None)


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


def test_a_ratio_is_the_median_of_ratios_within_rounds():
    found = {"a": [measured(100, 1.0), measured(100, 2.0), measured(100, 50.0)], "b": [measured(100, 2.0)] * 3}
    assert ratio(found, Ratio("a", "b", "episodes_per_cpu_s")) == pytest.approx(1.0)
    assert ratio(found, Ratio("a", "c", "episodes_per_cpu_s")) is None


def test_contenders_with_other_rows_stop_the_benchmark():
    class Process:
        def __init__(self, name, rows):
            self.name, self.rows = name, rows

    require_equal_rows([Process("harness", b"1"), Process("traci", b"1"), Process("twin nde", b"2")])
    with pytest.raises(RuntimeError, match="same episodes: harness, traci"):
        require_equal_rows([Process("harness", b"1"), Process("traci", b"2")])


def test_what_is_asked_for_names_contenders_that_exist():
    assert {name for wanted in RATIOS for name in (wanted.of, wanted.to)} | set(RATES) <= set(CONTENDERS)
