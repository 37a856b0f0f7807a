"""The command ``harness``.

Results go to stdout or to files, progress and complaints to stderr. `cli` lists the exit codes.
What does the work is imported inside each command, so that ``--help`` answers at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from harness.commands.campaigns import av_check, check, compare, pool, run
from harness.commands.options import examples, quiet_option
from harness.commands.preparing import fit, schema, setup
from harness.commands.printing import go_on_unread, show_error, show_interrupted, system_error, usage_error
from harness.commands.stored import estimate, replay, report, sensitivity
from harness.errors import EXIT_DONE, HarnessError
from harness.signals import interruptible, open_streams


@click.group(
    epilog=examples(
        "harness run my_av.py:MyClass           # how often it crashes, with an interval",
        "harness run my.yaml --out runs/mine    # the same, in a campaign of your own",
        "harness replay runs/mine 17            # test 17 of it again, bit for bit",
    ),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="harness")
def cli() -> None:
    """Estimate how often an automated vehicle crashes, from few tests in SUMO.

    A campaign is a YAML file that names the vehicle, the traffic, and when to stop.

    Exit codes: 0 done; 2 the campaign or the call is wrong, or the records do not allow what was asked for; 3 too many
    tests failed, or SUMO moved otherwise than it was told; 4 the tests or the pool were used up before the asked
    precision or a verdict was reached; 5 the crash rate is above --accept, or B is worse than A by more than --margin;
    130 interrupted by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP: all three keep what is finished.
    """


_TESTING = check, av_check, run, compare, pool, estimate, sensitivity, report, replay
for command in (*_TESTING, fit, schema, setup):
    cli.add_command(quiet_option(command))


def main(arguments: Sequence[str] | None = None, group: click.Group = cli, name: str = "harness") -> int:
    """Run a command line and turn every error that a user can cause into plain words; returns the exit code.

    Anything that is not a user's error is a defect and leaves as its own exception.
    """
    open_streams()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    with interruptible() as interruption:
        try:
            code = group.main(arguments, prog_name=name, standalone_mode=False)
            sys.stdout.flush()
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - a library may make any of an interruption
            if (sent := interruption.signal) is not None or isinstance(error, click.Abort | KeyboardInterrupt):
                show_interrupted(next(iter(arguments), ""), None if sent is None else sent.name)
                return interruption.exit_code
            return _told(error, group, name, arguments)
        return code if isinstance(code, int) else EXIT_DONE


def _told(error: Exception, group: click.Group, name: str, arguments: Sequence[str]) -> int:
    """Show a user's error and return its exit code; a defect is raised again."""
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return error.exit_code
    if isinstance(error, BrokenPipeError):
        go_on_unread(sys.stdout)
        return EXIT_DONE
    user_error = error if isinstance(error, HarnessError) else None
    if isinstance(error, click.UsageError):
        called = click.Context(group, info_name=name)
        if (asked := next(iter(arguments), "")) in group.commands:  # click does not say which of a missing value
            called = click.Context(group.commands[asked], called, asked)
        user_error = usage_error(error, error.ctx or called)
    elif isinstance(error, OSError | MemoryError):
        user_error = system_error(error)
    if user_error is None:
        raise error
    show_error(user_error)
    return user_error.exit_code
