"""The command line: parse, call one function, print. One command, one screen."""

from __future__ import annotations

import click

from sonarrec import __version__


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="sonarrec")
def main() -> None:
    """Recognise landmarks in recorded imaging-sonar logs, and score it against ground truth."""
