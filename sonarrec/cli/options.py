"""Options that several commands share, and what they mean."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from sonarrec.records import UsageError

PARTLY = 3  # exit code: finished, but part of the input could not be used
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
Command = TypeVar("Command", bound=Callable[..., Any])


def sonar_options(command: Command) -> Command:
    """The flags that set keys of the sonar geometry, over what sonar.toml says."""
    numbers = {
        "range_min_m": "Slant range of the window's near end, m.",
        "range_max_m": "Slant range of the window's far end, m.",
        "field_of_view_deg": "Horizontal field of view, deg.",
        "tilt_deg": "Downward tilt of the sonar, deg.",
        "height_m": "Height of the sonar above the floor, m.",
        "frame_rate_hz": "Frames per second, where frames carry no time.",
        "metres_per_pixel": "Scale of a fan image, m.",
    }
    options = [
        click.option(
            "--sonar",
            "sonar_file",
            type=FILE,
            help="Sonar geometry, in place of the sonar.toml beside the log.",
        ),
        click.option("--layout", type=click.Choice(["fan", "polar"]), help="Layout of the images."),
        *(
            click.option(f"--{key.replace('_', '-')}", key, type=float, help=text)
            for key, text in numbers.items()
        ),
        click.option(
            "--apex-px",
            type=float,
            nargs=2,
            metavar="COLUMN ROW",
            help="Apex of a fan image, pixels.",
        ),
        click.option(
            "--bearings-deg", metavar="B,B,...", help="One bearing per beam of a polar image."
        ),
        click.option(
            "--ranges-m", metavar="R,R,...", help="One slant range per row of a polar image."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def pixel_options(command: Command) -> Command:
    """The flags that say how a log's samples lie and what they mean; keys of sonar.toml as well."""
    options = [
        click.option(
            "--beam-order",
            type=click.Choice(["range-major", "beam-major"]),
            help="Polar samples: all beams of one range first, or all ranges of one beam.  "
            "[default: found from the first ping]",
        ),
        click.option(
            "--flip/--no-flip", default=None, help="Exchange left and right, where a driver did."
        ),
        click.option(
            "--pixel-scale",
            type=click.Choice(["linear", "log", "db"]),
            help="What pixels hold: ready to show, echo amplitudes, decibels.  "
            "[default: linear to 16 bit and within 0 to 1, else log; db where negative]",
        ),
        click.option(
            "--full-scale",
            type=float,
            metavar="VALUE",
            help="The pixel value that becomes white.  "
            "[default: the type's largest; for log and db by the first ping]",
        ),
        click.option(
            "--dynamic-range-db",
            type=float,
            help="Decibels from black to white, for log and db.  [default: 50]",
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def sonar_from_flags(flags: dict[str, Any]) -> Any:
    from sonarrec.sonar import sonar_from_table

    stated = {key: value for key, value in flags.items() if value is not None}
    for key in ("bearings_deg", "ranges_m"):
        if key in stated:
            try:
                stated[key] = [float(number) for number in stated[key].split(",")]
            except ValueError:
                flag = f"--{key.replace('_', '-')}"
                raise UsageError(f"{flag}: expected numbers with commas between") from None
    return sonar_from_table(stated, "command line")


_LANDMARKS = "Landmark set: a built-in name or a TOML file."
landmarks_option = click.option("--landmarks", default="basin", show_default=True, help=_LANDMARKS)
landmarks_of_results_option = click.option(
    "--landmarks", help=f"{_LANDMARKS}  [default: that of run.toml, else basin]"
)
topic_option = click.option("--topic", help="Channel of an MCAP that holds several image channels.")
min_visible_option = click.option(
    "--min-visible",
    type=float,
    default=0.9,
    show_default=True,
    help="Share of the disc in view from which a landmark counts; with less it is ignored.",
)
tolerance_option = click.option(
    "--tolerance",
    type=float,
    metavar="SECONDS",
    help="For truth matched by timestamp_ns.  [default: half the time between frames]",
)
preset_option = click.option(
    "--preset",
    metavar="NAME[,NAME]",
    help="default (frame by frame), offline (each result waits for what its log shows later) or "
    "paper (every rule as published). `sonarrec run` takes several, side by side.",
)
config_option = click.option(
    "--config", "config_file", type=FILE, help="Settings (TOML), or the run.toml of an earlier run."
)
set_option = click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="STAGE.KEY=VALUE",
    help="Change one setting; repeatable.",
)
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), help="Of all that is random.  [default: 0]"
)


def chosen_settings(
    preset: str | None, config_file: Path | None, assignments: tuple[str, ...], seed: int | None
) -> Any:
    """A Config per preset. Preset, then file, then --set, then --seed: the later wins."""
    from dataclasses import replace

    from sonarrec import config

    chosen = config.configs(preset.split(",") if preset else [], config_file)
    chosen = [config.with_assignments(settings, assignments) for settings in chosen]
    return chosen if seed is None else [replace(settings, seed=seed) for settings in chosen]
