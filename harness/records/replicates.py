"""Files of replicates: numbers of a traffic as other trajectories of the same kind would have given them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from harness.campaign.models import shipped_or_own
from harness.errors import RunFolderError
from harness.files import content_hash
from harness.records.folder import read_table

if TYPE_CHECKING:
    from harness.families.numbers import ParameterFile

OF_REPLICATES = b"harness fit"
"""Key in the metadata of a file: hash of the numbers that they belong to."""


def read_replicates(name: str, parameters: ParameterFile, shipped: Path) -> list[dict[str, float]]:
    """Numbers that vary, of each replicate that an environment, a name of a file that is ``shipped`` or a path, names.

    Raises `HarnessError`: the file is missing or damaged, or is not of these numbers.
    """
    file, tied = shipped_or_own(name, shipped, "environment.parameters"), parameters.replicates
    if tied is None:
        return []
    path, again = file.parent / tied.file, "Write it anew with `harness fit`, or leave out the key replicates."
    table = read_table(path, mend=again)
    of, expected = (table.schema.metadata or {}).get(OF_REPLICATES), f"the replicates that {file.name} was written with"
    if content_hash(path.read_bytes()) != tied.sha256:
        raise RunFolderError(str(path), "replicates of another fit, or changed ones", expected, again)
    if of != parameters.content_hash().encode():
        raise RunFolderError(str(path), f"replicates of other numbers than those of {file.name}", expected, again)
    wrong = [] if table.num_rows else ["no rows"]
    for column, of in zip(table.column_names, table.columns, strict=True):
        if column not in parameters.numbers():
            wrong.append(f"column {column}")
        elif of.null_count or not (pa.types.is_floating(of.type) or pa.types.is_integer(of.type)):
            wrong.append(f"column {column} with something else than numbers")
    if wrong:
        raise RunFolderError(str(path), wrong[0], f"replicates of the numbers of {file.name}, by section__name", again)
    rows: list[dict[str, float]] = table.to_pylist()
    return rows
