"""What an experiment repeats: a campaign or comparison for each of its subjects, and what is known about that."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations

from harness.campaign.campaign import Campaign
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.strata import LIBRARY_STATEMENT
from harness.traffic.loading import load_environment
from harness.vehicles.library import Library, load_library
from harness.vocabulary import FloatArray
from studies.chains.chain import CHAINS
from studies.chains.shells import ChainShells
from studies.replication.experiment import Experiment
from studies.replication.judgement import Subject
from studies.replication.populations import (
    CONDITIONAL_DIFFERENCE,
    RATE,
    Drivers,
    Known,
    SuperPopulation,
    Truths,
    choose_paths,
    enumerate_paths,
    of_pair,
    of_vehicle,
    reference_drivers,
    walk_paths,
)
from studies.replication.shells import (
    BOUND,
    Division,
    Draw,
    OvertakingShells,
    PairedCampaign,
    ShellCampaign,
    bound_outside,
    limit_at,
    result_of,
)
from studies.replication.weighted import WeightedCampaign, chain_episodes, twin_episodes

Repeated = ShellCampaign | PairedCampaign | WeightedCampaign
"""A campaign that can be repeated, in any process."""
Tested = tuple[Subject, Repeated]


def subjects(experiment: Experiment, executor: Executor, progress: Progress) -> Iterator[Tested]:
    """All subjects, in the order of the file, those of vehicles that act before the cut-in last."""
    if experiment.chains:
        yield from _chains(experiment)
        return
    if experiment.holding:
        yield from _holding(experiment, progress)
    if experiment.acting and not experiment.pairs:
        size, seeds = experiment.super_population, (experiment.seed + 1, experiment.seed)
        sizes = zip(seeds, (size.reference_paths, size.paths), strict=True)
        walked = [choose_paths(experiment.campaign, seed, n_paths, progress) for seed, n_paths in sizes]
        for name in experiment.acting:
            campaign = experiment.subject(name)
            yield _acting(experiment, name, *(walk_paths(campaign, paths, executor, progress) for paths in walked))


def _chains(experiment: Experiment) -> Iterator[Tested]:
    campaign, method = experiment.campaign, experiment.campaign.testing.method
    for place, name in enumerate(experiment.chains):
        chain, seed = CHAINS[name], experiment.seed_of(place)
        if method == "shells":
            source, rate = ChainShells(chain, experiment.super_population.pool_paths), chain.crash_rate
            share = {LIBRARY_STATEMENT: source.crashes_outside}
            outside = {result_of(each): value for each, value in share.items()}
            subject = Subject.exact(name, rate, others=_of_population(experiment, rate, share), crashes_outside=outside)
            yield _of_shells(experiment, campaign, source.draw, seed, subject, rate)
        else:
            episodes = partial(chain_episodes, chain, method, seed)
            yield Subject.exact(name, chain.crash_rate), WeightedCampaign(campaign, episodes, experiment.results)


def _holding(experiment: Experiment, progress: Progress) -> Iterator[Tested]:
    """Vehicles that keep their speed before the cut-in, all enumerated together, or comparisons of these."""
    campaign, size = experiment.campaign, experiment.super_population
    environment, library = load_environment(campaign.environment), load_library(campaign.pool.library)
    drivers = Drivers.of(library, experiment.holding, see_onset=environment.lateral.present)
    together: dict[str, set[str]] = {}
    for one, other in [each for pair in experiment.pairs.values() for each in permutations((pair.a, pair.b))]:
        together.setdefault(one, set()).update({other} & set(drivers.vehicles))
    truths = Truths(environment, drivers, experiment.seed + 1, size.reference_paths, progress, together)
    if campaign.testing.method == "shells":
        pools = enumerate_paths(environment, drivers, experiment.seed, size.paths, progress)
        shells = _Shells(experiment, library, drivers, truths, pools)
        yield from shells.pairs() if experiment.pairs else shells.single()
        return
    for name in experiment.holding:
        seed = experiment.seed_of(list(experiment.avs).index(name))
        tested, known = experiment.subject(name), truths.vehicle(name)[RATE]
        episodes = twin_episodes(tested, seed, experiment.results)
        yield Subject(name, known), WeightedCampaign(tested, episodes, experiment.results)


def _of_shells(
    experiment: Experiment, campaign: Campaign, draw: Draw, seed: int, subject: Subject, own_rate: float
) -> Tested:
    limits = {factor: factor * own_rate for factor in experiment.limits}
    return subject, ShellCampaign(campaign, draw, seed, limits, siblings=experiment.siblings)


def _of_population(experiment: Experiment, own_rate: float, outside: Mapping[str, float]) -> dict[str, Known]:
    """What bounds and limits are judged by: rates of the population that pools are drawn from, without error.

    ``outside`` is the share of the crash rate beyond the boundary of each statement.
    """
    names = [BOUND, *(name for factor in experiment.limits for name in limit_at(factor))]
    found = dict.fromkeys(names, Known(own_rate, 0.0, own_rate))
    return found | {bound_outside(each): Known(share * own_rate, 0.0, own_rate) for each, share in outside.items()}


def _vehicle(
    experiment: Experiment, campaign: Campaign, name: str, source: OvertakingShells, known: Mapping[str, Known]
) -> Tested:
    """A vehicle by what is known about it, its crash rate among it; adversaries have the seed of what they are of."""
    share, own_rate = source.crashes_outside(source.crashing[0]), source.crash_rate
    outside = {result_of(each): value for each, value in share.items()}
    asked = outside.get(result_of(campaign.testing.shells.statement), 0.0)
    outside |= {result: asked for factor in experiment.limits for result in limit_at(factor)}
    others = {result: value for result, value in known.items() if result != RATE}
    others |= _of_population(experiment, own_rate, share)
    of = experiment.adversaries[name].of if name in experiment.adversaries else name
    subject = Subject(name, known[RATE], others, outside, source.left_out, source.template.library.boundary)
    seed = experiment.seed_of(list(experiment.avs).index(of))
    return _of_shells(experiment, campaign, source.draw, seed, subject, own_rate)


def _exactly(known: Mapping[str, Known]) -> dict[str, Known]:
    """What a population says about itself."""
    return {name: replace(each, std_error=0.0) for name, each in known.items()}


@dataclass(frozen=True, eq=False)
class _Shells:
    """Vehicles that keep their speed before the cut-in, and paths for their pools."""

    experiment: Experiment
    library: Library
    drivers: Drivers
    truths: Truths
    pools: SuperPopulation

    def single(self) -> Iterator[Tested]:
        """Each vehicle, followed by the adversaries that are made of it."""
        experiment = self.experiment
        for name, av in experiment.holding.items():
            tested, crashing = experiment.subject(name), self.pools.crash_mass(self.drivers.vehicles[name])
            division = self._division(crashing, limit_mps2=acceleration_limit(av))
            yield _vehicle(experiment, tested, name, division.of_vehicle(crashing), self.truths.vehicle(name))
            for made_name, made in experiment.adversaries.items():
                if made.of == name:
                    of_adversary = division.as_adversary(made, crashing)
                    source = division.of_vehicle(of_adversary, made)
                    known = _exactly(of_vehicle(self.pools, of_adversary, self.drivers.references))
                    yield _vehicle(experiment, tested, made_name, source, known)

    def pairs(self) -> Iterator[Tested]:
        """Each comparison."""
        experiment = self.experiment
        for place, (name, pair) in enumerate(experiment.pairs.items()):
            both = [pair.a, pair.b]
            adversaries = [experiment.adversaries.get(one) for one in both]
            base = [one if made is None else made.of for one, made in zip(both, adversaries, strict=True)]
            of_base = [self.pools.crash_mass(self.drivers.vehicles[one]) for one in base]
            limit = max(acceleration_limit(experiment.avs[one]) for one in base)
            division = self._division(*of_base, limit_mps2=limit)
            a, b = (
                crashing if made is None else division.as_adversary(made, crashing)
                for made, crashing in zip(adversaries, of_base, strict=True)
            )
            known = self.truths.pair(*both) if both == base else _exactly(of_pair(self.pools, a, b))
            source, scale = division.of_pair(a, b), known[CONDITIONAL_DIFFERENCE].scale
            # Shares of the larger rate, as widths are; what only one of them does counts, whichever it is.
            differing = source.crashing[1] + source.crashing[2]
            rate = float(differing.sum()) / len(differing)
            outside = {CONDITIONAL_DIFFERENCE: source.crashes_outside(differing)[LIBRARY_STATEMENT] * rate / scale}
            facts = dict(known), outside, source.left_out, source.template.library.boundary
            campaign, seed = experiment.subject(base[0]), experiment.seed_of(place)
            yield Subject(name, Known(scale, 0.0, scale), *facts), PairedCampaign(campaign, source.draw, seed)

    def _division(self, *crashing: FloatArray, limit_mps2: float) -> Division:
        library, paths = self.library, self.experiment.super_population.pool_paths
        if self.experiment.pairs:
            library = library.model_copy(update={"references": {}})
        return Division(library, self.pools, crashing, paths, limit_mps2=limit_mps2)


def _acting(experiment: Experiment, name: str, truth: SuperPopulation, pools: SuperPopulation) -> Tested:
    """A vehicle that acts before the cut-in, by the paths that it has walked."""
    campaign = experiment.subject(name)
    library, limit = load_library(campaign.pool.library), acceleration_limit(campaign.av)
    vehicle = {library.n_drivers: 1.0}
    known = of_vehicle(truth, truth.crash_mass(vehicle), reference_drivers(library))
    crashing, paths = pools.crash_mass(vehicle), campaign.pool.shadow_paths
    division = Division(library, pools, [crashing], paths, limit_mps2=limit, shadow_runs=True)
    return _vehicle(experiment, campaign, name, division.of_vehicle(crashing), known)
