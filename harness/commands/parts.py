"""The parts of a run that job arrays make: what shells plan for them, and how all are brought together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.commands.options import (
    CAMPAIGN,
    FOLDER,
    RUN_FOLDER,
    av_option,
    examples,
    executor_option,
    json_option,
    loaded,
    quiet_option,
    set_option,
    workers_option,
)
from harness.console import print_json, print_planned
from harness.console_tables import print_result
from harness.errors import HarnessError

if TYPE_CHECKING:
    from harness.part import Part
    from harness.runner import Plan


@click.command(
    short_help="Plan the tests of a shells campaign, for a job array to run.",
    epilog=examples(
        "harness plan scenarios/smoke.yaml --set testing.shells.first_tests=null --set stop.rhw=0.3 --out runs/plan",
        "harness run runs/plan --part 3/64 --out runs/part3   # each of 64 tasks, anywhere",
        "harness merge runs/plan runs/part* --out runs/whole",
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=CAMPAIGN)
@click.option("--out", "folder", type=FOLDER, required=True, help="Folder of the plan; made if it is not there.")
@workers_option
@executor_option
@click.option("--resume", is_flag=True, help="Go on with what the folder already holds.")
@quiet_option
@av_option
@set_option
@json_option
@click.pass_context
def plan(
    ctx: click.Context,
    campaign_file: Path,
    folder: Path,
    *,
    workers: int | None,
    executor: str | None,
    resume: bool,
    quiet: bool,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Run the first phase of CAMPAIGN, a shells campaign, and plan the second: how many tests of each shell.

    Shells decide after each round what is tested next, which tasks of a job array cannot. So a first phase runs here,
    until the interval is 1.7 times as wide as stop.rhw; from it the number of all further tests is planned, which does
    not depend on what these come to. 'harness run PLAN --part K/N' runs them in parts, 'harness merge PLAN PART...'
    makes one run of all, and reports the planned tests alone: their rate is unbiased by stopping. It is the very run
    that testing.shells.stopping two_phase makes on one machine, and costs some tests more than a run that stops by
    itself (docs/estimators.md).

    Two settings are those of a plan: testing.shells.stopping is two_phase, and run.shard_size is 1 unless --set says
    otherwise, so that each test can go to another part; of fast vehicles 16 or so make fewer files. For a slow vehicle
    --set testing.shells.smallest_round, too: 128 for 64 --workers (docs/performance.md).

    A plan that is complete is only read again. With --resume and a larger stop.episodes it may plan more; parts that
    were begun before then do not belong to it any more.

    Exit code 4 says that stop.episodes or the pool allows no second phase, or none from which stop.rhw is expected.
    """
    where = [] if executor is None else [f"run.executor={executor}"]
    campaign = loaded(campaign_file, ["run.shard_size=1", *overrides, *where], av)
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast
    from harness.runner import plan_second_phase  # noqa: PLC0415 - slow to import: only once the campaign is right
    from harness.runner.planner import FIRST_PHASE  # noqa: PLC0415 - as above

    first_rhw = None if campaign.stop.rhw is None else FIRST_PHASE * campaign.stop.rhw
    with shown_progress(first_rhw, campaign.min_crashes, quiet=quiet) as bar:
        planned = plan_second_phase(campaign, folder, workers=workers, resume=resume, progress=bar)
    print_planned(planned, as_json=as_json)
    ctx.exit(planned.exit_code)


def named_plan(named: Path, out: Path, part: Part | None, given: Sequence[str], *, resume: bool) -> Plan | None:
    """The plan that `harness run` was given in the place of a campaign's file, if it was.

    Raises
    ------
    HarnessError
        It has not planned anything; no part of it is asked for; or options are ``given`` for which it leaves no room.
    """
    where = named
    if not named.is_dir():
        if named.exists() or not resume:
            return None
        from harness.records.folder import MANIFEST, read_manifest  # noqa: PLC0415 - slow to import

        if not (out / MANIFEST).is_file() or not read_manifest(out).get("plan"):
            return None
        where = out  # a plan that is gone is no loss to a part that was begun
    from harness.runner import read_plan  # noqa: PLC0415 - slow to import

    found = read_plan(where)
    if part is None:
        mend = "Write --part K/N, or --part 1/1 for all of it, and `harness merge` makes the run."
        raise HarnessError(str(named), found="a plan, without --part", expected="which part of it to run", mend=mend)
    if given:
        mend = f"Leave out {given[0]}, or plan again with it, into another folder."
        raise HarnessError(given[0], found="a plan", expected="a campaign's file: a plan's parts test alike", mend=mend)
    return found


@click.command(
    short_help="Make one run of all its parts.",
    epilog=examples(
        "harness merge runs/part* --out runs/whole", "harness merge runs/plan runs/part* --out runs/whole   # shells"
    ),
)
@click.argument("parts", metavar="PART...", type=RUN_FOLDER, nargs=-1, required=True)
@click.option("--out", "folder", type=FOLDER, required=True, help="New run folder; must not be there yet.")
@quiet_option
@json_option
@click.pass_context
def merge(ctx: click.Context, parts: Sequence[Path], folder: Path, *, quiet: bool, as_json: bool) -> None:
    """Make one run folder of all parts that 'harness run --part' has made, and print the crash rate.

    Parts of a plan are given together with it, the folder that 'harness plan' has made.

    Records and estimates are those of a whole run, bit for bit; estimate, report, replay and 'run --resume' take the
    folder as theirs. The order of the parts does not matter. It is refused where a part is missing, given twice or not
    finished, or where parts differ in campaign, environment, controller, or version of harness or SUMO: the message
    numbers them as job arrays do. The folder appears when it is complete. Shards are linked, not copied, where the
    file system can; the parts may be deleted afterwards.

    Exit code 3 says that too many episodes failed in all parts together, 4 that the second phase of a plan was cut at
    stop.episodes and is less precise than stop.rhw.
    """
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast
    from harness.runner import merge_parts  # noqa: PLC0415 - keeps --help fast

    with shown_progress(quiet=quiet) as bar:
        result = merge_parts(parts, folder, progress=bar)
    if as_json:
        print_json(result.estimates)
    else:
        print_result(result)
    ctx.exit(result.exit_code)
