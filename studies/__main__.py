"""The command ``python -m studies``: what intervals are worth, tests that the paper would ask for, its case study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from harness.cli import main as run_main
from harness.commands.options import (
    CAMPAIGN,
    FILE,
    FOLDER,
    RUN_FOLDER,
    examples,
    json_option,
    progress_bar,
    quiet_option,
    written_file,
)
from harness.commands.printing import print_json, print_table
from harness.errors import HarnessError

if TYPE_CHECKING:
    from studies.rnot import RnotEstimator

_ME = "python -m studies"
_out_option = click.option("--out", "folder", type=FOLDER, required=True, help="Folder of the results; may be new.")
_workers_option = click.option("--workers", type=click.IntRange(min=1), help="Processes. Default: one per core.")


@click.group(
    epilog=examples(
        f"{_ME} validate scenarios/validate/shells_panel.yaml --out runs/shells_panel",
        f"{_ME} case scenarios/case_study/study.yaml --out runs/quick --quick",
        f"{_ME} rnot runs/nde runs/forced",
        f"{_ME} traffic",
    ),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
def cli() -> None:
    """Studies of the methods behind `harness`, for those who develop or doubt them; run from a checkout.

    Exit codes are those of `harness`: 0 done; 1 traffic is not as published; 2 the file or the call is wrong, or the
    records do not allow what was asked for; 130 interrupted by Ctrl-C.
    """


@cli.command(
    short_help="Repeat a campaign thousands of times: what are its intervals worth?",
    epilog=examples(
        "truth        crash rate that all replications should find, or ratio, share or difference",
        "bias         mean of the estimates relative to the truth, ± its standard error; of a difference",
        "             relative to the larger of the two rates, of a share in percentage points",
        "relvar true  mean squared error of the estimates, over the square of the truth",
        "claimed      the same, as the campaigns themselves estimate it",
        "coverage     share of the intervals that hold the truth, with its 95 % interval",
        "p (Holm)     of so low a coverage if the intervals were right, for as many lines: too low below 0.05",
        "tests        that a campaign needed: median, 5 % and 95 % quantile",
        "alarm        share of replications with a crash outside the library's boundary",
        "refused      share without an interval, as crashes lie on too few paths; counted as covered",
        heading="Columns:",
    )
    + "\n\n"
    + examples(
        f"{_ME} validate scenarios/validate/shells_panel.yaml --set campaign.stop.confidence=0.99 --out x",
        f"{_ME} validate scenarios/validate/chains_forced.yaml --set replications=100 --out quick",
    ),
)
@click.argument("experiment_file", metavar="EXPERIMENT", type=CAMPAIGN)
@_out_option
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Instead of what the file says.")
@_workers_option
@quiet_option
@json_option
def validate(
    experiment_file: Path, folder: Path, overrides: Sequence[str], *, workers: int | None, as_json: bool
) -> None:
    """Repeat the campaign of EXPERIMENT for each of its vehicles, pairs or chains, and judge its intervals by that.

    Vehicles may be built-in models or, under shells, controllers that act before the cut-in: these walk all paths that
    pools are drawn from first, which takes minutes. Under shells the ratio to each reference driver of the
    library, and the share of crashes that it would have avoided, are judged as well.

    Printed is a line per vehicle and result, with the columns below. The folder receives results.json and
    replications.parquet (one row each).
    """
    from studies.replication.experiment import load_experiment  # noqa: PLC0415 - keeps --help fast

    experiment = load_experiment(experiment_file, overrides)
    from harness.estimators.estimate import finite_json  # noqa: PLC0415 - slow to import: once the file is right
    from studies.replication import run  # noqa: PLC0415

    with (bar := progress_bar()):
        judgements = run.validate(experiment, folder, workers=workers, progress=bar)
    if as_json:
        print_json(finite_json(judgements))
    else:
        print_table(f"{experiment.replications:,} replications", [run.table_row(one) for one in judgements])
        click.echo(str(folder / run.RESULTS))


@cli.command(
    name="case",
    short_help="Reproduce a paper's case study, and answer its claims.",
    epilog=examples(
        f"{_ME} case scenarios/case_study/study.yaml --out runs/quick --quick   # minutes: tiny sizes",
        f"{_ME} case scenarios/case_study/study.yaml --out runs/case_study      # 40 minutes on one core",
    ),
)
@click.argument("study_file", metavar="STUDY", type=CAMPAIGN)
@_out_option
@click.option("--quick", is_flag=True, help="The sizes of the file's own section quick, too small for conclusions.")
@_workers_option
@quiet_option
@json_option
def study(study_file: Path, folder: Path, *, quick: bool, workers: int | None, as_json: bool) -> None:
    """Make the steps of STUDY that are not in the folder yet, and the page that puts them beside the paper's numbers.

    Each step has a folder of its own under steps/, named after all that it depends on: a second run makes nothing
    again, a killed one goes on, and a change in the file makes only what it concerns. The folder receives
    case_study.md, claims.json (the verdicts) and plots/.
    """
    from studies.case_study.study import load_study  # noqa: PLC0415 - keeps --help fast

    asked = load_study(study_file, quick=quick)
    try:
        from studies.case_study.steps import run_study  # noqa: PLC0415 - slow to import: once the file is right
    except ModuleNotFoundError as error:
        mend = "Install it, in the harness's folder: pip install -c requirements.lock -e '.[studies]'."
        raise HarnessError("studies case", f"no package {error.name}", "the extra 'studies'", mend) from error

    def told(name: str, seconds: float | None) -> None:
        if not (as_json or click.get_current_context().meta["quiet"]):
            click.echo(f"{name}: " + ("there already" if seconds is None else f"{seconds:.1f} s"))

    with (bar := progress_bar()):
        done = run_study(asked, folder, workers=workers, progress=bar, told=told)
    if as_json:
        print_json(done)
    else:
        click.echo(done["page"])


_SHARE = click.FloatRange(0, 1, min_open=True, max_open=True)
_WHOSE = "Whose RHW; may be given several times. Default: nde for naturalistic runs, else nade."


@cli.command(
    short_help="How many tests the paper's procedure would ask for (RNoT, AAR).",
    epilog=examples(
        f"{_ME} rnot runs/nde runs/forced        # and the acceleration of the second over the first",
        f"{_ME} rnot runs/nade --rhw 0.1 --total 5000   # another threshold, and end of the grid",
        f"{_ME} rnot runs/nade -e nade -e scv --total 2000 --ratio 1.25   # takes minutes",
    ),
    context_settings={"show_default": True},
)
@click.argument("folders", metavar="RUN...", type=RUN_FOLDER, nargs=-1, required=True)
@click.option("--rhw", type=click.FloatRange(0, min_open=True), default=0.3, help="Relative half-width to reach.")
@click.option("--confidence", type=_SHARE, default=0.9, help="Level of the normal interval.")
@click.option("--shuffles", "n_shuffles", type=click.IntRange(min=1), default=200, help="Orderings of the tests.")
@click.option("--seed", type=click.IntRange(min=0), default=1, help="Seed of the orderings.")
@click.option("--ratio", type=click.FloatRange(1, min_open=True), default=1.05, help="From one look to the next.")
@click.option("--total", type=click.IntRange(min=2), help="Last look. Default, and at most: all tests on record.")
@click.option("-e", "estimators", type=click.Choice(["nde", "nade", "scv"]), multiple=True, help=_WHOSE)
@json_option
def rnot(folders: Sequence[Path], *, estimators: Sequence[RnotEstimator], as_json: bool, **asked: Any) -> None:
    """Count the tests that each RUN needed, the way the paper counts them; nothing is simulated.

    The tests of a run are shuffled. The required number of tests (RNoT) of a shuffle is the first look from which on
    the relative half-width is at most --rhw. Printed are its mean over all shuffles, its 5-95 % range, and the average
    acceleration ratio (AAR): the mean of the first row over that of each row. Where shuffles are above --rhw at the
    last look, the mean is a lower limit. Runs that draw from shells are refused: their tests cannot change places.

    'scv' solves its regressions anew at each look of each shuffle, which takes minutes: a larger --ratio and a smaller
    --total make it quicker. Its RHW rests on a variance that is too small.
    """
    from studies.rnot import SHOWN, Procedure, required_tests_of_runs  # noqa: PLC0415 - keeps --help fast

    with (bar := progress_bar()):
        content = required_tests_of_runs(folders, Procedure(**asked), estimators=estimators, progress=bar)
    if as_json:
        print_json(content)
        return
    print_table(
        f"Tests until RHW stays at most {content['rhw']:g} ({content['confidence']:.0%} normal interval)",
        [{key: row.get(key) for key in SHOWN} for row in content["rows"]],
    )
    for row in content["rows"]:
        for remark in [*row.get("remarks", ()), *filter(None, [row.get("reason")])]:
            click.echo(f"{row['run']} {row['estimator']}: {remark}")


@cli.command(
    short_help="Make trajectories of known traffic, to try `harness fit` on.",
    epilog=examples(
        f"{_ME} trajectories ndd-overtaking-2 --hours 10 --out data.parquet",
        f"{_ME} trajectories my-traffic.yaml --hours 0.5 --level 1 --exact --out data.csv",
    ),
    context_settings={"show_default": True},
)
@click.argument("environment", metavar="ENVIRONMENT")
@click.option("--out", "file", type=FILE, callback=written_file(".parquet", ".csv"), required=True, help="To write.")
@click.option("--hours", type=click.FloatRange(0, 1000, min_open=True), default=10.0, help="Vehicle-hours.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, help="Of all random numbers.")
@click.option("--level", type=click.FloatRange(0, 1e8, min_open=True), default=1000.0, help="Of lane changing.")
@click.option("--exact", is_flag=True, help="Vehicles that are alike, measured without error.")
def trajectories(environment: str, file: Path, *, hours: float, seed: int, level: float, exact: bool) -> None:
    """Simulate vehicles that drive and change lanes by the laws of ENVIRONMENT, a shipped name or a file of your own.

    Vehicles differ from each other, and positions and speeds are measured with errors that change slowly (0.1 m,
    0.1 m/s). The table has the columns that `harness fit` reads, lateral_m where cut-ins take time. A level of 270
    makes lane changes of the shipped environments about as frequent as on motorways.
    """
    from harness.campaign.sections import EnvironmentSettings  # noqa: PLC0415 - keeps --help fast
    from harness.families.cut_in.loading import load_environment  # noqa: PLC0415
    from studies.trajectories import ALIKE, Differences, simulate, write  # noqa: PLC0415

    settings = EnvironmentSettings(parameters=environment, lane_change_level=level)
    table = simulate(load_environment(settings), hours, seed, ALIKE if exact else Differences())
    write(table, file)
    click.echo(f"{file}: {len(table):,} rows")


@cli.command(
    short_help="Put an environment beside what is published about cut-ins and lane changes.",
    epilog=examples(f"{_ME} traffic", f"{_ME} traffic ndd-overtaking-1", f"{_ME} traffic my-traffic.yaml --json"),
    context_settings={"show_default": True},
)
@click.argument("environment", metavar="[ENVIRONMENT]", default="ndd-overtaking-2")
@json_option
@click.pass_context
def traffic(ctx: click.Context, environment: str, *, as_json: bool) -> None:
    """Compare ENVIRONMENT, a shipped name or a file of your own, with published figures (studies/published.yaml).

    Each line has the figure, the model's number and what that has to lie in, with the reason; "-" where the scenario
    or the level of lane changing does not allow to ask. The exit code is 1 where one fails.
    """
    from harness.estimators.estimate import finite_json  # noqa: PLC0415 - slow to import
    from studies.traffic import beside_published  # noqa: PLC0415

    rows = beside_published(environment)
    failed = [row for row in rows if row["verdict"] == "fail"]
    if as_json:
        print_json(finite_json(rows))
    else:
        print_table(f"{Path(environment).stem} beside what is published", [_figure_row(row) for row in rows])
        click.echo("\n".join(sorted({f"{row['source']}: {row['reference']}" for row in rows})))
        held = sum(row["verdict"] == "pass" for row in rows)
        click.echo(f"{held} pass, {len(failed)} fail, {len(rows) - held - len(failed)} not held")
    if failed:
        ctx.exit(1)


def _figure_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A line of the table for the terminal."""
    within = "" if row["within"] is None else "{:.3g} to {:.3g}".format(*row["within"])
    named = {"figure": f"{row['figure']} ({row['unit']})", "published": str(row["published"]), "model": row["model"]}
    return {**named, "within": within, "": row["verdict"], "because": row["remark"], "source": row["source"]}


