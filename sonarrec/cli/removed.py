"""Commands and options that are gone, with what to use; `sonarrec help changes` lists them too."""

from __future__ import annotations

import click

_STATED = "it is for `run` and `info`; state it in sonar.toml beside the log, or give --sonar FILE"
_KEY = "it is a key of sonar.toml: sonarrec help geometry"
REMOVED = {
    **dict.fromkeys(
        (
            *("--layout", "--range-min-m", "--range-max-m", "--field-of-view-deg", "--tilt-deg"),
            *("--height-m", "--frame-rate-hz", "--metres-per-pixel", "--apex-px"),
            *("--bearings-deg", "--beam-order", "--range-order", "--flip", "--no-flip"),
            "--pixel-scale",
        ),
        _STATED,
    ),
    **dict.fromkeys(
        ("--beam-width-deg", "--ranges-m", "--colour-map", "--full-scale", "--dynamic-range-db"),
        _KEY,
    ),
}
"""What to use in place of each, where a command does not have it (any more)."""


def with_advice(error: click.NoSuchOption) -> click.NoSuchOption:
    """The error of an option that is gone with what to use; of another as it is."""
    advice = REMOVED.get(error.option_name)
    if advice is None:
        return error
    return click.NoSuchOption(error.option_name, f"{error.message} Gone: {advice}.", ctx=error.ctx)
