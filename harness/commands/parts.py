"""The parts of a run that job arrays have made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from harness.commands.options import FOLDER, RUN_FOLDER, examples, json_option, quiet_option
from harness.console import print_json
from harness.console_tables import print_result


@click.command(
    short_help="Make one run of all its parts.", epilog=examples("harness merge runs/part* --out runs/whole")
)
@click.argument("parts", metavar="PART...", type=RUN_FOLDER, nargs=-1, required=True)
@click.option("--out", "folder", type=FOLDER, required=True, help="New run folder; must not be there yet.")
@quiet_option
@json_option
def merge(parts: Sequence[Path], folder: Path, *, quiet: bool, as_json: bool) -> None:
    """Make one run folder of all parts that 'harness run --part' has made, and print the crash rate.

    Records and estimates are those of a whole run, bit for bit; estimate, report, replay and 'run --resume' take the
    folder as theirs. The order of the parts does not matter. It is refused where a part is missing, given twice or not
    finished, or where parts differ in campaign, environment, controller, or version of harness or SUMO: the message
    numbers them as job arrays do. The folder appears when it is complete. Shards are linked, not copied, where the
    file system can; the parts may be deleted afterwards.

    Exit code 3 says that too many episodes failed in all parts together.
    """
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast
    from harness.runner import merge_parts  # noqa: PLC0415 - keeps --help fast

    bar = shown_progress(quiet=quiet)
    with bar:
        result = merge_parts(parts, folder, progress=bar)
    if as_json:
        print_json(result.estimates)
    else:
        print_result(result)
