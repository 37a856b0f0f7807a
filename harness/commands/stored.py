"""A stored run: estimate again, report again, see an episode again."""

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
)
from harness.console import (
    print_estimates,
    print_json,
    write_json,
    write_trace,
)
from harness.errors import WorldDisagreementError

if TYPE_CHECKING:
    from harness.campaign.models import EstimatorName


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
    type=click.Choice(["nde", "nade", "mixture_cv", "scv", "shells", "martingale", "replay"]),
    multiple=True,
    help="Only this one; may be given several times.",
)
@click.option("--confidence", type=click.FloatRange(0, 1, min_open=True, max_open=True), help="Level of intervals.")
@click.option("--pool", "pool_file", type=FILE, help="Pool of cut-ins to replay surrogates of. Default: the run's own.")
@click.option("--write", is_flag=True, help="Replace DIR/estimates.json by the result.")
@json_option
def estimate(
    folder: Path,
    *,
    estimators: Sequence[EstimatorName],
    confidence: float | None,
    pool_file: Path | None,
    write: bool,
    as_json: bool,
) -> None:
    """Estimate the crash rate again from the records in DIR, with any estimator.

    Nothing is simulated in SUMO. An estimator that the records do not allow is shown with the reason.

    'replay' puts surrogates in the AV's place, in the twin. It needs a pool of cut-ins, which is built (about half a
    minute) when 'replay' is asked for by name and it is not there yet.
    """
    from harness.estimators import estimate_run  # noqa: PLC0415 - keeps --help fast
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast

    bar = terminal_progress() if "replay" in estimators else None
    with bar or nullcontext():
        content = estimate_run(
            folder, estimators=estimators or None, confidence=confidence, pool=pool_file, progress=bar
        )
    if write:
        write_json(folder / "estimates.json", content)
    if as_json:
        print_json(content)
    else:
        print_estimates(content)


@click.command(short_help="Write report.html of a run anew.", epilog=examples("harness report runs/smoke"))
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
def report(folder: Path) -> None:
    """Write DIR/report.html and its plots anew, and print where the page is."""
    from harness.report import write_report  # noqa: PLC0415 - keeps --help fast

    click.echo(str(write_report(folder)))


def _trace_file(_ctx: click.Context, _parameter: click.Parameter, value: Path | None) -> Path | None:
    if value is not None and value.suffix not in (".parquet", ".csv"):
        raise click.BadParameter("the name must end in .parquet or .csv")
    return value


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
@click.option("--out", type=FILE, callback=_trace_file, help="Write the trace: FILE.parquet or FILE.csv.")
@click.option("--fcd", type=FILE, help="Write SUMO's floating car data (XML) of the episode.")
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
            mend="Compare versions and CPU in manifest.json with this machine's; bits are promised for equal ones.",
        )
