"""`harness fit`: from files of trajectories to an environment file, its replicates and a page."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import yaml

from harness.campaign.files import read_model
from harness.campaign.yaml_text import yaml_text
from harness.errors import HarnessError, TrajectoryError, printable
from harness.fitting.fit import Fit, fit_traffic
from harness.fitting.laws import Traffic
from harness.fitting.observations import Observations, Tally, observations, require_enough
from harness.fitting.page import page
from harness.fitting.table import load_mapping
from harness.fitting.tracks import FitRange
from harness.fitting.uncertainty import REPLICATES, replicates
from harness.progress import Progress
from harness.records.folder import parquet, require_place, write_together
from harness.traffic.parameters import SHIPPED_FOLDER, EnvironmentParameters

BASE = "ndd-overtaking-2"
"""Numbers that are not fitted are taken from it."""
SEED = 1


@dataclass(frozen=True)
class FittedFiles:
    """The files that a fit has written, and the fit itself."""

    environment: Path
    replicates: Path
    page: Path
    fit: Fit
    tally: Tally

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


def fit_files(
    files: Sequence[str | Path],
    out: str | Path,
    *,
    mapping: str | None = None,
    mirror: bool | None = None,
    n_replicates: int = REPLICATES,
    seed: int = SEED,
    progress: Progress | None = None,
) -> FittedFiles:
    """Fit traffic to trajectories and write it: ``out`` (YAML), and beside it its replicates and a page.

    ``mapping`` is ``highd``, ``ngsim`` or a YAML file; ``mirror``, if given, takes the place of what it says. The same
    files and seed give the same bytes.

    Raises `HarnessError`: a file, its mapping or what was read cannot be used, or ``out`` cannot be written.
    """
    progress, out = progress or Progress(), Path(out)
    paths = [Path(file) for file in files]
    read, where = load_mapping(mapping, mirror=mirror), ", ".join(map(str, paths))
    beside, shown = out.with_name(f"{out.stem}.replicates.parquet"), out.with_suffix(".html")
    inputs = {path.resolve() for path in paths}
    if len(inputs) < len(paths):
        raise TrajectoryError(where, "a file that is named twice", "each file once", "Leave one of them out.")
    for path in (out, beside, shown):
        if path.resolve() in inputs | {Path(mapping or ".").resolve()}:
            raise HarnessError(
                f"--out {out}", f"{path}, which is also an input", "another file", "Choose another name."
            )
    require_place(out.parent)
    base = read_model(SHIPPED_FOLDER / f"{BASE}.yaml", EnvironmentParameters)
    numbers = base.values()
    fit_range = FitRange(*(numbers[f"fit_range__{name}"] for name in FitRange._fields))

    progress.stage("reading trajectories", 1000)
    gathered: list[Observations] = []
    tally, done = Tally(), 0
    for each, share in observations(paths, read, fit_range):
        gathered.append(each)
        tally = tally.plus(each.tally)
        progress.advance(round(1000 * share) - done)
        done = round(1000 * share)
    require_enough(tally, where, read)
    fit = fit_traffic(Traffic.of(gathered), base, BASE, where, progress)
    rows = replicates(fit, n_replicates, seed, progress)

    noise_mps2 = math.sqrt(math.fsum(each.noise_mps2**2 for each in gathered) / len(gathered))
    environment = _yaml(fit, tally, paths, beside.name, mapping, read.mirror)
    text = page(fit, tally, noise_mps2, rows, out.name, paths)
    write_together({out: environment.encode(), beside: parquet(pa.table(rows)), shown: text.encode()})
    return FittedFiles(out, beside, shown, fit, tally)


def _yaml(fit: Fit, tally: Tally, files: Sequence[Path], beside: str, mapping: str | None, mirrored: bool) -> str:
    """The environment file: its provenance, then one number per line."""
    from importlib.metadata import version  # noqa: PLC0415 - takes a while

    clusters = "recording" if fit.traffic.by_recording else "vehicle, as recordings are few"
    lines = [
        f"Traffic fitted by harness {version('harness')} to {fit.traffic.n_recordings} recordings: "
        f"{tally.vehicles:,} vehicles, {tally.driven_s / 3600.0:.2f} h beside the target lane,",
        f"{tally.used} lane changes to it. Standard errors (se) and replicates are by {clusters}.",
        f"Numbers that are not fitted are those of {fit.base_name}. Use lane_change_level 1 with this traffic.",
        f"mapping: {mapping or 'that of the input table'}{', mirrored' if mirrored else ''}",
        *(f"sha256 {_sha256(file)} {file.name}" for file in files),
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
    return f"{text}\n{yaml_text({'replicates': beside})}"


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True)
    return str(text).strip()


def _sha256(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()[:16]
