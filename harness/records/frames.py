"""The tables of a stored run as pandas frames, with units, and with weights whose mean is the crash rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from harness.errors import RunFolderError
from harness.records.folder import SHELLS, concatenated, no_episodes, read_manifest, read_table
from harness.records.reader import read_shards, stored_columns

_WEIGHT = pa.field(
    "weight", pa.float64(), metadata={"unit": "1", "doc": "the mean of weight times crash is the crash rate"}
)


@dataclass(frozen=True)
class StoredRun:
    """A run folder, whose tables are read when asked for.

    Attributes
    ----------
    folder : Path
        The run folder.

    Notes
    -----
    ``frame.attrs["unit"]`` and ``frame.attrs["doc"]`` give unit and meaning of each column by its name; the unit
    of a number without one is ``"1"``, that of a text ``""``.
    """

    folder: Path

    def episodes(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per test, failed ones included, with its ``weight``.

        Parameters
        ----------
        columns : sequence of str, optional
            Columns to read; all by default. ``weight`` always comes with them.

        Returns
        -------
        DataFrame
            The mean of ``weight`` over all rows, those alone counted that crashed, is the crash rate per test, whatever
            the method. With ``shells`` a row weighs p_s n / n_s: its shell has probability p_s and n_s of the n tests.

        Raises
        ------
        RunFolderError
            The folder is no run, has no test, or a file is missing or damaged.
        """
        kept = stored_columns(self.folder)
        if not kept:
            raise no_episodes(self.folder)
        asked = None if columns is None else set(columns) - {_WEIGHT.name}
        if unknown := sorted((asked or set()) - kept):
            raise RunFolderError(
                str(self.folder),
                found=f"no column {unknown[0]!r} in episodes",
                expected=f"one of {', '.join(sorted(kept))}",
                mend="Correct its name.",
            )
        needed = None if asked is None else sorted(asked | {"log_weight", "component"})
        shards = read_shards(self.folder, episode_columns=needed, moment_columns=[])
        table = concatenated([episodes for episodes, _ in shards], self.folder)
        frame = table.to_pandas()
        # The weight of a failed test, which counts as no crash, may be unknown.
        frame[_WEIGHT.name] = np.exp(frame["log_weight"].fillna(0.0))
        if (self.folder / SHELLS).is_file():
            frame[_WEIGHT.name] *= len(frame) / frame.groupby("component")["component"].transform("size")
        shown = frame if columns is None else frame[list(dict.fromkeys([*columns, _WEIGHT.name]))]
        return _described(shown, table.schema.append(_WEIGHT))

    def moments(self) -> pd.DataFrame:
        """One row per control step; a `RunFolderError` where the campaign kept none (``records.moments``)."""
        return self._kept("moments")

    def traces(self) -> pd.DataFrame:
        """One row per step and vehicle; a `RunFolderError` where nothing was traced (``records.traces``)."""
        return self._kept("traces")

    def _kept(self, name: str) -> pd.DataFrame:
        shards = read_manifest(self.folder)["shards"]
        tables = [read_table(self.folder / shard["files"][name]) for shard in shards if shard["files"].get(name)]
        if not tables:
            raise RunFolderError(
                str(self.folder),
                found=f"no {name}",
                expected=f"a run whose campaign kept {name}",
                mend=f"Run it into another folder with --set records.{name}=all.",
            )
        table = concatenated(tables, self.folder)
        return _described(table.to_pandas(), table.schema)


def _described(frame: pd.DataFrame, schema: pa.Schema) -> pd.DataFrame:
    """The same frame with what Arrow's field metadata says of its columns."""
    for key in ("unit", "doc"):
        frame.attrs[key] = {name: schema.field(name).metadata[key.encode()].decode() for name in frame.columns}
    return frame
