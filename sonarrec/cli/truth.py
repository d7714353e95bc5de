"""`sonarrec truth`: convert, check and propose ground truth."""

from __future__ import annotations

import click

from sonarrec.cli.truth_check import check
from sonarrec.cli.truth_convert import convert
from sonarrec.cli.truth_propose import propose


@click.group(short_help="Make ground truth: convert, check, propose.")
def truth() -> None:
    """Ground truth: convert annotations, check a gt.csv, propose one from results.

    \b
    Examples:
      sonarrec truth convert annotations.xml --log pings/
      sonarrec truth check gt.csv pings/
      sonarrec truth propose sonarrec_out/pings
    """


for command in (convert, check, propose):
    truth.add_command(command)
