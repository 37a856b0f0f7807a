"""Load an environment: a shipped parameter file or the user's own, validated, as kernels read it."""

from __future__ import annotations

from pathlib import Path

from harness.campaign.loading import names_a_file
from harness.campaign.models import Environment as EnvironmentSection
from harness.campaign.problems import read_model
from harness.environment.driving import Environment, build_environment
from harness.environment.laws import require_sound_laws
from harness.environment.parameters import SHIPPED_FOLDER, EnvironmentParameters, parameter_record


def parameter_file(name: str) -> Path:
    """Path of a shipped parameter file, or of the user's own."""
    return Path(name) if names_a_file(name) else SHIPPED_FOLDER / f"{name}.yaml"


def load_parameters(section: EnvironmentSection) -> EnvironmentParameters:
    """The numbers that a campaign's environment names.

    Raises
    ------
    CampaignError
        The file is missing, is not YAML, or says something wrong; every place is named. Or its laws give no
        probabilities.
    """
    file = parameter_file(section.parameters)
    parameters = read_model(file, EnvironmentParameters)
    require_sound_laws(_tabulated(section, parameters), str(file))
    return parameters


def load_environment(section: EnvironmentSection, parameters: EnvironmentParameters | None = None) -> Environment:
    """The environment of a campaign, with its tables."""
    return _tabulated(section, parameters or load_parameters(section))


def _tabulated(section: EnvironmentSection, parameters: EnvironmentParameters) -> Environment:
    return build_environment(
        parameter_record(parameters, lane_change_level=section.lane_change_level, hold_s=section.acceleration_hold_s)
    )
