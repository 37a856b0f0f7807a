"""A campaign with the content of all files that it names, which are read once, here.

`resolve` reads them; `require_ready` also refuses what can be known to be wrong before anything is simulated or made.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from harness.campaign.campaign import Campaign, Command, Use, refusal
from harness.controllers.find import require_controller, source_of_own, tried_script
from harness.controllers.traci_style import TriedScript
from harness.errors import CampaignError
from harness.estimators.one_pass import accumulator, headline_of
from harness.families import family_named
from harness.families.protocol import Environment, Family, Parameters
from harness.loop.loop import Scenario
from harness.vehicles.drivers import av_records
from harness.vehicles.library import Library, library_records, load_library
from harness.vocabulary import RecordArray
from harness.worlds.sumo_driven import av_type
from harness.worlds.system_libraries import require_libraries


@dataclass(frozen=True, eq=False)
class Resolved:
    """A campaign, with its library named if it left that to its traffic, and the content of the files that it names.

    ``parameters`` are the numbers of its ``environment``, as its family has them. ``av`` is (1,) the record of a
    built-in AV, else (0,); ``surrogates`` (J,) are the drivers that challenges are computed for, and ``challenge`` how
    they are, with the hashes of files for a function or surrogates of the user's own. ``content_hash`` is of all that
    changes an episode's bits, the environment's numbers included; ``controller_sha256`` of the source of the AV's
    controller, None where there is none, or before `require_ready`; ``script`` is what a TraCI script did when it was
    tried.
    """

    campaign: Campaign
    parameters: Parameters
    environment: Environment
    av: RecordArray
    surrogates: RecordArray
    challenge: str
    content_hash: str
    controller_sha256: str | None = None
    script: TriedScript | None = None

    @property
    def family(self) -> Family:
        """The kind of events that the campaign tests."""
        return family_named(self.campaign.scenario)

    @property
    def scenario(self) -> Scenario:
        """What its tests have in common."""
        family, environment, seed = self.family, self.environment, self.campaign.own_seed(self.campaign.seed)
        return Scenario(
            seed=seed, vehicles=family.vehicles, principal=family.principal, ahead=family.ahead,
            max_steps=family.max_steps(environment), sideways_m=family.sideways_m(environment),
            shows=family.shows(environment), driver=self.av, columns=family.columns,
        )  # fmt: skip

    @cached_property
    def library(self) -> Library:
        """The surrogates of pools, read when first asked for; a `CampaignError` if their file is missing or wrong."""
        library = load_library(self.campaign.pool.library)
        library.require_drivers(follows=self.family.follows)
        return library.counting_above(self.campaign.crash.counts_above_mps)


def require_ready(campaign: Campaign, command: Command = "run") -> Resolved:
    """Resolve a campaign for a command; refuse what can be known to be wrong before anything is simulated or written.

    Raises `CampaignError`: the AV's controller cannot be found or made, SUMO knows no such attribute of it, strangers
    could drive it, the environment's parameters are wrong, or the surrogate library is wrong or lacks the boundary.
    Raises `HarnessError`: SUMO's system libraries are missing.
    """
    require_world(campaign)
    controller_sha256 = require_controller(campaign.av)
    if campaign.av.sumo is not None:
        av_type(campaign.av.sumo)
    if campaign.av.traci is not None:
        from harness.worlds.program import require_private  # noqa: PLC0415 - imports traci

        require_private(campaign.av.traci)
    script = tried_script(campaign.av)
    resolved = replace(resolve(campaign, command), controller_sha256=controller_sha256, script=script)
    accumulator(headline_of(campaign))  # fails if an estimator of the user's own cannot be made
    if campaign.sampling.strata:
        library, accept = resolved.library, campaign.accept  # the file is read, and refused if it is wrong
        if accept is not None and accept.times_reference is not None:
            library.require_reference(accept.times_reference.driver)
    return resolved


def require_world(campaign: Campaign) -> None:
    """Refuse a machine on which SUMO's system libraries are missing, before anything is built for them."""
    if campaign.world.engine == "sumo":
        require_libraries()


def resolve(campaign: Campaign, command: Command = "run") -> Resolved:
    """Read what a campaign names, and refuse what does not go together (`harness.campaign.campaign.REFUSED`).

    Raises `CampaignError`: a file that it names is missing or wrong, or something of the campaign does not go with the
    command.
    """
    if campaign.scenarios is not None:
        mend = f"Write --scenario {campaign.scenarios[0]}, or `harness run`, which does all."
        raise CampaignError("scenarios", ", ".join(campaign.scenarios), "one scenario", mend)
    family = family_named(campaign.scenario)
    parameters = family.parameters(campaign.environment)
    environment = family.traffic(campaign.environment, parameters)
    shows = family.shows(environment)
    if (words := refusal(campaign, Use(command, shows, family.follows))) is not None:
        raise CampaignError(*words)
    challenge = campaign.testing.challenge
    if campaign.testing.own_challenge is not None:
        challenge = source_of_own(challenge, "testing.challenge")
    for name, code in campaign.own_surrogates.items():
        challenge += " " + source_of_own(code, f"surrogates.{name}")
    campaign = campaign.replaced(("pool", "library"), campaign.pool.library or family.ladders[shows])
    campaign = campaign.replaced(("pool", "relative_error"), campaign.pool.relative_error or family.pool_error)
    campaign = campaign.replaced(("environment", "parameters"), campaign.environment.named(family.default_parameters))
    return Resolved(
        campaign,
        parameters,
        environment,
        av_records(campaign.av, see_onset=shows),
        library_records([*campaign.surrogates.values()], see_onset=False),
        challenge,
        campaign.content_hash(parameters.content_hash(), challenge),
    )
