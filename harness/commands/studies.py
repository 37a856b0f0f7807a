"""What lies behind results: the pool of cut-ins, and what intervals are worth."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import click

from harness.commands.options import (
    CAMPAIGN,
    FILE,
    FOLDER,
    as_written,
    examples,
    json_option,
    loaded,
    set_option,
    written_file,
)
from harness.console import (
    print_json,
    print_pool,
)


@click.command(
    short_help="Build the pool of cut-ins, and show its shells.",
    epilog=examples("harness pool scenarios/smoke.yaml", "harness pool scenarios/smoke.yaml --out pool.parquet"),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=CAMPAIGN)
@click.option(
    "--out",
    type=FILE,
    callback=written_file(".parquet"),
    help="Write the pool there, too: FILE.parquet, one row per cut-in.",
)
@set_option
@json_option
def pool(campaign_file: Path, *, out: Path | None, overrides: Sequence[str], as_json: bool) -> None:
    """Build the pool that belongs to CAMPAIGN's environment and surrogate library, and show what is in it.

    Shown are the surrogates from careful to careless with their crash rates, and how probable it is that a cut-in is
    the first in this order that a surrogate crashes on. A pool is built once and kept; `harness run` builds it, too.
    """
    campaign = loaded(campaign_file, overrides)
    from harness.pool.storage import campaign_pool, write_pool  # noqa: PLC0415 - slow to import
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast
    from harness.resolved import resolve  # noqa: PLC0415 - slow to import

    bar = terminal_progress()
    with bar or nullcontext():
        found = campaign_pool(resolve(campaign), bar)
    if out is not None:
        write_pool(out, found)
    if as_json:
        print_json(found.to_json() | ({} if out is None else {"file": str(out)}))
        return
    print_pool(found.to_json())
    if out is not None:
        click.echo(str(out))


@click.command(
    short_help="Repeat a campaign thousands of times: what are its intervals worth?",
    epilog=as_written(
        "Columns:",
        "truth        the crash rate that all replications should find",
        "bias         mean of the estimates relative to the truth, ± its standard error",
        "relvar true  mean squared error of the estimates, over the square of the truth",
        "claimed      the same, as the campaigns themselves estimate it",
        "coverage     share of the intervals that hold the truth, with its 95 % interval",
        "p (Holm)     of so low a coverage if the intervals were right, for as many lines",
        "tests        that a campaign needed: median, 5 % and 95 % quantile",
        "alarm        share of replications with a crash outside the library's boundary",
    )
    + "\n\n"
    + examples("harness validate scenarios/validate/shells_panel.yaml --out runs/shells_panel"),
)
@click.argument("experiment_file", metavar="EXPERIMENT", type=CAMPAIGN)
@click.option("--out", "folder", type=FOLDER, required=True, help="Folder of the results; made if it is not there.")
@click.option("--replications", type=click.IntRange(min=2), help="Instead of the experiment's own number.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes. Default: one per core.")
@click.option("--quiet", is_flag=True, help="No progress bar. There is none either when stderr is not a terminal.")
@json_option
def validate(
    experiment_file: Path, folder: Path, *, replications: int | None, workers: int | None, quiet: bool, as_json: bool
) -> None:
    """Repeat the campaign of EXPERIMENT for each of its vehicles or chains, and judge its intervals by that.

    Printed is a line per vehicle and result, with the columns below. The folder receives results.json,
    replications.parquet (one row each) and coverage.png.
    """
    from harness.validation.experiment import load_experiment  # noqa: PLC0415 - keeps --help fast

    experiment = load_experiment(experiment_file)
    if replications is not None:
        experiment = experiment.model_copy(update={"replications": replications})
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast
    from harness.validation import validate as repeat  # noqa: PLC0415 - slow to import: only once the file is right
    from harness.validation.results import RESULTS, table_lines  # noqa: PLC0415

    bar = None if quiet else terminal_progress(None, 0)
    with bar or nullcontext():
        done = repeat(experiment, folder, workers=workers, progress=bar)
    if as_json:
        print_json([one.to_json() for one in done.judgements])
        return
    for line in table_lines(done.judgements):
        click.echo(line)
    click.echo(str(folder / RESULTS))
