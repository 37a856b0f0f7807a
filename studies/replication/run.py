"""Run a replication experiment: repeat the campaign or comparison of each of its subjects, judge, write results.

The folder receives results.json, and all replications as Parquet.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path

import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.estimators.estimate import finite_json
from harness.families.cut_in.loading import load_environment
from harness.pool.shells import acceleration_limit
from harness.progress import Progress
from harness.records.folder import require_place, write_json
from harness.strata import LIBRARY_STATEMENT
from harness.vehicles.library import Library, load_library
from studies.chains.chain import CHAINS, Chain
from studies.chains.shells import ChainShells
from studies.replication import populations, shells
from studies.replication.experiment import Experiment
from studies.replication.judgement import Judgement, Row, Subject, corrected, judge
from studies.replication.populations import CONDITIONAL_DIFFERENCE, RATE, Drivers, Known, SuperPopulation, Truths
from studies.replication.shells import Division
from studies.replication.weighted import WeightedCampaign, chain_episodes, twin_episodes
from studies.work import results_of, worker_processes, write_table

TASKS_PER_SUBJECT = 8
RESULTS, REPLICATIONS = "results.json", "replications.parquet"
SHOWN = (
    *("subject", "result", "truth", "bias", "true_relvar", "claimed_relvar"),
    *("coverage", "p_value_holm", "tests_median", "alarm", "refused"),
)
"""What a terminal shows of a judgement."""


Repeated = shells.ShellCampaign | shells.PairedCampaign | WeightedCampaign
"""A campaign that can be repeated, in any process."""
Tested = tuple[Subject, Repeated]


def validate(experiment: Experiment, folder: Path, workers: int | None, progress: Progress) -> list[Judgement]:
    """Repeat, judge, and write the results into a folder, whose earlier ones are replaced.

    Worker processes, one per core by default, change no bit.
    """
    require_place(folder)
    n, found = experiment.replications, dict[Subject, list[Row]]()
    size = -(-n // TASKS_PER_SUBJECT)
    jobs = [range(first, min(first + size, n)) for first in range(0, n, size)]
    with worker_processes(workers) as executor:
        for subject, repeated in list(subjects(experiment, executor, progress)):
            parts = results_of(f"replications of {subject.name}", jobs, repeated.run, progress, executor)
            found[subject] = [row for part in parts for row in part]
    judgements = corrected(
        [
            judge(subject, result, [row for row in rows if row.result == result], experiment.nominal_of(result))
            for subject, rows in found.items()
            for result in dict.fromkeys(row.result for row in rows)
        ]
    )
    table = [{"subject": subject.name, **asdict(row)} for subject, rows in found.items() for row in rows]
    write_table(folder / REPLICATIONS, pa.Table.from_pylist(table))
    content = {
        "experiment": experiment.model_dump(mode="json"),
        "confidence": experiment.nominal,
        "truth": "exact, by backward induction" if experiment.chains else "independent enumeration with another seed",
        "subjects": [asdict(subject) for subject in found],
        "judgements": judgements,
    }
    write_json(folder / RESULTS, finite_json(content))  # of what never crashes nothing relative is known
    return judgements


def subjects(experiment: Experiment, executor: Executor, progress: Progress) -> Iterator[Tested]:
    """All subjects, in the order of the file, those of vehicles that act before the cut-in last."""
    yield from (_chain(experiment, place, CHAINS[name]) for place, name in enumerate(experiment.chains))
    if experiment.holding:
        yield from _holding(experiment, progress)
    if experiment.acting and not experiment.pairs:
        size, seeds = experiment.super_population, (experiment.seed + 1, experiment.seed)
        sizes = zip(seeds, (size.reference_paths, size.paths), strict=True)
        walked = [populations.choose_paths(experiment.campaign, seed, n, progress) for seed, n in sizes if n]
        for name in experiment.acting:
            campaign = experiment.subject(name)
            pools = populations.walk_paths(campaign, walked[-1], executor, progress, 1)
            truth = populations.walk_paths(campaign, walked[0], executor, progress) if size.reference_paths else None
            yield _acting(experiment, name, truth, pools)


def _chain(experiment: Experiment, place: int, chain: Chain) -> Tested:
    campaign, seed, rate = experiment.campaign, experiment.seed_of(place), Known.exactly(chain.crash_rate)
    if (method := campaign.testing.method) == "shells":
        source = ChainShells(chain, experiment.super_population.pool_paths)
        own = source.draw, seed, {RATE: rate}, rate.value, source.crashes_outside
        return _of_shells(experiment, campaign, chain.name, *own)
    episodes = partial(chain_episodes, chain, method, seed)
    return Subject(chain.name, rate), WeightedCampaign(campaign, episodes, experiment.results)


def _holding(experiment: Experiment, progress: Progress) -> Iterator[Tested]:
    """Vehicles that keep their speed before the cut-in, all enumerated together, or comparisons of these."""
    campaign, size, pairs = experiment.campaign, experiment.super_population, experiment.pairs
    environment, library = load_environment(campaign.environment), load_library(campaign.pool.library)
    drivers = Drivers.of(library, experiment.holding, see_onset=environment.lateral.present)
    together = [{pair.a, pair.b} & {*drivers.vehicles} for pair in pairs.values()]
    enumerated = partial(populations.enumerate_paths, environment, progress)
    if campaign.testing.method == "shells" and not (pairs or size.reference_paths):
        yield from _single(experiment, library, drivers, None, enumerated(drivers, experiment.seed, size.paths))
        return
    truths = Truths(enumerated, drivers, experiment.seed + 1, size.reference_paths, together)
    if campaign.testing.method == "shells":
        pools = enumerated(drivers, experiment.seed, size.paths)
        yield from (_pairs if pairs else _single)(experiment, library, drivers, truths, pools)
        return
    for name in experiment.holding:
        tested = experiment.subject(name)
        episodes = twin_episodes(tested, _seed(experiment, name), experiment.results)
        yield Subject(name, truths.vehicle(name)[RATE]), WeightedCampaign(tested, episodes, experiment.results)


def _acting(experiment: Experiment, name: str, truth: SuperPopulation | None, pools: SuperPopulation) -> Tested:
    """A vehicle that acts before the cut-in, by the paths that it has walked."""
    campaign = experiment.subject(name)
    library, limit = load_library(campaign.pool.library), acceleration_limit(campaign.av)
    vehicle = {library.n_drivers: 1.0}
    crashing, references = pools.crash_mass(vehicle), populations.reference_drivers(library)
    if truth is None:
        known = _exactly(populations.of_vehicle(pools, crashing, references))
    else:
        known = populations.of_vehicle(truth, truth.crash_mass(vehicle), references)
    division = Division(library, pools, [crashing], campaign.pool.shadow_paths, limit_mps2=limit, shadow_runs=True)
    return _vehicle(experiment, name, division.of_vehicle(crashing), known)


def _seed(experiment: Experiment, name: str) -> int:
    return experiment.seed_of(list(experiment.avs).index(name))


def _vehicle(experiment: Experiment, name: str, source: shells.OvertakingShells, known: Mapping[str, Known]) -> Tested:
    """A vehicle by what is known about it, its crash rate among it; adversaries have the seed of what they are of."""
    of = experiment.adversaries[name].of if name in experiment.adversaries else name
    own = source.draw, _seed(experiment, of), known, source.crash_rate, source.crashes_outside(source.crashing[0])
    unit = 1.0 if experiment.beside is None else source.reference_rate(experiment.beside)
    return _of_shells(experiment, experiment.subject(of), name, *own, unit)


def _of_shells(
    experiment: Experiment,
    campaign: Campaign,
    name: str,
    draw: shells.Draw,
    seed: int,
    known: Mapping[str, Known],
    own_rate: float,
    beyond: float,
    unit: float = 1.0,
) -> Tested:
    """A subject whose bounds and limits are judged by its own rate, that of the population which pools are drawn from.

    ``beyond`` is the share of that rate beyond the library's boundary, ``unit`` what limits are multiples of.
    """
    limits, budgets = {factor: factor * own_rate / unit for factor in experiment.limits}, experiment.all_budgets
    limits |= {limit * unit / own_rate: limit for limit in experiment.verdicts}
    decisions = [result for pair in product(limits, budgets) for result in shells.limit_at(*pair)]
    assumes = campaign.testing.shells.statement == LIBRARY_STATEMENT
    outside = dict.fromkeys([shells.WITHIN, *(decisions if assumes else ())], beyond)
    others = {result: value for result, value in known.items() if result != RATE}
    others |= dict.fromkeys([shells.BOUND, *decisions], Known.exactly(own_rate))
    others[shells.BOUND_OUTSIDE] = Known(beyond * own_rate, 0.0, own_rate)
    subject = Subject(name, known[RATE], others, outside)
    more_of = experiment.siblings, experiment.beside, bool(experiment.verdicts)
    return subject, shells.ShellCampaign(campaign, draw, seed, limits, budgets, *more_of)


def _exactly(known: Mapping[str, Known]) -> dict[str, Known]:
    """What a population says about itself."""
    return {name: replace(each, std_error=0.0) for name, each in known.items()}


def _single(
    experiment: Experiment, library: Library, drivers: Drivers, truths: Truths | None, pools: SuperPopulation
) -> Iterator[Tested]:
    """Each vehicle, followed by the adversaries that are made of it; without ``truths`` the pools' own."""
    paths = experiment.super_population.pool_paths
    for name, av in experiment.holding.items():
        crashing = pools.crash_mass(drivers.vehicles[name])
        division = Division(library, pools, [crashing], paths, limit_mps2=acceleration_limit(av))
        own = truths.vehicle(name) if truths else _exactly(populations.of_vehicle(pools, crashing, drivers.references))
        yield _vehicle(experiment, name, division.of_vehicle(crashing), own)
        for made_name, made in experiment.adversaries.items():
            if made.of == name:
                of_adversary = division.as_adversary(made, crashing)
                known = _exactly(populations.of_vehicle(pools, of_adversary, drivers.references))
                yield _vehicle(experiment, made_name, division.of_vehicle(of_adversary, made), known)


