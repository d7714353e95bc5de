"""The command line: parse, call one function, print. One command, one file, one screen."""

from __future__ import annotations

from typing import Any

import click

from sonarrec import __version__
from sonarrec.cli.calibrate import calibrate
from sonarrec.cli.config import config
from sonarrec.cli.evaluate import evaluate
from sonarrec.cli.help import help_
from sonarrec.cli.info import info
from sonarrec.cli.map import map_
from sonarrec.cli.overlay import overlay
from sonarrec.cli.report import report
from sonarrec.cli.run import run
from sonarrec.cli.simulate import simulate
from sonarrec.cli.truth import truth
from sonarrec.records import SonarrecError, UsageError


class _Program(click.Group):
    def invoke(self, ctx: click.Context) -> Any:
        """Faults of the input become one line; our own bugs keep their traceback."""
        try:
            return super().invoke(ctx)
        except SonarrecError as error:
            click.echo(f"sonarrec: {error}", err=True)
            ctx.exit(2 if isinstance(error, UsageError) else 1)


@click.group(
    cls=_Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, "-V", "--version", prog_name="sonarrec")
def main() -> None:
    """Recognise landmarks in recorded imaging-sonar logs, and score the results.

    `sonarrec help` lists the pages of the manual: commands, files, results, limits.

    \b
    Exit codes: 0 done; 1 failed; 2 bad usage; 3 finished, but part of the input
    could not be used.
    """


for command in (
    *(run, info, evaluate, report, overlay, map_, simulate, calibrate),
    *(config, truth, help_),
):
    main.add_command(command)
