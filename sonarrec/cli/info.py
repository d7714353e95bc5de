"""`sonarrec info`: what is in a log, and how it would be read."""

from __future__ import annotations

import json
from typing import Any

import click

from sonarrec.cli.options import (
    INPUT,
    OUTPUT,
    PARTLY,
    LogChoice,
    command,
    leave,
    log_options,
    option,
    progress,
    quiet_option,
    tell,
)
from sonarrec.records import SonarrecError, UsageError


@command(short_help="Show what is in a log, and whether it is whole.")
@click.argument("log", nargs=-1, required=True)
@option(
    INPUT,
    "--quick",
    is_flag=True,
    help="Read the summary and the first frames only; do not check every frame and checksum.",
)
@log_options()
@option(OUTPUT, "--json", "as_json", is_flag=True, help="Print JSON. Keys: sonarrec help info.")
@quiet_option
def info(
    log: tuple[str, ...], quick: bool, log_choice: LogChoice, as_json: bool, quiet: bool
) -> None:
    """Show what is in LOG, whether it is whole, and how `run` would read it.

    LOG is an MCAP file, a folder of images, a quoted glob of images or a video. Every frame is
    read, and every checksum compared, to tell how many frames can be used; --quick leaves that
    out. A geometry that is not complete is told but no fault. Exit code 3: part of the log cannot
    be used; 1: nothing can.

    \b
    Examples:
      sonarrec info sample_data/pan.mcap
      sonarrec info --quick *.mcap
      sonarrec info --json dive.mcap | jq '.logs[0].images[].usable'
    """
    from sonarrec import __version__
    from sonarrec.info import describe, lines

    reading = log_choice.arguments()
    tables: list[dict[str, Any]] = []
    useless = faulty = 0
    for number, path in enumerate(log):
        try:
            with progress(quiet) as step:
                found = describe(path, **reading, quick=quick, observe=step)
        except UsageError:
            raise
        except SonarrecError as error:
            useless += 1
            tables.append({"path": path, "error": str(error)})
            tell([str(error)])
            continue
        useless += found.nothing
        faulty += found.partly
        tables.append(found.as_table())
        if not as_json:
            click.echo("\n".join(["", *lines(found)] if number else lines(found)))
    if as_json:
        click.echo(json.dumps({"version": __version__, "logs": tables}, indent=2))
    if useless == len(log):
        leave(1)
    if useless or faulty:
        leave(PARTLY)
