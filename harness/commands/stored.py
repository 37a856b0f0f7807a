"""Stored runs: estimate again, count the tests they needed, report again, see an episode again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.commands.options import (
    FILE,
    RUN_FOLDER,
    examples,
    json_option,
    written_file,
)
from harness.console import (
    print_estimates,
    print_json,
    print_required_tests,
    write_trace,
)
from harness.errors import EXIT_BAD_INPUT, WorldDisagreementError

if TYPE_CHECKING:
    from harness.campaign.models import EstimatorName
    from harness.estimators.run_required_tests import RnotEstimator


@click.command(
    short_help="Estimate again from the records of a run.",
    epilog=examples(
        "harness estimate runs/smoke", "harness estimate runs/smoke -e nade -e scv --confidence 0.95 --json"
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.option(
    "--estimator",
    "-e",
    "estimators",
    type=click.Choice(["nde", "nade", "mixture_cv", "scv", "shells"]),
    multiple=True,
    help="Only this one; may be given several times.",
)
@click.option("--confidence", type=click.FloatRange(0, 1, min_open=True, max_open=True), help="Level of intervals.")
@click.option("--pool", "pool_file", type=FILE, help="Pool of cut-ins for the alarm.")
@click.option("--write", is_flag=True, help="Replace DIR/estimates.json by the result.")
@json_option
@click.pass_context
def estimate(
    ctx: click.Context,
    folder: Path,
    *,
    estimators: Sequence[EstimatorName],
    confidence: float | None,
    pool_file: Path | None,
    write: bool,
    as_json: bool,
) -> None:
    """Estimate the crash rate again from the records in DIR, with any estimator.

    Nothing is simulated in SUMO. An estimator that the records do not allow is shown with the reason; the exit code is
    2 if they allow none of those asked for.

    For the alarm surrogates of a pool of cut-ins take the AV's place, in the twin: those of the run's own pool if it
    has been built ('harness pool'), in the first 100,000 tests; with --pool those of that one, in all tests.
    """
    from harness.runner import estimate_run  # noqa: PLC0415 - keeps --help fast

    content = estimate_run(folder, estimators=estimators or None, confidence=confidence, pool=pool_file)
    if write:
        from harness.records.folder import write_json  # noqa: PLC0415 - keeps --help fast

        write_json(folder / "estimates.json", content)
    if as_json:
        print_json(content)
    else:
        print_estimates(content, estimators)
    if estimators and all(content["estimates"][name]["crash_rate"] is None for name in estimators):
        ctx.exit(EXIT_BAD_INPUT)


@click.command(
    short_help="How many tests the paper's procedure would ask for (RNoT, AAR).",
    epilog=examples(
        "harness rnot runs/nde runs/forced                     # and the acceleration of the second over the first",
        "harness rnot runs/nade --rhw 0.1 --total 5000         # another threshold, and another end of the grid",
        "harness rnot runs/nade -e nade -e scv --total 2000 --ratio 1.25   # minutes: a regression at each look",
    ),
)
@click.argument("folders", metavar="RUN...", type=RUN_FOLDER, nargs=-1, required=True)
@click.option(
    "--rhw",
    type=click.FloatRange(0, min_open=True),
    default=0.3,
    show_default=True,
    help="Relative half-width to reach.",
)
@click.option(
    "--confidence",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.9,
    show_default=True,
    help="Level of the normal interval.",
)
@click.option("--shuffles", type=click.IntRange(min=1), default=200, show_default=True, help="Orderings of the tests.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the orderings.")
@click.option("--first", type=click.IntRange(min=2), default=10, show_default=True, help="First look of the grid.")
@click.option(
    "--ratio",
    type=click.FloatRange(1, min_open=True),
    default=1.05,
    show_default=True,
    help="From one look to the next.",
)
@click.option("--total", type=click.IntRange(min=2), help="Last look. Default, and at most: all tests on record.")
@click.option(
    "--estimator",
    "-e",
    "estimators",
    type=click.Choice(["nde", "nade", "scv"]),
    multiple=True,
    help="Whose RHW; may be given several times. Default: nde for naturalistic runs, else nade.",
)
@json_option
def rnot(
    folders: Sequence[Path],
    *,
    rhw: float,
    confidence: float,
    shuffles: int,
    seed: int,
    first: int,
    ratio: float,
    total: int | None,
    estimators: Sequence[RnotEstimator],
    as_json: bool,
) -> None:
    """Count the tests that each RUN needed, the way the paper counts them; nothing is simulated.

    The tests of a run are shuffled. The required number of tests (RNoT) of a shuffle is the first look at which the
    relative half-width is at most --rhw and stays so until the last look. Printed are its mean over all shuffles, its
    5-95 % range, and the average acceleration ratio (AAR): the mean of the first row over that of each row.

    Shuffles that are above --rhw at the last look count as that many tests; how many these are is printed, and the mean
    is a lower limit then. Runs that draw from shells are refused: their tests cannot change places.

    'scv' is computed only when asked for. It solves its regressions anew at each look of each shuffle, which takes
    minutes: a larger --ratio and a smaller --total make it quicker. Its RHW rests on a variance that is too small.
    """
    from harness.estimators.required_tests import Procedure  # noqa: PLC0415 - keeps --help fast
    from harness.estimators.run_required_tests import required_tests_of_runs  # noqa: PLC0415 - keeps --help fast
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast

    procedure = Procedure(rhw, confidence, shuffles, seed, first, ratio, total)
    bar = terminal_progress()
    with bar or nullcontext():
        content = required_tests_of_runs(folders, procedure, estimators=estimators, progress=bar)
    if as_json:
        print_json(content)
    else:
        print_required_tests(content)


@click.command(short_help="Write report.html of a run anew.", epilog=examples("harness report runs/smoke"))
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
def report(folder: Path) -> None:
    """Write DIR/report.html and its plots anew, and print where the page is."""
    from harness.report import write_report  # noqa: PLC0415 - keeps --help fast

    click.echo(str(write_report(folder)))


@click.command(
    short_help="Simulate one episode of a run again, bit for bit.",
    epilog=examples(
        "harness replay runs/smoke 17",
        "harness replay runs/smoke 17 --out episode_17.csv",
        "harness replay runs/smoke 17 --gui",
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.argument("episode", type=click.IntRange(min=0))
@click.option(
    "--out", type=FILE, callback=written_file(".csv", ".parquet"), help="Write the trace: FILE.parquet or FILE.csv."
)
@click.option("--fcd", type=FILE, callback=written_file(), help="Write SUMO's floating car data (XML) of the episode.")
@click.option("--gui", is_flag=True, help="Show the episode in sumo-gui (extra 'sumo').")
@json_option
def replay(folder: Path, episode: int, *, out: Path | None, fcd: Path | None, gui: bool, as_json: bool) -> None:
    """Simulate episode number EPISODE of the run in DIR again, bit for bit.

    Where the run has stored the episode's trace, the replay is compared with it; a difference ends with exit code 3.
    """
    from harness.runner import replay_episode  # noqa: PLC0415 - keeps --help fast

    result = replay_episode(folder, episode, gui=gui, fcd=fcd)
    files = [str(file) for file in (out, fcd) if file is not None]
    if out is not None:
        write_trace(result.trace, out)
    if as_json:
        print_json({"episode": episode, "outcome": result.outcome, "bit_equal": result.bit_equal, "files": files})
    else:
        compared = {None: "no stored trace to compare with", True: "bit for bit as stored", False: "NOT as stored"}
        click.echo(f"episode {episode}: {result.outcome}; {compared[result.bit_equal]}")
        for file in files:
            click.echo(file)
    if result.bit_equal is False:
        raise WorldDisagreementError(
            f"episode {episode} of {folder}",
            found="a replay that differs from the stored trace",
            expected="the same bits",
            mend=str(result.suspects),
        )
