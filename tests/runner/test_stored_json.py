"""JSON files of a run folder with wrong types: one clear error, never a traceback."""

import copy
import json

import pytest

from harness.errors import RunFolderError
from harness.records.folder import read_manifest, require_schema
from harness.records.stored_manifest import StoredShells
from harness.report.summary import read_run_folder
from tests.stored_runs import copy_of

WRONG = [True, -1, 0.5, 10**400, "text", "\0", [1], {"x": 1}, [None], float("nan")]
UNREAD = {"format", "n_equal"}
"""Keys that no reader looks at."""


@pytest.fixture
def stored(twin_run, tmp_path):
    return copy_of(twin_run, tmp_path / "run")


def places(content, path=()):
    """Paths to all values, at any depth, with the values; of a list only the first."""
    items = list(content.items()) if isinstance(content, dict) else list(enumerate(content))[:1]
    for key, value in items:
        yield (*path, key), value
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


def replaced(content, path, value):
    changed = copy.deepcopy(content)
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return changed


def is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def of_one_kind(a, b):
    return type(a) is type(b) or (is_number(a) and is_number(b)) or None in (a, b)


def complaint(folder):
    try:
        read_manifest(folder)
    except RunFolderError as error:
        return str(error)
    return ""


def test_every_value_of_another_kind_is_refused(stored):
    path = stored / "manifest.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    n_refused = 0
    for place, value in places(content):
        if place[-1] in UNREAD:
            continue
        for wrong in (wrong for wrong in WRONG if not of_one_kind(value, wrong)):
            path.write_text(json.dumps(replaced(content, place, wrong)), encoding="utf-8")
            said = complaint(stored)
            assert str(path) in said, (place, wrong)
            assert len(said) < 1500
            n_refused += 1
    assert n_refused > 300


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        (("n_episodes",), -1),
        (("n_episodes",), 0.5),
        (("n_episodes",), 10**400),
        (("distance_per_test_m",), float("nan")),
        (("shards", 0, "files", "episodes"), "../../etc/passwd"),
        (("shards", 0, "files", "episodes"), "episodes/\0.parquet"),
        (("shards", 0, "files", "episodes"), None),
        (("shards",), None),
        (("stopped_by",), "the moon"),
    ],
)
def test_values_of_the_kind_that_no_run_writes_are_refused(stored, place, wrong):
    path = stored / "manifest.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(replaced(content, place, wrong)), encoding="utf-8")
    assert complaint(stored)


def test_estimates_of_wrong_types_are_refused(stored):
    path = stored / "estimates.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    for key in ("campaign", "headline", "estimates", "confidence", "lane_change_level", "convergence", "diagnostics"):
        for wrong in ([1], "text" if key not in ("campaign", "headline") else 1, True):
            path.write_text(json.dumps({**content, key: wrong}), encoding="utf-8")
            with pytest.raises(RunFolderError, match=r"estimates\.json"):
                read_run_folder(stored)


SHELLS = {"pool": "k", "strata": ["a", "b"], "cell_stratum": [0, 1], "cell_p": [0.1, 0.2], "cell_references": [0, 1],
          "references": [{"name": "r", "described": "a driver", "delay_s": None}], "reference_rate": [0.1],
          "reference_square": [0.2], "n_paths": 3, "p_cut_in": 0.3, "p_impossible": 0.0, "available": [1, 2],
          "statements": [{"name": "s", "boundary": "a", "assumes": "b", "n_inside": 1, "checked": False}]}  # fmt: skip


@pytest.mark.parametrize(
    ("model", "content", "wrong"),
    [
        *((StoredShells, SHELLS, {key: {}}) for key in SHELLS),
        (StoredShells, SHELLS, {"cell_p": [0.1]}),
        (StoredShells, SHELLS, {"statements": []}),
        (StoredShells, SHELLS, {"cell_stratum": [0, 0]}),
        (StoredShells, SHELLS, {"reference_rate": []}),
    ],
)
def test_shells_are_checked(tmp_path, model, content, wrong):
    require_schema(content, model, tmp_path, mend="")
    with pytest.raises(RunFolderError):
        require_schema({**content, **wrong}, model, tmp_path, mend="")
