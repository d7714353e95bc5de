"""Options that several commands share: truth, scoring, settings, output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.groups import (
    FILE,
    INPUT,
    OUTPUT,
    SCORING,
    SETTINGS,
    Decorator,
    as_one,
    file_names,
    option,
)
from sonarrec.cli.options_log import GEOMETRY_OPTIONS, LogChoice
from sonarrec.cli.options_remote import ANY_OR_URL
from sonarrec.errors import UsageError

# Results and truth

landmarks_option = option(
    INPUT,
    "--landmarks",
    shell_complete=file_names,
    help="Landmark set: a built-in name or a TOML file.  "
    "[default: that of run.toml if one is read, else basin]",
)


def frames_option(text: str, default: str | None = None) -> Decorator:
    """--frames. text: what is done with these frames. default: in words; None: all frames."""
    text = f"{text} A or B may be left out." + (f"  [default: {default}]" if default else "")
    return option(INPUT, "--frames", metavar="A:B", help=text)


def ground_truth_option(text: str, required: bool = False, kind: click.Path = FILE) -> Decorator:
    """--ground-truth. text: what it is for. kind: FILE_OR_URL if it may be on a server."""
    text = f"{text} Columns: sonarrec help truth."
    return option(INPUT, "--ground-truth", type=kind, required=required, help=text)


pairs_option = option(
    INPUT,
    "--pairs",
    type=FILE,
    help="In place of RESULTS and truth: a CSV with the columns results,ground_truth[,log], a row "
    "per log. With --compare: the truth of each log.",
)


def compare_option(text: str) -> Decorator:
    """--compare OLD NEW. text: what is made of the two."""
    return option(
        INPUT,
        "--compare",
        type=(ANY_OR_URL, ANY_OR_URL),
        shell_complete=file_names,
        metavar="OLD NEW",
        help=f"In place of RESULTS: {text}",
    )


_SCORING = {
    "min_visible": option(
        SCORING,
        "--min-visible",
        type=float,
        default=0.9,
        show_default=True,
        help="Protocol strict: share of the disc that must be in view for a landmark to count; "
        "with less it is ignored.",
    ),
    "tolerance_s": option(
        SCORING,
        "--tolerance",
        "tolerance_s",
        type=float,
        metavar="SECONDS",
        help="Longest time between a row of truth with timestamp_ns and its frame.  "
        "[default: half the time between frames]",
    ),
    "landmarks": landmarks_option,
}


def _scoring(values: dict[str, Any]) -> Any:
    from sonarrec.evaluation.matching.options import ScoringOptions

    chosen = {key: values[key] for key in _SCORING}
    return ScoringOptions(**chosen, sonar=LogChoice(values).sonar_without_log())


# --min-visible, --tolerance, --landmarks and the geometry, as one `scoring`: ScoringOptions.
scoring_options = as_one("scoring", _SCORING | GEOMETRY_OPTIONS, _scoring)


# Settings

_SETTINGS = {
    "preset": option(
        SETTINGS,
        "--preset",
        metavar="NAME[,NAME]",
        help="default (frame by frame), offline (results are revised by what the log shows later) "
        "or paper (every rule as published). `sonarrec run` takes several.",
    ),
    "config_file": option(
        SETTINGS,
        "--config",
        "config_file",
        type=FILE,
        help="Settings (TOML), or the run.toml of an earlier run.",
    ),
    "assignments": option(
        SETTINGS,
        "--set",
        "assignments",
        multiple=True,
        metavar="STAGE.KEY=VALUE",
        help="Change one setting; repeatable. `sonarrec config` prints them all.",
    ),
    "seed": option(
        SETTINGS,
        "--seed",
        type=click.IntRange(min=0),
        help="Seed of the random numbers.  [default: 0]",
    ),
}


@dataclass(frozen=True, slots=True)
class SettingsChoice:
    """The settings as given on the command line."""

    values: Mapping[str, Any]

    @property
    def file(self) -> Path | None:
        """The settings file, or the run.toml of an earlier run."""
        file: Path | None = self.values["config_file"]
        return file

    def configs(self) -> Any:
        """A Config per preset, changed by the file, then by --set, then by --seed."""
        from sonarrec import config

        preset, seed = self.values["preset"], self.values["seed"]
        settings = config.configs(preset.split(",") if preset else [], self.file)
        settings = [config.with_assignments(c, self.values["assignments"]) for c in settings]
        return settings if seed is None else [replace(c, seed=seed) for c in settings]

    def config(self) -> Any:
        """The only Config. Raises UsageError if several presets are given."""
        first, *more = self.configs()
        if more:
            raise UsageError(
                "several presets are given, but this command takes one; choose it with --preset"
            )
        return first


settings_options = as_one("settings", _SETTINGS, SettingsChoice)


model_option = option(
    INPUT,
    "--model",
    type=FILE,
    help="Appearance model that `sonarrec calibrate` wrote.  [default: built in]",
)


# Output

quiet_option = option(
    OUTPUT,
    "-q",
    "--quiet",
    is_flag=True,
    help="Print no progress bar and no summary; notes and errors are still printed.",
)


verbose_option = option(
    OUTPUT, "-v", "--verbose", is_flag=True, help="Print a line on stderr for each finished log."
)


def out_option(kind: click.Path, text: str, **options: Any) -> Decorator:
    """-o, --out. text: what it names."""
    return option(OUTPUT, "-o", "--out", type=kind, help=text, **options)
