"""The cache of challenge tables: by content, read when there, built again when damaged."""

from pathlib import Path

import numpy as np
import pytest

from harness.campaign.drivers import IDMParameters
from harness.campaign.files import load_campaign
from harness.importance import tables as cache
from harness.importance.build import build_importance
from harness.importance.tables import Tables, build_tables, table_path, tables_hash
from harness.vehicles.drivers import MODEL_FIELDS, driver_records
from tests.traffic.kernels import environment

DRIVER = driver_records([IDMParameters()])
OTHER = driver_records([IDMParameters(time_headway_s=1.5)])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HARNESS_CACHE_DIR", str(tmp_path))
    return tmp_path / "tables"


@pytest.fixture
def built(monkeypatch):
    """What has been built rather than read; small tables of the surrogate's numbers stand in for the real ones."""
    arguments = []

    def build_one(environment, driver, challenge):
        arguments.append((driver, challenge))
        numbers = np.array([driver[name][0] for name in MODEL_FIELDS], np.float32)
        return Tables(np.full((13, 9, 150, 12), numbers.sum(), np.float32), np.outer(numbers, numbers), numbers)

    monkeypatch.setattr(cache, "build_one", build_one)
    return arguments


def mapped_by(table):
    while isinstance(table.base, np.ndarray):
        table = table.base
    return table


def equal(one, other):
    return all(a.tobytes() == b.tobytes() and a.shape == b.shape for a, b in zip(one, other, strict=True))


def test_the_second_build_reads(folder, built):
    assert not table_path(environment(), DRIVER, "immediate").exists()
    first = build_tables(environment(), DRIVER, "immediate")
    second = build_tables(environment(), DRIVER, "immediate")
    assert len(built) == 1
    assert equal(first, second)
    assert [path.suffix for path in folder.iterdir()] == [".npy"]  # nothing half-written is left behind


def test_another_set_of_surrogates_is_another_file(folder, built):
    one = build_tables(environment(), DRIVER, "immediate")
    both = build_tables(environment(), np.concatenate([DRIVER, OTHER]), "immediate")
    assert len(built) == 3
    assert len(list(folder.iterdir())) == 2
    assert equal([array[:1] for array in both], one)
    assert not equal([array[1:] for array in both], one)


@pytest.mark.parametrize("damage", [lambda content: content[:1000], lambda _: b"", lambda content: content[:-5000]])
def test_a_truncated_file_is_built_again(folder, built, damage):
    first = build_tables(environment(), DRIVER, "immediate")
    path = table_path(environment(), DRIVER, "immediate")
    content = path.read_bytes()
    path.unlink()  # the tables are mapped: a file that shrinks under them would take this process down
    path.write_bytes(damage(content))
    assert equal(build_tables(environment(), DRIVER, "immediate"), first)
    assert equal(build_tables(environment(), DRIVER, "immediate"), first)
    assert len(built) == 2


@pytest.mark.slow
def test_a_real_table_is_read_as_it_was_built(folder):
    first = build_tables(environment(), DRIVER, "immediate")
    assert equal(build_tables(environment(), DRIVER, "immediate"), first)
    assert first.value.shape[:2] == (1, 13)


def test_tables_are_mapped_and_nobody_can_write_to_them(folder, built):
    """Also those that have just been built: the process that built them shares them with its workers."""
    for _ in range(2):
        for table in build_tables(environment(), DRIVER, "immediate"):
            assert type(table) is np.ndarray
            assert table.flags.c_contiguous
            assert not table.flags.writeable
            assert isinstance(mapped_by(table), np.memmap)


def test_kernels_are_compiled_once_for_campaigns_with_and_without_tables(folder, built):
    """A read-only array is another type than a writable one."""
    tables = build_tables(environment(), DRIVER, "immediate")
    naturalistic = build_importance(
        load_campaign(Path(__file__).parents[2] / "scenarios" / "overtaking_nde.yaml"), None
    )
    for name, table in tables._asdict().items():
        assert getattr(naturalistic, name).flags.writeable == table.flags.writeable


def test_progress_is_told_for_every_surrogate(folder, built):
    told = []
    build_tables(environment(), np.concatenate([DRIVER, OTHER]), "immediate", told.append)
    assert told == [1, 1]


def test_what_the_hash_depends_on():
    reference = tables_hash(environment(), DRIVER, "recursive")
    assert tables_hash(environment(level=350.0), DRIVER, "recursive") == reference
    assert tables_hash(environment(hold_s=0.1), DRIVER, "recursive") != reference
    assert tables_hash(environment(), DRIVER, "immediate") != reference
    for name in MODEL_FIELDS:
        changed = DRIVER.copy()
        changed[name] += 1
        assert tables_hash(environment(), changed, "recursive") != reference
    for name in ("free_driving__df", "cut_in__accept_ttc_s", "guard__margin_m", "initial_state__r1_log_mean"):
        numbers = environment().numbers.copy()
        numbers[name] += 0.1
        assert tables_hash(environment()._replace(numbers=numbers), DRIVER, "recursive") != reference
