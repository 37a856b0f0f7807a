"""What an experiment repeats: a campaign or comparison for each of its subjects, and what is known about that."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from harness.arrays import FloatArray
from harness.campaign.models import Campaign
from harness.environment.loading import load_environment
from harness.pool.library import Library, load_library
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.strata import LIBRARY_STATEMENT
from harness.studies.chains.named import CHAINS
from harness.studies.chains.shells import ChainShells
from harness.studies.experiment import Experiment
from harness.studies.judgement import Subject
from harness.studies.paired_campaign import PairedCampaign
from harness.studies.shell_campaign import ShellCampaign, ShellSource, limit_at, result_of
from harness.studies.shell_source import Division, OvertakingShells
from harness.studies.super_population import Drivers, Mixed, SuperPopulation, enumerate_paths, reference_drivers
from harness.studies.truths import CONDITIONAL_DIFFERENCE, RATE, Known, Truths, of_pair, of_vehicle
from harness.studies.walked_population import Choose, chooser, walk_paths
from harness.studies.weighted_campaign import ChainEpisodes, TwinEpisodes, WeightedCampaign

Repeated = ShellCampaign | PairedCampaign | WeightedCampaign
"""A campaign that can be repeated, in any process."""
Tested = tuple[Subject, Repeated]


def subjects(experiment: Experiment, executor: Executor, progress: Progress) -> Iterator[Tested]:
    """All subjects, in the order of the file, those of vehicles that act before the cut-in last."""
    if experiment.chains:
        yield from _chains(experiment)
        return
    if experiment.holding:
        held = _Held.of(experiment, progress)
        yield from held.pairs() if experiment.pairs else held.single()
    if experiment.acting and not experiment.pairs:
        choose = chooser(experiment.campaign, progress)
        for name in experiment.acting:
            yield _acting(experiment, name, choose, executor, progress)


def _chains(experiment: Experiment) -> Iterator[Tested]:
    campaign, method = experiment.campaign, experiment.campaign.testing.method
    for place, name in enumerate(experiment.chains):
        chain, seed = CHAINS[name], experiment.seed_of(place)
        if method == "shells":
            source = ChainShells(chain, experiment.super_population.pool_paths)
            outside = {result_of(LIBRARY_STATEMENT): source.crashes_outside}
            subject = Subject.exact(name, chain.crash_rate, crashes_outside=outside)
            yield subject, _repeated(experiment, campaign, source, seed, subject)
        else:
            episodes = ChainEpisodes(chain, method, seed)
            yield Subject.exact(name, chain.crash_rate), WeightedCampaign(campaign, episodes, experiment.results)


def _repeated(
    experiment: Experiment, campaign: Campaign, source: ShellSource, seed: int, subject: Subject
) -> ShellCampaign:
    limits = {limit_at(factor): factor * subject.crash_rate.value for factor in experiment.limits}
    return ShellCampaign(campaign, source, seed, experiment.fault, limits)


def _subject(experiment: Experiment, name: str, source: OvertakingShells, known: Mapping[str, Known]) -> Subject:
    """A vehicle by what is known about it, its crash rate among it."""
    outside = {result_of(each): share for each, share in source.cells.crashes_outside(source.crashing).items()}
    asked = result_of(experiment.campaign.testing.shells.statement)
    outside |= {limit_at(factor): outside.get(asked, 0.0) for factor in experiment.limits}
    others = {result: value for result, value in known.items() if result != RATE}
    facts = outside, source.cells.left_out, source.cells.template.library.boundary
    return Subject(name, known[RATE], others, *facts)


def _exactly(known: Mapping[str, Known]) -> dict[str, Known]:
    """What a population says about itself."""
    return {name: replace(each, std_error=0.0) for name, each in known.items()}


@dataclass(frozen=True, eq=False)
class _Held:
    """Vehicles that keep their speed before the cut-in, all enumerated together."""

    experiment: Experiment
    library: Library
    drivers: Drivers
    truths: Truths
    pools: SuperPopulation | None

    @classmethod
    def of(cls, experiment: Experiment, progress: Progress) -> _Held:
        campaign, size, seed = experiment.campaign, experiment.super_population, experiment.seed
        environment, library = load_environment(campaign.environment), load_library(campaign.pool.library)
        drivers, pools = Drivers.of(library, experiment.holding, see_onset=environment.lateral.present), None
        if campaign.testing.method == "shells":
            pools = enumerate_paths(environment, drivers, seed, size.paths, progress)
        together: dict[str, set[str]] = {}
        for pair in experiment.pairs.values():
            for one, other in ((pair.a, pair.b), (pair.b, pair.a)):
                together.setdefault(one, set()).update({other} & set(drivers.vehicles))
        where = environment, drivers, seed + 1, size.reference_paths, progress
        return cls(experiment, library, drivers, Truths.of(*where, together), pools)

    def single(self) -> Iterator[Tested]:
        """Each vehicle, followed by the adversaries that are made of it."""
        experiment = self.experiment
        for place, name in enumerate(experiment.avs):
            if name not in experiment.holding:
                continue
            tested, seed, known = experiment.subject(name), experiment.seed_of(place), self.truths.vehicle(name)
            if self.pools is None:
                episodes = TwinEpisodes(tested, seed, experiment.results)
                repeated = WeightedCampaign(tested, episodes, experiment.results)
                yield Subject(name, known[RATE]), repeated
                continue
            crashing = self.drivers.vehicles[name].crash_mass(self.pools)
            division = self._division(crashing, limit_mps2=acceleration_limit(tested.av))
            source = division.of_vehicle(crashing)
            subject = _subject(experiment, name, source, known)
            yield subject, _repeated(experiment, tested, source, seed, subject)
            for made_name, made in experiment.adversaries.items():
                if made.of == name:
                    of_adversary = division.as_adversary(made, crashing)
                    adversary = division.of_vehicle(of_adversary, made.failing)
                    exact = _exactly(of_vehicle(self.pools, of_adversary, self.drivers.references))
                    made_subject = _subject(experiment, made_name, adversary, exact)
                    yield made_subject, _repeated(experiment, tested, adversary, seed, made_subject)

    def pairs(self) -> Iterator[Tested]:
        """Each comparison."""
        if self.pools is None:
            raise ValueError("comparisons need pools")
        experiment = self.experiment
        for place, (name, pair) in enumerate(experiment.pairs.items()):
            both = [pair.a, pair.b]
            base = [experiment.adversaries[one].of if one in experiment.adversaries else one for one in both]
            of_base = [self.drivers.vehicles[one].crash_mass(self.pools) for one in base]
            limit = max(acceleration_limit(experiment.avs[one]) for one in base)
            division = self._division(*of_base, limit_mps2=limit)
            adversaries = [experiment.adversaries.get(one) for one in both]
            masses = [
                crashing if made is None else division.as_adversary(made, crashing)
                for made, crashing in zip(adversaries, of_base, strict=True)
            ]
            known = self.truths.pair(*both) if both == base else _exactly(of_pair(self.pools, masses[0], masses[1]))
            source, scale = division.of_pair(masses[0], masses[1]), known[CONDITIONAL_DIFFERENCE].scale
            # Shares of the larger rate, as widths are; what only one of them does counts, whichever it is.
            differing = source.crashing[1] + source.crashing[2]
            rate = float(differing.sum()) / len(differing)
            beyond = source.cells.crashes_outside(differing)[LIBRARY_STATEMENT] * rate / scale
            facts = {CONDITIONAL_DIFFERENCE: beyond}, source.cells.left_out, source.cells.template.library.boundary
            subject = Subject(name, Known(scale, 0.0, scale), dict(known), *facts)
            campaign = experiment.subject(base[0])
            yield subject, PairedCampaign(campaign, source, experiment.seed_of(place), fault=experiment.fault)

    def _division(self, *crashing: FloatArray, limit_mps2: float) -> Division:
        if self.pools is None:
            raise ValueError("shells need pools")
        library, paths = self.library, self.experiment.super_population.pool_paths
        if self.experiment.pairs:
            library = library.model_copy(update={"references": {}})
        return Division(library, self.pools, crashing, paths, limit_mps2=limit_mps2)


def _acting(experiment: Experiment, name: str, choose: Choose, executor: Executor, progress: Progress) -> Tested:
    """A vehicle that acts before the cut-in, on paths of its own."""
    campaign, size, place = experiment.subject(name), experiment.super_population, list(experiment.avs).index(name)
    library = load_library(campaign.pool.library)
    vehicle = Mixed((library.n_drivers,), (1.0,))
    truth = walk_paths(campaign, choose, experiment.seed + 1, size.reference_paths, executor, progress)
    pools = walk_paths(campaign, choose, experiment.seed, size.paths, executor, progress)
    known = of_vehicle(truth, vehicle.crash_mass(truth), reference_drivers(library))
    crashing, limit = vehicle.crash_mass(pools), acceleration_limit(campaign.av)
    paths = campaign.pool.shadow_paths
    division = Division(library, pools, [crashing], paths, limit_mps2=limit, shadow_runs=True)
    source = division.of_vehicle(crashing)
    subject = _subject(experiment, name, source, known)
    return subject, _repeated(experiment, campaign, source, experiment.seed_of(place), subject)
