"""Load an environment: a shipped parameter file or the user's own, validated, as kernels read it."""

from __future__ import annotations

from pathlib import Path

from harness.campaign.loading import names_a_file
from harness.campaign.models import Environment as EnvironmentSection
from harness.campaign.yaml_text import read_model
from harness.environment.driving import Environment, build_environment
from harness.environment.parameters import SHIPPED_FOLDER, EnvironmentParameters, parameter_record


def parameter_file(name: str) -> Path:
    """Path of a shipped parameter file, or of the user's own."""
    return Path(name) if names_a_file(name) else SHIPPED_FOLDER / f"{name}.yaml"


def load_parameters(section: EnvironmentSection) -> EnvironmentParameters:
    """The numbers that a campaign's environment names.

    Raises
    ------
    CampaignError
        The file is missing, is not YAML, or says something wrong; every place is named.
    """
    return read_model(parameter_file(section.parameters), EnvironmentParameters)


def load_environment(section: EnvironmentSection, parameters: EnvironmentParameters | None = None) -> Environment:
    """The environment of a campaign, with its tables."""
    numbers = parameter_record(
        parameters or load_parameters(section),
        lane_change_level=section.lane_change_level,
        hold_s=section.acceleration_hold_s,
    )
    return build_environment(numbers)
