"""Read a campaign: strict YAML, overrides, validation with every problem named, paths made absolute."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from harness.campaign.models import Campaign
from harness.campaign.overrides import Places, apply_overrides, parse_override
from harness.campaign.panel import av_override
from harness.campaign.problems import Place, invalid_file
from harness.campaign.schema import campaign_schema
from harness.campaign.yaml_text import read_yaml
from harness.errors import CampaignError

SHIPPED_PARAMETERS = Path(__file__).parent.parent / "environment"


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
    data = apply_overrides(data, changes)
    place = Places(lines, changes)
    try:
        campaign = Campaign.model_validate(data)
    except ValidationError as error:
        raise invalid_file(error, path=str(path), data=data, schema=campaign_schema(), place=place) from None
    campaign = _with_absolute_fmu(campaign, Path(path).parent, place, check_files=check_files)
    campaign = _with_absolute_library(campaign, Path(path).parent, place, check_files=check_files)
    return _with_absolute_paths(campaign, Path(path).parent, place, check_files=check_files)


def shipped_parameters() -> list[str]:
    """Names of the environment parameter files that come with the harness."""
    return sorted(file.stem for file in SHIPPED_PARAMETERS.glob("*.yaml"))


def names_a_file(parameters: str) -> bool:
    """Tell a path to a parameter file from the name of a shipped one."""
    return parameters.endswith((".yaml", ".yml")) or "/" in parameters


def _with_absolute_paths(campaign: Campaign, folder: Path, place: Place, *, check_files: bool) -> Campaign:
    parameters = campaign.environment.parameters
    where = place(("environment", "parameters"))
    if not names_a_file(parameters):
        if check_files and parameters not in shipped_parameters():
            raise _unknown_parameters(parameters, where)
        return campaign
    file = (folder / Path(parameters).expanduser()).resolve()
    if check_files and not file.is_file():
        raise CampaignError(
            where,
            found=f"{parameters}, but there is no file {file}",
            expected=f"a parameter file, or the name of a shipped one: {', '.join(shipped_parameters())}",
            mend="Correct the path; it is relative to the folder of the campaign file.",
        )
    environment = campaign.environment.model_copy(update={"parameters": str(file)})
    return campaign.model_copy(update={"environment": environment})


def _with_absolute_fmu(campaign: Campaign, folder: Path, place: Place, *, check_files: bool) -> Campaign:
    fmu = campaign.av.fmu
    if fmu is None:
        return campaign
    file = (folder / Path(fmu.file).expanduser()).resolve()
    if check_files and not file.is_file():
        raise CampaignError(
            place(("av", "fmu", "file")),
            found=f"{fmu.file}, but there is no file {file}",
            expected="an FMI 2.0 co-simulation FMU",
            mend="Correct the path; it is relative to the folder of the campaign file.",
        )
    av = campaign.av.model_copy(update={"fmu": fmu.model_copy(update={"file": str(file)})})
    return campaign.model_copy(update={"av": av})


def _with_absolute_library(campaign: Campaign, folder: Path, place: Place, *, check_files: bool) -> Campaign:
    if not names_a_file(campaign.pool.library):
        return campaign
    file = (folder / Path(campaign.pool.library).expanduser()).resolve()
    if check_files and not file.is_file():
        raise CampaignError(
            place(("pool", "library")),
            found=f"{campaign.pool.library}, but there is no file {file}",
            expected="a surrogate library, or the name of a shipped one",
            mend="Correct the path; it is relative to the folder of the campaign file.",
        )
    return campaign.model_copy(update={"pool": campaign.pool.model_copy(update={"library": str(file)})})


def _unknown_parameters(parameters: str, where: str) -> CampaignError:
    shipped = shipped_parameters()
    close = difflib.get_close_matches(parameters, shipped, n=1)
    return CampaignError(
        where,
        found=f"'{parameters}', which is not shipped",
        expected=f"the name of a shipped parameter file: {', '.join(shipped)}; or a path that ends in .yaml",
        mend=f"Did you mean '{close[0]}'?" if close else "For a file of your own write its path, such as ./mine.yaml.",
    )
