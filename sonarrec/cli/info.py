"""`sonarrec info`: what is in a log, and how it would be read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.options import PARTLY, pixel_options, sonar_from_flags, sonar_options
from sonarrec.records import SonarrecError, UsageError


@click.command(short_help="Show what is in a log, and whether it is whole.")
@click.argument("log", nargs=-1, required=True)
@click.option("--topic", help="Look at this channel of an MCAP alone.")
@click.option(
    "--quick",
    is_flag=True,
    help="Read the summary and the first frames only; do not check every frame and checksum.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON; its keys are in the README.")
@sonar_options
@pixel_options
@click.option("-q", "--quiet", is_flag=True, help="No progress bar.")
def info(
    log: tuple[str, ...],
    topic: str | None,
    quick: bool,
    as_json: bool,
    sonar_file: Path | None,
    quiet: bool,
    **flags: Any,
) -> None:
    """Show what is in LOG, whether it is whole, and how `run` would read it.

    LOG is an MCAP file, a folder of images, a quoted glob of images or a video. Every frame is
    read, and every checksum compared, to tell how many frames can be used; --quick leaves that
    out. A geometry that is not complete is told but no fault. Exit code 3: part of the log cannot
    be used; 1: nothing can.

    \b
    Examples:
      sonarrec info log.mcap
      sonarrec info --quick *.mcap
      sonarrec info --json dive.mcap | jq '.logs[0].images[].usable'
    """
    from sonarrec import __version__
    from sonarrec.info import describe, lines

    sonar = sonar_from_flags(flags)
    tables: list[dict[str, Any]] = []
    useless = faulty = 0
    for number, path in enumerate(log):
        try:
            found = describe(
                path,
                sonar=sonar,
                sonar_file=sonar_file,
                topic=topic,
                quick=quick,
                observe=_progress_bar(quiet),
            )
        except UsageError:
            raise
        except SonarrecError as error:
            useless += 1
            tables.append({"path": path, "error": str(error)})
            click.echo(f"sonarrec: {error}", err=True)
            continue
        useless += found.nothing
        faulty += found.partly
        tables.append(found.as_table())
        if not as_json:
            click.echo("\n".join(["", *lines(found)] if number else lines(found)))
    if as_json:
        click.echo(json.dumps({"version": __version__, "logs": tables}, indent=2))
    if useless == len(log):
        click.get_current_context().exit(1)
    if useless or faulty:
        click.get_current_context().exit(PARTLY)


def _progress_bar(quiet: bool) -> Callable[[int | None], None]:
    """A tqdm bar on stderr; silent when quiet and where stderr is no terminal."""
    from tqdm import tqdm

    bar = tqdm(unit="frame", leave=False, disable=True if quiet else None)

    def observe(total: int | None) -> None:
        bar.total = total
        bar.update()

    return observe
