"""A campaign with all that its names stand for: read once, near the door, and handed on; nothing reads a file again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from harness.campaign.campaign import Campaign
from harness.errors import CampaignError
from harness.pool.library import Library, load_library
from harness.traffic.laws import Environment
from harness.traffic.loading import load_environment, load_parameters
from harness.vehicles.drivers import av_records, surrogate_records
from harness.vocabulary import SAMPLING, RecordArray


@dataclass(frozen=True, eq=False)
class Resolved:
    """A campaign and the content of the files that it names.

    Attributes
    ----------
    av : structured ndarray, shape (1,)
        Record of a built-in AV; shape (0,) of any other.
    surrogates : structured ndarray, shape (J,)
        Records of the drivers that challenges are computed for.
    content_hash : str
        Of all that changes an episode's bits, the environment's numbers included.
    controller_sha256 : str or None
        Hash of the source of the AV's controller; None where there is none, or nobody has looked.
    """

    campaign: Campaign
    environment: Environment
    av: RecordArray
    surrogates: RecordArray
    content_hash: str
    controller_sha256: str | None = None

    @cached_property
    def library(self) -> Library:
        """The surrogates of pools; read when they are first asked for, as most campaigns never do.

        Raises
        ------
        CampaignError
            The library's file is missing or wrong.
        """
        return load_library(self.campaign.pool.library)


def require_lead_is_drawn(campaign: Campaign) -> None:
    """Refuse (`CampaignError`) what does not know how long a cut-in shows itself before BV overlaps.

    The method's tables are for cut-ins of one step, or nobody could draw the lead.
    """
    method, acts = campaign.testing.method, campaign.av.acts_before_cut_in
    if SAMPLING[method].mixes:
        raise CampaignError(
            "testing.method",
            found=f"{method}, where cut-ins take time (`lateral` of the environment)",
            expected="shells, forced or nde: the tables of criticality are for cut-ins of one step, and would aim at "
            "those that an attentive vehicle avoids",
            mend="Choose shells, or an environment without that section.",
        )
    if acts and not SAMPLING[method].shadows:
        raise CampaignError(
            "av.before_cut_in",
            found=f"controller, with testing.method {method}, where cut-ins take time (`lateral` of the environment)",
            expected="a method that drives the AV along its paths first: only then the onset is known in time",
            mend="Choose testing.method shells or forced, or hold_speed.",
        )


def resolve(campaign: Campaign, controller_sha256: str | None = None) -> Resolved:
    """Read what a campaign names.

    Raises
    ------
    CampaignError
        The environment's parameter file is missing or wrong.
    """
    parameters = load_parameters(campaign.environment)
    environment = load_environment(campaign.environment, parameters)
    if environment.lateral.present:
        require_lead_is_drawn(campaign)
    return Resolved(
        campaign,
        environment,
        av_records(campaign.av, see_onset=environment.lateral.present),
        surrogate_records(campaign.surrogates),
        campaign.content_hash(parameters.content_hash()),
        controller_sha256,
    )