def _pairs(
    experiment: Experiment, library: Library, drivers: Drivers, truths: Truths, pools: SuperPopulation
) -> Iterator[Tested]:
    """Each comparison."""
    library, paths = library.model_copy(update={"references": {}}), experiment.super_population.pool_paths
    for place, (name, pair) in enumerate(experiment.pairs.items()):
        both, made = [pair.a, pair.b], experiment.adversaries
        base = [made[one].of if one in made else one for one in both]
        of_base = [pools.crash_mass(drivers.vehicles[one]) for one in base]
        limit = max(acceleration_limit(experiment.avs[one]) for one in base)
        division = Division(library, pools, of_base, paths, limit_mps2=limit)
        a, b = (
            division.as_adversary(made[one], crashing) if one in made else crashing
            for one, crashing in zip(both, of_base, strict=True)
        )
        known = truths.pair(*both) if both == base else _exactly(populations.of_pair(pools, a, b))
        source, scale = division.of_pair(a, b), known[CONDITIONAL_DIFFERENCE].scale
        # Shares of the larger rate, as widths are; what only one of them does counts, whichever it is.
        differing = source.crashing[1] + source.crashing[2]
        rate = float(differing.sum()) / len(differing)
        outside = {CONDITIONAL_DIFFERENCE: source.crashes_outside(differing) * rate / scale}
        repeated = shells.PairedCampaign(experiment.subject(base[0]), source.draw, experiment.seed_of(place))
        yield Subject(name, Known.exactly(scale), dict(known), outside), repeated
