"""`harness fit`: from files of trajectories to an environment file, its replicates and a page."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import yaml

from harness.arguments import checked
from harness.campaign.files import read_model
from harness.campaign.yaml_text import yaml_text
from harness.errors import HarnessError, printable
from harness.families.cut_in.parameters import SHIPPED_FOLDER, EnvironmentParameters
from harness.families.replicates import OF_REPLICATES, content_hash
from harness.fitting.fit import REPLICATES, Fit, fit_traffic, replicates
from harness.fitting.laws import Traffic
from harness.fitting.observations import Observations, Tally, observations, require_distinct, require_enough
from harness.fitting.page import page
from harness.fitting.table import Mapping as Columns
from harness.fitting.table import load_mapping, places
from harness.fitting.tracks import FitRange
from harness.progress import Progress
from harness.records.folder import parquet, require_place, write_together

OF_YAML, OF_PAGE = b"Traffic fitted by harness", b"Traffic fitted to trajectories"
"""What marks files that a fit has written."""
BASE = "ndd-overtaking-2"
"""Numbers that are not fitted are taken from it."""
SEED = 1


@dataclass(frozen=True, repr=False)
class FittedFiles:
    """The files that a fit has written, and the fit itself."""

    environment: Path
    replicates: Path
    page: Path
    fit: Fit
    tally: Tally

    def __repr__(self) -> str:
        return "\n".join(map(str, (self.environment, self.page, self.replicates)))

    @property
    def facts(self) -> dict[str, Any]:
        """What was observed, and which laws were kept, for JSON."""
        steps, traffic = self.fit.acceptance, self.fit.traffic
        return {
            "recordings": traffic.n_recordings,
            "vehicles": self.tally.vehicles,
            "hours": self.tally.driven_s / 3600.0,
            "lane_changes": self.tally.used,
            "resampled": "recordings" if traffic.by_recording else "vehicles",
            "acceptance": {
                "events": steps.events.tolist(),
                "exposure": steps.exposure.tolist(),
                "share": steps.shares.tolist(),
            },
            "kept": self.fit.kept,
        }


@checked("harness.fit")
def fit_files(
    files: Sequence[str | Path],
    out: str | Path,
    *,
    mapping: str | None = None,
    mirror: bool | None = None,
    leave_out: Sequence[str] = (),
    n_replicates: int = REPLICATES,
    seed: int = SEED,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedFiles:
    """Fit traffic to trajectories and write it: ``out`` (YAML), and beside it its replicates and a page.

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
    read = load_mapping(mapping, mirror=mirror, leave_out=leave_out)
    beside, shown = out.with_name(f"{out.stem}.replicates.parquet"), out.with_suffix(".html")
    _require_ours({out: OF_YAML, beside: OF_REPLICATES, shown: OF_PAGE}, [*paths, Path(mapping or ".")], force=force)
    require_place(out.parent)
    base = read_model(SHIPPED_FOLDER / f"{BASE}.yaml", EnvironmentParameters)
    numbers = base.values()
    fit_range = FitRange(*(numbers[f"fit_range__{name}"] for name in FitRange._fields))

    progress.stage("reading trajectories", 1000)
    gathered, done = list[Observations](), 0
    for each, share in observations(paths, read, fit_range):
        gathered.append(each)
        progress.advance(round(1000 * share) - done)
        done = round(1000 * share)
    require_distinct(gathered)
    where = places(paths)
    tally = require_enough(gathered, where, read)
    fit = fit_traffic(Traffic.of(gathered), base, BASE, where, progress)
    rows = replicates(fit, n_replicates, seed, progress)

    noise_mps2 = math.sqrt(math.fsum(each.noise_mps2**2 for each in gathered) / len(gathered))
    drawn = parquet(pa.table(rows, metadata={OF_REPLICATES: fit.environment.content_hash()}))
    tied = {"file": beside.name, "sha256": content_hash(drawn)}
    environment = _yaml(fit, tally, paths, tied, mapping, read)
    text = page(fit, tally, noise_mps2, rows, out.name, paths)
    write_together({out: environment.encode(), beside: drawn, shown: text.encode()})
    return FittedFiles(out, beside, shown, fit, tally)


def _require_ours(written: Mapping[Path, bytes], inputs: Sequence[Path], *, force: bool) -> None:
    """Refuse to write over an input, or over what has not the mark of a file that a fit has written."""
    for path, mark in written.items():
        where = f"--out {next(iter(written))}"
        if os.path.realpath(path) in map(os.path.realpath, inputs):
            raise HarnessError(where, f"{path}, which is also an input", "another file", "Choose another name.")
        if path.is_dir() or (not force and not _may_replace(path, mark)):
            found = f"{path}, which harness fit has not written"
            raise HarnessError(where, found, "a new file, or one of a fit", "Choose another name, or give --force.")


def _may_replace(path: Path, mark: bytes) -> bool:
    try:
        return mark in path.read_bytes()
    except OSError:
        return not os.path.lexists(path)


def _yaml(
    fit: Fit, tally: Tally, files: Sequence[Path], tied: dict[str, str], mapping: str | None, read: Columns
) -> str:
    """The environment file: its provenance, then one number per line."""
    from importlib.metadata import version  # noqa: PLC0415 - takes a while

    clusters = "recording" if fit.traffic.by_recording else "vehicle, as recordings are few"
    lines = [
        f"{OF_YAML.decode()} {version('harness')} to {fit.traffic.n_recordings} recordings: "
        f"{tally.vehicles:,} vehicles, {tally.driven_s / 3600.0:.2f} h beside the target lane,",
        f"{tally.used} lane changes to it. Standard errors (se) and replicates are by {clusters}.",
        f"Numbers that are not fitted are those of {fit.base_name}. Use lane_change_level 1 with this traffic.",
        f"mapping: {mapping or 'that of the input table'}{', mirrored' if read.mirror else ''}",
        *(f"left out: {name}" for name in read.leave_out),
        *(f"sha256 {content_hash(file.read_bytes())} {file.name}" for file in files),
    ]
    text = "".join(f"# {printable(' '.join(line.split()))}\n" for line in lines)
    for name, section in fit.environment.model_dump(exclude_defaults=True).items():
        if not isinstance(section, dict):
            text += f"{name}: {section}\n"
            continue
        text += f"\n{name}:\n"
        for key, number in section.items():
            if isinstance(number, list) and isinstance(number[0], dict):
                text += f"  {key}:\n" + "".join(f"    - {_flow(each)}\n" for each in number)
            else:
                text += f"  {key}: {_flow(number)}\n"
    return f"{text}\n{yaml_text({'replicates': tied})}"


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True)
    return str(text).strip()
