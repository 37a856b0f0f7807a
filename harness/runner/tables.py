"""Tables of a stored run, as pandas frames or Arrow tables, with units and weights.

Every function raises a `RunFolderError` that names a file which is missing or damaged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa

from harness.arguments import checked
from harness.errors import RunFolderError
from harness.processes import made_ahead
from harness.records.folder import ESTIMATES, SHELLS, concatenated, no_episodes, read_as, read_kept, read_manifest
from harness.records.reader import N_READERS, read_campaign
from harness.records.schemas import traces_schema
from harness.report.drawing import Plot
from harness.runner.stored import StoredEstimates
from harness.shown import ShownInPython
from harness.vocabulary import IntArray

if TYPE_CHECKING:
    import pandas as pd

TableName = Literal["episodes", "moments", "traces"]

_MOST_SHELLS = 128
"""More than an int8 counts."""
_WEIGHT = pa.field(
    "weight", pa.float64(), metadata={"unit": "1", "doc": "the mean of weight times crash is the crash rate"}
)


@dataclass(frozen=True, repr=False)
class StoredRun(ShownInPython):
    """A run folder, whose tables are read when asked for; shown, it is the short answer.

    ``frame.attrs["unit"]`` and ``frame.attrs["doc"]`` give unit and meaning of each column by its name; the unit
    of a number without one is ``"1"``, that of a text ``""``.
    """

    folder: Path

    @property
    def estimates(self) -> dict[str, Any]:
        """Content of ``estimates.json``: estimates, and the ``severity`` of crashes."""
        again = f"Make it again with `harness estimate {self.folder} --write`."
        return read_as(dict[str, Any], self.folder / ESTIMATES, mend=again)

    def _lines(self) -> list[str]:
        if not (self.folder / ESTIMATES).is_file():
            return [f"{self.folder}: {read_manifest(self.folder)['n_episodes']:,} tests, without an answer as yet"]
        return StoredEstimates(self.estimates, self.folder)._lines()

    def _plot(self) -> Plot | None:
        has_answer = (self.folder / ESTIMATES).is_file()
        return StoredEstimates(self.estimates, self.folder)._plot() if has_answer else None

    @checked("episodes")
    def episodes(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per test, failed ones included, with its ``weight`` and all ``columns``, or those that are named.

        The mean of ``weight`` over all rows, those alone counted that crashed, is the crash rate per test, whatever the
        method. With ``shells`` a row weighs p_s n / n_s: its shell has probability p_s and n_s of the n tests.
        """
        return _described(self.table("episodes", columns))

    @checked("moments")
    def moments(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per control step; a `RunFolderError` where the campaign kept none (``records.moments``)."""
        return _described(self.table("moments", columns))

    @checked("traces")
    def traces(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per step and vehicle; a `RunFolderError` where nothing was traced (``records.traces``)."""
        return _described(self.table("traces", columns))

    @checked("table")
    def table(self, name: TableName, columns: Sequence[str] | None = None) -> pa.Table:
        """Content of the method of that ``name``, as an Arrow table: several times faster and smaller for long runs.

        Unit and meaning of a column are in its field's metadata.
        """
        return concatenated(list(self.batches(name, columns)), self.folder)

    @checked("batches")
    def batches(self, name: TableName, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """`table` in consecutive pieces, one per part: for what does not fit into memory."""
        manifest = read_manifest(self.folder)
        parts = [part for part in manifest["parts"] if name in part.files]
        if not parts and name == "traces" and read_campaign(self.folder, manifest).records.traces != "none":
            yield traces_schema(shows=bool(manifest["events_show"])).empty_table()
            return
        if not parts and name == "episodes":
            raise no_episodes(self.folder)
        if not parts:
            mend = f"Run it into another folder with --set records.{name}=all."
            raise RunFolderError(str(self.folder), f"no {name}", f"a run whose campaign kept {name}", mend)
        read = partial(read_kept, self.folder, table=name)
        added, needs = ((_WEIGHT.name,), ("log_weight", "component")) if name == "episodes" else ((), ())
        stored = read(parts[0]).column_names
        shown = list(dict.fromkeys([*(stored if columns is None else columns), *added]))
        needed = [column for column in dict.fromkeys([*shown, *needs]) if column not in added]
        if unknown := sorted({*needed} - {*stored}):
            found = f"no column {unknown[0]!r} in {name}"
            raise RunFolderError(str(self.folder), found, f"one of {', '.join(sorted(stored))}", "Correct its name.")
        per_shell = None
        if added and (self.folder / SHELLS).is_file():
            components = (read(part, columns=["component"])["component"] for part in parts)
            per_shell = np.sum([np.bincount(shells, minlength=_MOST_SHELLS) for shells in components], axis=0)
        for piece in made_ahead(partial(read, columns=needed), parts, N_READERS):
            yield (piece.append_column(_WEIGHT, _weights(piece, per_shell)) if added else piece).select(shown)


def _weights(episodes: pa.Table, per_shell: IntArray | None) -> pa.Array:
    """Weights of tests; ``per_shell`` (S,) are the run's tests of each shell, None without shells."""
    # The weight of a failed test, which counts as no crash, may be unknown.
    log_weight = episodes["log_weight"].to_numpy()
    weight = np.exp(np.where(np.isnan(log_weight), 0.0, log_weight))
    if per_shell is not None:
        weight *= per_shell.sum() / per_shell[episodes["component"].to_numpy()]
    return pa.array(weight)


def _described(table: pa.Table) -> pd.DataFrame:
    """A table as a frame, with unit and doc of its columns from Arrow's field metadata."""
    frame: pd.DataFrame = table.to_pandas()
    for key in ("unit", "doc"):
        frame.attrs[key] = {field.name: field.metadata[key.encode()].decode() for field in table.schema}
    return frame


@checked("harness.read")
def read(folder: str | Path) -> StoredRun:
    """Tables of a stored run, as pandas frames or Arrow tables, with units and weights.

    Parameters
    ----------
    folder : str or Path
        Run folder.

    Raises `RunFolderError`: the folder is no run.

    Examples
    --------
    Of the run that `harness.run` shows:

    >>> import harness
    >>> tests = harness.read("runs/idm").episodes(["outcome", "impact_speed_mps"])
    >>> tests.attrs["unit"]["impact_speed_mps"]
    'm/s'
    >>> crashed = tests["outcome"] == "crash"
    >>> f"{int(crashed.sum())} crashes, {(tests['weight'] * crashed).mean():.2e} per test"
    '95 crashes, 1.95e-07 per test'
    """
    read_manifest(Path(folder))
    return StoredRun(Path(folder))
