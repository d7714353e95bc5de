"""Commands and options that are gone, with what to use; `sonarrec help changes` lists them too."""

from __future__ import annotations

import click

_STATED = "sonar.toml beside the log or --sonar FILE; `run` and `info` still have the option"
_KEY = "a key of sonar.toml: sonarrec help geometry"
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
    "status": "OUT/logs.csv has a row per log",
    "site": "`simulate` with your geometry, then `run` and `evaluate`",
    "--tables": "pandas.read_csv(...).to_parquet(...): sonarrec help python",
    "--seed": "--set seed=N",
    "--background": "a scene of your own: sonarrec help simulate",
    **dict.fromkeys(("--schema", "--compression"), "an MCAP holds the one type of its scene"),
    **dict.fromkeys(("--mcap", "--video", "--images"), "-o OUT: its ending says what is written"),
    "--foxglove-layout": "add /sonarrec/annotations to Foxglove's Image panel",
    "--grid": "`info --preview` draws range rings and bearings",
    "--mosaic": "frames and measured motion are in frames.csv",
    "--sheet": "`overlay --ground-truth`",
    "--format": "`truth convert` reads COCO JSON alone",
    "--markdown": "the table as text",
    "--json": "the CSV files",
    "--from-scratch": "calibrate begins with the built-in model",
    "--try-radii": "`info --preview` draws the discs to scale",
    **dict.fromkeys(("--cache", "--cache-size"), "mount the server: rclone mount"),
    "--retry-failed": "a second `run` does failed logs again, with --overwrite partial ones too",
    "--odometry-out": "`map` draws the path; frames.csv has the motion of each frame",
    "--verbose": "OUT/logs.csv has a row per log",
    "-v": "OUT/logs.csv has a row per log",
    "--bound": "intervals of the false positive rate",
    "--det": "roc.csv holds the curve",
    "--unit": "passes, or logs where there are ten or more",
    "--baseline": "--method smi",
    "--fail-on-regression": "sonarrec check",
}
"""What to use in place of each, where a command does not have it (any more)."""


def with_advice(error: click.NoSuchOption) -> click.NoSuchOption:
    """The error of an option that is gone with what to use; of another as it is."""
    advice = REMOVED.get(error.option_name)
    if advice is None:
        return error
    return click.NoSuchOption(
        error.option_name, f"{error.message} It is gone. Instead: {advice}.", ctx=error.ctx
    )
