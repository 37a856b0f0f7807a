"""`harness fit`: from files of trajectories to an environment file of each family, and what is written beside it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import yaml

from harness.arguments import AtLeastTwo, checked
from harness.errors import HarnessError, printable
from harness.families import families
from harness.fitting.distinct import fingerprint, require_distinct
from harness.fitting.protocol import FitRequest, Fitted, Fitter
from harness.fitting.table import load_mapping, recordings
from harness.progress import Progress
from harness.records.folder import require_place, write_together
from harness.shown import ShownInPython

OF_YAML = b"Traffic fitted by harness"
"""What marks environment files that a fit has written."""
REPLICATES, SEED = 200, 1


@dataclass(frozen=True, repr=False)
class FittedFiles(ShownInPython):
    """What a fit has found and written, by family."""

    families: Mapping[str, Fitted]

    def _lines(self) -> Iterable[str]:
        return map(str, self.files)

    @property
    def files(self) -> list[Path]:
        """All that was written; the environment's file is the first."""
        return [file for fitted in self.families.values() for file in fitted.files]

    @property
    def told(self) -> list[str]:
        """What a terminal shows of it, line by line."""
        return [line for fitted in self.families.values() for line in fitted.told]

    @property
    def facts(self) -> dict[str, Any]:
        """What was observed, for JSON."""
        return {key: value for fitted in self.families.values() for key, value in fitted.facts.items()}


@checked("harness.fit")
def fit_files(
    files: Sequence[str | Path],
    out: str | Path,
    *,
    mapping: str | None = None,
    mirror: bool | None = None,
    leave_out: Sequence[str] = (),
    n_replicates: AtLeastTwo = REPLICATES,
    seed: int = SEED,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedFiles:
    """Fit traffic to trajectories and write it: ``out`` (YAML), its replicates, a page, and files of other families.

    Parameters
    ----------
    files : sequence of str or Path
        Trajectories, in CSV or Parquet.
    out : str or Path
        Environment file to write.
    mapping : str, optional
        How to read columns of other names: ``highd``, ``ngsim`` or a YAML file.
    mirror : bool, optional
        Whether to fit lane changes to the left, in place of what the mapping says.
    leave_out : sequence of str
        Recordings not to fit, beside the mapping's own.
    n_replicates, seed : int
        Environments to draw, and by which seed; the same files and seed give the same bytes.
    force : bool
        Whether to write over files that no fit has written.
    progress : Progress, optional
        Who is told how far it is.

    Raises `HarnessError`: a file, its mapping or what was read cannot be used, or ``out`` cannot be written.
    """
    progress, out = progress or Progress(), Path(out)
    paths = [Path(file) for file in files]
    columns = load_mapping(mapping, mirror=mirror, leave_out=leave_out)
    fitters: dict[str, Fitter] = {name: resolve_name(each.fitter)() for name, each in families().items() if each.fitter}
    marks = {path: mark for fitter in fitters.values() for path, mark in fitter.marks(out).items()}
    _require_ours(out, marks, [*paths, Path(mapping or ".")], force=force)
    require_place(out.parent)

    progress.stage("reading trajectories", 1000)
    done = 0
    fingerprints = []
    for recording in recordings(paths, columns):
        fingerprints.append(fingerprint(recording))
        for fitter in fitters.values():
            fitter.observe(recording)
        progress.advance(round(1000 * recording.share_read) - done)
        done = round(1000 * recording.share_read)
    require_distinct(fingerprints)
    asked = FitRequest(paths, mapping, columns, out, n_replicates, seed, progress)
    fitted: dict[str, Fitted] = {}
    for name, fitter in reversed(fitters.items()):
        fitted = {name: fitter.fitted(asked, fitted), **fitted}
    write_together({path: content for each in fitted.values() for path, content in each.files.items()})
    return FittedFiles(fitted)


def _require_ours(out: Path, written: Mapping[Path, bytes], inputs: Sequence[Path], *, force: bool) -> None:
    """Refuse to write over an input, or over what has not the mark of a file that a fit has written."""
    for path, mark in written.items():
        where = f"--out {out}"
        if os.path.realpath(path) in map(os.path.realpath, inputs):
            raise HarnessError(where, f"{path}, which is also an input", "another file", "Choose another name.")
        ours = force or (mark in path.read_bytes() if path.is_file() else not os.path.lexists(path))
        if path.is_dir() or not ours:
            found = f"{path}, which harness fit has not written"
            raise HarnessError(where, found, "a new file, or one of a fit", "Choose another name, or give --force.")


def environment_text(head: Sequence[str], content: Mapping[str, Any]) -> str:
    """An environment file: ``head`` says where its numbers are from, then one number per line."""
    from importlib.metadata import version  # noqa: PLC0415 - takes a while

    head = [f"{OF_YAML.decode()} {version('harness')} to {head[0]}", *head[1:]]
    text = "".join(f"# {printable(' '.join(line.split()))}\n" for line in head)
    for name, section in content.items():
        if not isinstance(section, dict):
            text += f"{name}: {section}\n"
            continue
        text += f"\n{name}:\n"
        for key, number in section.items():
            if isinstance(number, list) and isinstance(number[0], dict):
                text += f"  {key}:\n" + "".join(f"    - {_flow(each)}\n" for each in number)
            else:
                text += f"  {key}: {_flow(number)}\n"
    return text


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True)
    return str(text).removesuffix("...\n").strip()
