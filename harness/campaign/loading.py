"""Read a campaign: strict YAML, overrides, validation with every problem named, paths made absolute."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.campaign.models import Campaign
from harness.campaign.overrides import Places, apply_overrides, parse_override
from harness.campaign.panel import av_override
from harness.campaign.problems import validated
from harness.campaign.yaml_text import read_yaml
from harness.errors import CampaignError

SHIPPED_PARAMETERS = Path(__file__).parent.parent / "traffic"


def load_campaign(
    path: str | Path, overrides: Sequence[str] = (), *, av: str | None = None, check_files: bool = True
) -> Campaign:
    """Read, override and validate a campaign.

    Parameters
    ----------
    path : str or Path
        Campaign file.
    overrides : sequence of str
        ``section.key=value`` each, as after ``--set``.
    av : str, optional
        Vehicle that replaces the campaign's, as after ``--av``: ``PANEL.yaml:NAME``, or ``NAME`` in the shipped panel.
        Overrides are laid over it.
    check_files : bool
        Whether files that the campaign names must exist; False to look at a run whose environment file is gone.

    Returns
    -------
    Campaign
        With ``environment.parameters``, when it is a path, and ``av.fmu.file`` absolute.

    Raises
    ------
    CampaignError
        The file cannot be read, is not YAML, or says something wrong; the error names every place.

    Examples
    --------
    >>> load_campaign("scenarios/smoke.yaml", ["stop.rhw=0.3", "av.parameters.min_acceleration_mps2=-6"])
    """
    data, lines = read_yaml(path)
    changes = [*([] if av is None else [av_override(av)]), *map(parse_override, overrides)]
    place = Places(lines, changes)
    campaign = validated(apply_overrides(data, changes), Campaign, str(path), place)
    for where, (name, expected) in _named_files(campaign).items():
        file = (Path(path).parent / Path(name).expanduser()).resolve()
        if check_files and not file.is_file():
            raise CampaignError(
                place(where),
                found=f"{name}, but there is no file {file}",
                expected=expected,
                mend="Correct the path; it is relative to the folder of the campaign file.",
            )
        campaign = campaign.replaced(where, str(file))
    campaign = campaign.replaced(("run", "ray", "runtime_env"), _with_absolute_paths(campaign, Path(path).parent))
    name = campaign.environment.parameters
    if check_files and not names_a_file(name) and name not in shipped_parameters():
        shipped = shipped_parameters()
        close = difflib.get_close_matches(name, shipped, n=1)
        mend = f"Did you mean '{close[0]}'?" if close else "For a file of your own write its path, such as ./mine.yaml."
        raise CampaignError(
            place(("environment", "parameters")),
            found=f"'{name}', which is not shipped",
            expected=f"the name of a shipped parameter file: {', '.join(shipped)}; or a path that ends in .yaml",
            mend=mend,
        )
    return campaign


def _with_absolute_paths(campaign: Campaign, folder: Path) -> dict[str, Any]:
    """Ray's environment, in which folders of this machine are relative to the campaign's file; others are URIs."""

    def absolute(value: Any) -> Any:
        if isinstance(value, list):
            return [absolute(each) for each in value]
        if isinstance(value, str) and "://" not in value:
            return str((folder / Path(value).expanduser()).resolve())
        return value

    environment = campaign.run.ray.runtime_env
    return {
        key: absolute(value) if key in ("working_dir", "py_modules") else value for key, value in environment.items()
    }


def _named_files(campaign: Campaign) -> dict[tuple[str, ...], tuple[str, str]]:
    """Files that a campaign names: by their place in it the name and what it has to be."""
    fmu, library, parameters = campaign.av.fmu, campaign.pool.library, campaign.environment.parameters
    files: dict[tuple[str, ...], tuple[str, str]] = {}
    if fmu is not None:
        files["av", "fmu", "file"] = fmu.file, "an FMI 2.0 co-simulation FMU"
    if names_a_file(library):
        files["pool", "library"] = library, "a surrogate library, or the name of a shipped one"
    if names_a_file(parameters):
        expected = f"a parameter file, or the name of a shipped one: {', '.join(shipped_parameters())}"
        files["environment", "parameters"] = parameters, expected
    return files


def shipped_parameters() -> list[str]:
    """Names of the environment parameter files that come with the harness."""
    return sorted(file.stem for file in SHIPPED_PARAMETERS.glob("*.yaml"))


def names_a_file(parameters: str) -> bool:
    """Tell a path to a parameter file from the name of a shipped one."""
    return parameters.endswith((".yaml", ".yml")) or "/" in parameters
