"""`sonarrec config`: print the settings."""

from __future__ import annotations

from pathlib import Path

import click

from sonarrec.cli.options import (
    chosen_settings,
    config_option,
    preset_option,
    seed_option,
    set_option,
)
from sonarrec.records import UsageError


@click.command(short_help="Print every setting, as a file for --config.")
@preset_option
@config_option
@set_option
@seed_option
def config(
    preset: str | None, config_file: Path | None, assignments: tuple[str, ...], seed: int | None
) -> None:
    """Print the configuration, with units and meanings, as a file for --config.

    \b
    Examples:
      sonarrec config > my.toml
      sonarrec config --preset paper
    """
    from sonarrec.config import as_commented_toml

    chosen = chosen_settings(preset, config_file, assignments, seed)
    if len(chosen) > 1:
        raise UsageError("several presets: print them one at a time with --preset")
    click.echo(as_commented_toml(chosen[0]), nl=False)
