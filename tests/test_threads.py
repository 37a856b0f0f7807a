import os
from functools import partial
from pathlib import Path

import pytest

from harness import processes
from harness.processes import made_ahead, side_by_side, usable_cpus


@pytest.mark.parametrize(
    "work",
    [
        *(partial(side_by_side, worthwhile=worthwhile) for worthwhile in (True, False)),
        *(partial(made_ahead, n_threads=n_threads) for n_threads in (None, 1, 3)),
    ],
)
def test_results_come_in_the_order_of_the_items_and_errors_where_they_are_raised(work):
    assert list(work(lambda i: i * i, range(100))) == [i * i for i in range(100)]
    assert list(work(str, [])) == []
    with pytest.raises(ZeroDivisionError):
        list(work(lambda i: 1 // i, [1, 0, 1]))


@pytest.mark.parametrize(
    ("groups", "files", "n_cpus"),
    [
        ("0::/\n", {"cpu.max": "max 100000"}, 8),
        ("0::/a/b\n", {"a/cpu.max": "150000 100000", "a/b/cpu.max": "max 100000"}, 2),
        ("0::/named/as/outside\n", {"cpu.max": "50000 100000"}, 1),
        ("3:cpu,cpuacct:/x\n1:memory:/y\n", {"cpu/x/cpu.cfs_quota_us": "3000", "cpu/x/cpu.cfs_period_us": "1000"}, 3),
        ("0::/a\n", {"a/cpu.max": "1600000 100000"}, 8),
        ("3:cpu:/outside\n0::/\n", {"cpu/cpu.cfs_quota_us": "4000", "cpu/cpu.cfs_period_us": "1000"}, 4),
    ],
)
def test_the_share_of_cpus_is_what_affinity_and_the_quotas_of_all_control_groups_allow(
    tmp_path, monkeypatch, groups, files, n_cpus
):
    for name, content in files.items():
        (tmp_path / "groups" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / name).write_text(content + "\n")
    (tmp_path / "own").write_text(groups)
    monkeypatch.setattr(processes, "_CONTROL_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(processes, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert usable_cpus.__wrapped__() == n_cpus


def test_workers_start_where_this_user_may_go_to(tmp_path, monkeypatch):
    """As with ``su`` in a folder of root's."""
    go = os.chdir

    def closed(folder):
        if folder == str(tmp_path):
            raise PermissionError(13, "Permission denied", folder)
        go(folder)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "chdir", closed)
    with processes._server():
        assert str(Path.cwd()) == os.sep
