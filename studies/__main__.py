"""The command ``python -m studies``, for those who develop `harness` or doubt it; run from a checkout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from harness.cli import main as run_main
from harness.commands.options import CAMPAIGN, FILE, FOLDER, progress_bar, quiet_option, written_file
from harness.commands.printing import print_table, say
from harness.errors import HarnessError

_out_option = click.option("--out", "folder", type=FOLDER, required=True, help="Folder of the results; may be new.")
_workers_option = click.option("--workers", type=click.IntRange(min=1), help="Processes. Default: one per core.")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
def cli() -> None:
    """Studies of the methods behind `harness`.

    Exit codes are those of `harness`: 0 done; 1 traffic is not as published; 2 the file or the call is wrong; 130
    interrupted by Ctrl-C.
    """


@cli.command()
@click.argument("experiment_file", metavar="EXPERIMENT", type=CAMPAIGN)
@_out_option
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Instead of what the file says.")
@_workers_option
@quiet_option
def validate(experiment_file: Path, folder: Path, overrides: Sequence[str], workers: int | None) -> None:
    """Repeat the campaign of EXPERIMENT thousands of times, to see what its intervals are worth.

    Printed is a line per vehicle, pair or chain, and result: the truth; bias over it; mean squared error over the
    truth's square (relvar), true and as claimed; the share of intervals that hold the truth, and p of so low a coverage
    if intervals were right, for as many lines (too low below 0.05); tests; alarm, the share of campaigns with a crash
    outside the library's boundary; refused, the share without an interval, as crashes lie on too few paths, which count
    as covered. results.json has these with their errors.
    """
    from studies.replication.experiment import load_experiment

    experiment = load_experiment(experiment_file, overrides)
    from studies.replication import run  # slow to import: once the file is right

    with (bar := progress_bar()):
        judgements = run.validate(experiment, folder, workers, bar)
    rows = [{key: one[key] for key in run.SHOWN} for one in judgements]
    print_table(f"{experiment.replications:,} replications", rows)
    say(folder / run.RESULTS)


@cli.command()
@click.argument("study_file", metavar="STUDY", type=CAMPAIGN)
@_out_option
@click.option("--quick", is_flag=True, help="The sizes of the file's own section quick, too small for conclusions.")
@_workers_option
@quiet_option
def case(study_file: Path, folder: Path, *, quick: bool, workers: int | None) -> None:
    """Reproduce a paper's case study: the steps of STUDY that are not in the folder yet, and a page of answers.

    A second run makes nothing again, a killed one goes on, and a change in the file makes only what it concerns. The
    folder receives case_study.md, claims.json (the verdicts) and plots/.
    """
    from studies.case_study.study import load_study

    asked = load_study(study_file, quick=quick)
    try:
        from studies.case_study.steps import run_study
    except ModuleNotFoundError as error:
        mend = "Install it, in the harness's folder: pip install -c requirements.lock -e '.[studies]'."
        raise HarnessError("studies case", f"no package {error.name}", "the extra 'studies'", mend) from error

    with (bar := progress_bar()):
        done = run_study(asked, folder, workers, bar)
    for name, seconds in done["seconds"].items():
        say(f"{name}: " + ("there already" if seconds is None else f"{seconds:.1f} s"))
    say(done["page"])


@cli.command()
@click.argument("environment")
@click.option("--out", "file", type=FILE, callback=written_file(".parquet", ".csv"), required=True, help="To write.")
@click.option("--hours", type=click.FloatRange(0, 1000, min_open=True), default=10.0, help="Vehicle-hours.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, help="Of all random numbers.")
@click.option("--level", type=click.FloatRange(0, 1e8, min_open=True), default=1000.0, help="Of lane changing.")
def trajectories(environment: str, file: Path, *, hours: float, seed: int, level: float) -> None:
    """Make trajectories of ENVIRONMENT, a shipped name or a file of your own, to try `harness fit` on.

    Vehicles differ, and are measured with errors that change slowly (0.1 m, 0.1 m/s). A level of 270 makes lane changes
    of the shipped environments about as frequent as on motorways.
    """
    from harness.campaign.sections import EnvironmentSettings
    from harness.families.cut_in.loading import load_environment
    from studies.trajectories import Differences, simulate, write

    settings = EnvironmentSettings(parameters=environment, lane_change_level=level)
    table = simulate(load_environment(settings), hours, seed, Differences())
    write(table, file)
    say(f"{file}: {len(table):,} rows")


@cli.command()
@click.argument("environment", default="ndd-overtaking-2")
@click.pass_context
def traffic(ctx: click.Context, environment: str) -> None:
    """Put ENVIRONMENT, a shipped name or a file of your own, beside published figures (studies/published.yaml)."""
    from studies.traffic import beside_published

    rows = beside_published(environment)
    print_table(f"{Path(environment).stem} beside what is published", rows)
    ctx.exit(int(any(row["verdict"] == "fail" for row in rows)))


@cli.command()
@_out_option
@click.option("--hours", type=click.FloatRange(5), multiple=True, default=(10.0, 100.0), help="Of a data set.")
@click.option("--data-sets", "n", type=click.IntRange(min=10), default=200, help="Of each size.")
@click.option("--replicates", "n_replicates", type=click.IntRange(min=20), default=100, help="Of each data set.")
@quiet_option
def roundtrip(folder: Path, *, hours: Sequence[float], n: int, n_replicates: int) -> None:
    """Fit simulated trajectories again and again: how often errors of `harness fit` hold what was put in.

    Two hours on one core. A second run goes on where the first was killed. The folder receives roundtrip.json.
    """
    from studies.roundtrip import judged_data_sets

    with (bar := progress_bar()):
        say(judged_data_sets(folder, hours, n, n_replicates, bar))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_main(arguments, cli, "python -m studies")


if __name__ == "__main__":
    raise SystemExit(main())
