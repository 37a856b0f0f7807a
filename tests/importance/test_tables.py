"""The cache of challenge tables: by content, read when there, built again when damaged."""

import numpy as np
import pytest

from harness.campaign.drivers import IDMParameters
from harness.families.cut_in.nade import tables as cache
from harness.families.cut_in.nade.tables import Tables, build_tables, tables_name
from harness.vehicles.drivers import driver_records
from tests.kernels import environment

DRIVER = driver_records([IDMParameters()])
FIELDS = [name for name in DRIVER.dtype.names if name != "max_jerk_mps3"]  # infinite


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
        numbers = np.array([driver[name][0] for name in FIELDS], np.float32)
        return Tables(np.full((13, 9, 150, 12), numbers.sum(), np.float32), *[np.outer(numbers, numbers)] * 3)

    monkeypatch.setattr(cache, "build_one", build_one)
    return arguments


def equal(one, other):
    return all(a.tobytes() == b.tobytes() and a.shape == b.shape for a, b in zip(one, other, strict=True))


def one_bit(content):
    return content[:5000] + bytes([content[5000] ^ 1]) + content[5001:]


@pytest.mark.parametrize("damage", [lambda _: b"", lambda content: content[:-5000], one_bit])
def test_a_damaged_file_is_built_again(folder, built, damage):
    first = build_tables(environment(), DRIVER, "immediate")
    path = folder.parent / tables_name(environment(), DRIVER, "immediate")
    content = path.read_bytes()
    path.unlink()  # the tables are mapped: a file that shrinks under them would take this process down
    path.write_bytes(damage(content))
    assert equal(build_tables(environment(), DRIVER, "immediate"), first)
    assert equal(build_tables(environment(), DRIVER, "immediate"), first)
    assert len(built) == 2


def test_what_the_hash_depends_on():
    reference = tables_name(environment(), DRIVER, "recursive")
    assert tables_name(environment(level=350.0), DRIVER, "recursive") == reference
    assert tables_name(environment(hold_s=0.1), DRIVER, "recursive") != reference
    assert tables_name(environment(), DRIVER, "immediate") != reference
    for name in FIELDS:
        changed = DRIVER.copy()
        changed[name] += 1
        assert tables_name(environment(), changed, "recursive") != reference
    for name in ("free_driving__df", "cut_in__accept_ttc_s", "guard__margin_m", "initial_state__r1_log_mean"):
        numbers = environment().numbers.copy()
        numbers[name] += 0.1
        assert tables_name(environment()._replace(numbers=numbers), DRIVER, "recursive") != reference
