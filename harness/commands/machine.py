"""The machine: install what SUMO needs of it."""

from __future__ import annotations

import shlex

import click

from harness.commands.options import examples


@click.command(
    short_help="Install the system libraries that SUMO needs.",
    epilog=examples(
        "harness setup             # does and asks nothing where nothing is missing",
        "harness setup --dry-run   # only print the commands",
    ),
)
@click.option("--dry-run", is_flag=True, help="Print the commands that would be run, and run none.")
def setup(*, dry_run: bool) -> None:
    """Install the system libraries that SUMO needs, where they are missing: once per machine.

    pip cannot install these few (X11, GL); a desktop has them. They are installed with apt-get, dnf or apk, directly as
    root and else by sudo, which may ask for your password at a terminal. A campaign with world.engine twin needs none.

    Exit code 2 says that they could not be installed; the message names the packages.
    """
    from harness.sumo.system_libraries import (  # noqa: PLC0415 - keeps --help fast
        install,
        install_commands,
        missing_libraries,
        require_libsumo,
    )

    missing = missing_libraries()
    commands = install_commands(missing) if missing else []
    if dry_run:
        click.echo("\n".join(map(shlex.join, commands)) or "Nothing to install.")
        return
    if missing:
        click.echo(f"Installing what SUMO needs: {shlex.join(commands[-1])}", err=True)
        install(missing, commands)
    require_libsumo()
    click.echo("SUMO's system libraries are installed." if missing else "SUMO's system libraries are there.")
