"""Commands and options that are gone, with what to use; `sonarrec help changes` lists them too."""

from __future__ import annotations

import click

_GEOMETRY = "state the geometry in sonar.toml beside the log (`info --write-sonar`), or by --sonar"
_PIXELS = "state it in sonar.toml beside the log: sonarrec help geometry"
REMOVED = {
    **dict.fromkeys(
        (
            *("--layout", "--range-min-m", "--range-max-m", "--field-of-view-deg", "--tilt-deg"),
            *("--height-m", "--frame-rate-hz", "--beam-width-deg", "--metres-per-pixel"),
            *("--apex-px", "--bearings-deg", "--ranges-m"),
        ),
        _GEOMETRY,
    ),
    **dict.fromkeys(
        (
            *("--beam-order", "--range-order", "--flip", "--no-flip"),
            *("--colour-map", "--pixel-scale", "--full-scale", "--dynamic-range-db"),
        ),
        _PIXELS,
    ),
}
"""What to use in place of each, where a command does not have it (any more)."""


def with_advice(error: click.NoSuchOption) -> click.NoSuchOption:
    """The error of an option that is gone with what to use; of another as it is."""
    advice = REMOVED.get(error.option_name)
    if advice is None:
        return error
    return click.NoSuchOption(error.option_name, f"{error.message} Gone: {advice}.", ctx=error.ctx)