@cli.command(
    short_help="Fit simulated trajectories again and again: are errors and replicates true?",
    epilog=examples(
        f"{_ME} roundtrip --out runs/roundtrip                     # two hours on one core",
        f"{_ME} roundtrip --out runs/quick --data-sets 20 --hours 10",
    ),
    context_settings={"show_default": True},
)
@_out_option
@click.option("--hours", "hours", type=click.FloatRange(5), multiple=True, default=(10.0, 100.0), help="Of a data set.")
@click.option("--data-sets", "n", type=click.IntRange(min=10), default=200, help="Of each size.")
@click.option("--replicates", "n_replicates", type=click.IntRange(min=20), default=100, help="Of each data set.")
@quiet_option
def roundtrip(folder: Path, *, hours: Sequence[float], n: int, n_replicates: int) -> None:
    """Say how often the errors of `harness fit` hold what was put in: each fitted number, and crash rates.

    Trajectories are those of `trajectories`, with vehicles that differ. Sets of 10 vehicle-hours share no recording,
    larger ones are drawn from the same recordings. A second run goes on where the first was killed. The folder
    receives roundtrip.json.
    """
    from harness.records.folder import write_json  # noqa: PLC0415 - keeps --help fast
    from studies.roundtrip import fit_data_sets, judge, rounded, table  # noqa: PLC0415

    with (bar := progress_bar()):
        for each in hours:
            fit_data_sets(folder, each, n, n_replicates, bar)
        found = judge(folder, hours, bar)
    write_json(folder / "roundtrip.json", rounded(found))
    for words, rows in table(found).items():
        print_table(words, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_main(arguments, cli, _ME)


if __name__ == "__main__":
    raise SystemExit(main())
