"""The vehicles or chains of an experiment: what is known about each, and how its campaign is repeated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from harness.campaign.models import Campaign
from harness.environment.loading import load_environment
from harness.methods import EstimatorName
from harness.pool.library import load_library
from harness.progress import Progress
from harness.studies.chains.named import CHAINS
from harness.studies.chains.shells import ChainShells
from harness.studies.experiment import Experiment
from harness.studies.judgement import Subject
from harness.studies.panel import Drivers
from harness.studies.rows import Row
from harness.studies.shell_campaign import ShellCampaign
from harness.studies.shell_source import OvertakingShells, overtaking_shells
from harness.studies.super_population import SuperPopulation, enumerate_paths
from harness.studies.truth import truths
from harness.studies.weighted_campaign import ChainEpisodes, EpisodeSource, TwinEpisodes, WeightedCampaign


class Repeated(Protocol):
    """A campaign that can be repeated, in any process."""

    def run(self, replications: range) -> list[Row]:
        """Rows of some replications."""
        ...


@dataclass(frozen=True, eq=False)
class RepeatedShells:
    """Shells on drawn pools."""

    campaign: ShellCampaign

    def run(self, replications: range) -> list[Row]:
        """See `Repeated`."""
        return [row for replication in replications for row in self.campaign.run(replication)]


@dataclass(frozen=True, eq=False)
class RepeatedWeighted:
    """Weighted crashes; a process prepares the campaign once."""

    name: str
    campaign: Campaign
    seed: int
    estimators: tuple[EstimatorName, ...]
    is_chain: bool

    def run(self, replications: range) -> list[Row]:
        """See `Repeated`."""
        source = _episodes(self.name, self.campaign.model_dump_json(), self.seed, self.is_chain, self.estimators)
        return WeightedCampaign(self.campaign, source, self.estimators).run(replications)


@cache
def _episodes(
    name: str, campaign_json: str, seed: int, is_chain: bool, estimators: tuple[EstimatorName, ...]
) -> EpisodeSource:
    campaign = Campaign.model_validate_json(campaign_json)
    if is_chain:
        return ChainEpisodes(CHAINS[name], campaign, seed)
    return TwinEpisodes(campaign, seed, estimators)


def subjects(experiment: Experiment, progress: Progress) -> Iterator[tuple[Subject, Repeated]]:
    """All that is to be repeated, in the order of the file."""
    if experiment.chains:
        yield from _chains(experiment)
    else:
        yield from _vehicles(experiment, progress)


def _seed(experiment: Experiment, place: int) -> int:
    """Seed of a subject's own."""
    return experiment.seed * 1000 + place


def _chains(experiment: Experiment) -> Iterator[tuple[Subject, Repeated]]:
    campaign = experiment.campaign
    for place, name in enumerate(experiment.chains):
        chain, seed = CHAINS[name], _seed(experiment, place)
        if campaign.testing.method == "shells":
            source = ChainShells(chain, experiment.super_population.pool_paths)
            subject = Subject(name, chain.crash_rate, crashes_outside=source.crashes_outside)
            yield subject, RepeatedShells(ShellCampaign(campaign, source, seed, experiment.fault))
        else:
            repeated = RepeatedWeighted(name, campaign, seed, experiment.results, is_chain=True)
            yield Subject(name, chain.crash_rate), repeated


def _vehicles(experiment: Experiment, progress: Progress) -> Iterator[tuple[Subject, Repeated]]:
    campaign, size = experiment.campaign, experiment.super_population
    environment, library = load_environment(campaign.environment), load_library(campaign.pool.library)
    drivers = Drivers(library, experiment.avs)
    shells = campaign.testing.method == "shells"
    pools: SuperPopulation | None = None
    if shells:
        pools = enumerate_paths(environment, drivers.records, drivers.envelope, experiment.seed, size.paths, progress)
    known = truths(environment, drivers, experiment.seed + 1, size.reference_paths, progress)
    for place, (name, av) in enumerate(experiment.avs.items()):
        vehicle, seed, truth = drivers.vehicles[name], _seed(experiment, place), known[name]
        if pools is None:
            repeated = RepeatedWeighted(name, experiment.subject(name), seed, experiment.results, is_chain=False)
            yield Subject(name, truth.crash_rate, truth.std_error), repeated
            continue
        source: OvertakingShells = overtaking_shells(library, pools, av, vehicle, size.pool_paths)
        subject = Subject(
            name, truth.crash_rate, truth.std_error, source.crashes_outside, source.left_out, source.boundary
        )
        yield subject, RepeatedShells(ShellCampaign(experiment.subject(name), source, seed, experiment.fault))
