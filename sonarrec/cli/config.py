"""`sonarrec config`: print the settings."""

from __future__ import annotations

import click

from sonarrec.cli import options
from sonarrec.cli.groups import command


@command(short_help="Print every setting, as a file for --config.")
@options.settings
def config(settings: options.SettingsChoice) -> None:
    """Print the configuration, with units and meanings, as a file for --config.

    \b
    Examples:
      sonarrec config > my.toml
      sonarrec config --preset paper
    """
    from sonarrec.config import as_commented_toml

    click.echo(as_commented_toml(settings.config()), nl=False)
