"""Options that several commands share, what they mean, and --help with options in groups."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial, wraps
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import click

from sonarrec.records import Clock, UsageError, shown

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


class _Local(click.Path):
    """A path of this machine: a URL would become a folder `s3:`, and be taken for uploaded."""

    def convert(self, value: Any, *told: Any) -> Any:
        from sonarrec.remote.urls import local

        return super().convert(local(value), *told)


NEW_FILE = _Local(dir_okay=False, path_type=Path)
FOLDER = _Local(file_okay=False, path_type=Path)
ANY = _Local(path_type=Path)


# The groups of --help, in this order.
INPUT, SCORING, LEARNING, SETTINGS = "Input", "Scoring", "Learning", "Settings"
BACKGROUND = "Into a recording"
GEOMETRY, PIXELS, BATCH, OUTPUT = "Geometry", "Pixels", "Many logs", "Output"
_GROUPS = (INPUT, BACKGROUND, SCORING, LEARNING, SETTINGS, GEOMETRY, PIXELS, BATCH, OUTPUT)
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class GroupedOption(click.Option):
    """An option that belongs to a group of --help."""

    def __init__(self, *names: Any, group: str, **told: Any) -> None:
        super().__init__(*names, **told)
        self.group = group


class GroupedCommand(click.Command):
    """A command whose --help shows its options in groups and names its help page."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse an empty word: as a path it would be the folder of now. Raises UsageError."""
        for before, word in pairwise([ctx.info_name, *args]):
            option, is_set, value = str(word).partition("=")
            if not word or (option.startswith("--") and is_set and not value):
                raise UsageError(f"nothing is given after {option or before}; is a variable unset?")
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows: dict[str, list[tuple[str, str]]] = {group: [] for group in (*_GROUPS, "Other")}
        for parameter in self.get_params(ctx):
            row = parameter.get_help_record(ctx)
            if row is not None and isinstance(parameter, click.Option):
                rows[getattr(parameter, "group", "Other")].append(row)
        for group, found in rows.items():
            if found:
                with formatter.section(group):
                    formatter.write_dl(found)
        page = ctx.command_path.removeprefix(ctx.find_root().command_path).split()[0]
        formatter.write_paragraph()
        formatter.write_text(f"More: sonarrec help {page}")


command = partial(click.command, cls=GroupedCommand)


def option(group: str, *names: str, **told: Any) -> Decorator:
    """`click.option` in a group of --help."""
    return click.option(*names, cls=GroupedOption, group=group, **told)


def as_one(
    argument: str, options: Mapping[str, Decorator], make: Callable[[dict[str, Any]], Any]
) -> Decorator:
    """Add options, and hand their values to the command as the one argument `argument`."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def gather(**given: Any) -> Any:
            values = {key: given.pop(key) for key in options}
            return function(**given, **{argument: make(values)})

        called: Callable[..., Any] = gather
        for add in reversed([*options.values()]):
            called = add(called)
        return called

    return decorate


# How a log is read

_NUMBERS = {
    "range_min_m": "Slant range of the window's near end, m.",
    "range_max_m": "Slant range of the window's far end, m.",
    "field_of_view_deg": "Horizontal field of view, deg.",
    "tilt_deg": "Downward tilt of the sonar, deg.",
    "height_m": "Height of the sonar above the floor, m.",
    "frame_rate_hz": "Frames per second, where frames carry no time.",
    "metres_per_pixel": "Scale of a fan image, m.",
}
_GEOMETRY = {
    "sonar_file": option(
        GEOMETRY,
        "--sonar",
        "sonar_file",
        type=FILE,
        help="Geometry file, in place of the sonar.toml beside the log.",
    ),
    "layout": option(
        GEOMETRY, "--layout", type=click.Choice(["fan", "polar"]), help="Layout of the images."
    ),
    **{
        key: option(GEOMETRY, f"--{key.replace('_', '-')}", key, type=float, help=text)
        for key, text in _NUMBERS.items()
    },
    "apex_px": option(
        GEOMETRY,
        "--apex-px",
        type=float,
        nargs=2,
        metavar="COLUMN ROW",
        help="Apex of a fan image, pixels.",
    ),
    "bearings_deg": option(
        GEOMETRY,
        "--bearings-deg",
        metavar="B,B,...",
        help="One bearing per beam of a polar image, deg.",
    ),
    "ranges_m": option(
        GEOMETRY,
        "--ranges-m",
        metavar="R,R,...",
        help="One slant range per row of a polar image, m.",
    ),
}
_PIXELS = {
    "beam_order": option(
        PIXELS,
        "--beam-order",
        type=click.Choice(["range-major", "beam-major"]),
        help="Polar samples: all beams of one range first, or all ranges of one beam.  "
        "[default: found from the first ping]",
    ),
    "flip": option(
        PIXELS,
        "--flip/--no-flip",
        default=None,
        help="Exchange left and right, where a driver did.",
    ),
    "pixel_scale": option(
        PIXELS,
        "--pixel-scale",
        type=click.Choice(["linear", "log", "db"]),
        help="What pixels hold: grey levels ready to show, echo amplitudes, or decibels.  "
        "[default: linear to 16 bit and within 0 to 1, db where some are negative, else log]",
    ),
    "full_scale": option(
        PIXELS,
        "--full-scale",
        type=float,
        metavar="VALUE",
        help="The pixel value that becomes white.  "
        "[default: the type's largest; for log and db from the first ping]",
    ),
    "dynamic_range_db": option(
        PIXELS,
        "--dynamic-range-db",
        type=float,
        help="Decibels from black to white, for log and db.  [default: 50]",
    ),
}
topic_option = option(
    INPUT, "--topic", help="Channel of an MCAP or bag that holds several image channels."
)
_TIME = {
    "time": option(
        INPUT,
        "--time",
        type=click.Choice(["log", "publish", "header"]),
        help="Which time of an MCAP message becomes the timestamp_ns of its frame. Frames come in "
        "the order of log time all the same.  [default: log]",
    )
}


_RECURSIVE = option(
    INPUT, "--recursive", is_flag=True, help="Also take the logs in all folders below a folder."
)
_FROM_FILE = option(
    INPUT,
    "--from-file",
    type=click.File(encoding="utf-8-sig", errors="surrogateescape"),
    metavar="LIST",
    help="File with one LOG a line; - for standard input. Empty lines and those that begin with # "
    "are skipped.",
)


def many_logs_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """--recursive and --from-file, of commands that take many logs."""
    return _RECURSIVE(_FROM_FILE(function))


def named_logs(logs: tuple[str, ...], from_file: IO[str] | None, recursive: bool) -> Any:
    """The logs of a command that takes many, NamedLogs and, of servers, RemoteLogs.

    Raises click's UsageError without any, ours for a list that is no text.
    """
    from sonarrec.remote.run import all_logs

    if not logs and from_file is None:
        raise click.UsageError(
            "Missing argument 'LOG...'; a list serves as well: --from-file LIST",
            click.get_current_context(),
        )
    return all_logs(logs, () if from_file is None else _lines(from_file), recursive=recursive)


def _lines(listed: IO[str]) -> Iterator[str]:
    """The lines of a list. Raises UsageError where one holds what no path does."""
    for line in listed:
        if "\0" in line:
            raise UsageError(
                f"--from-file {shown(listed.name)}: no list of logs, which is a text in UTF-8 with "
                "one LOG a line; to run a log leave out --from-file"
            )
        yield line


@dataclass(frozen=True, slots=True)
class LogChoice:
    """How the command line says that a log is to be read."""

    values: Mapping[str, Any]  # of the options by name, None where not given

    def given(self) -> list[str]:
        """The flags that were given."""
        return [f"--{k.replace('_', '-')}" for k, v in self.values.items() if v is not None]

    def sonar(self) -> Any:
        """The Sonar that the flags alone state. Raises UsageError for what cannot be meant."""
        from sonarrec.sonar import sonar_from_table

        keys = [key for key in (*_GEOMETRY, *_PIXELS) if key != "sonar_file"]
        stated = {key: self.values[key] for key in keys if self.values.get(key) is not None}
        for key in {"bearings_deg", "ranges_m"} & set(stated):
            try:
                stated[key] = [float(number) for number in stated[key].split(",")]
            except ValueError:
                flag = f"--{key.replace('_', '-')}"
                raise UsageError(f"{flag}: expected numbers with commas between") from None
        flags = sonar_from_table(stated, "command line")
        flags.check_flags(flags)
        return flags

    def sonar_without_log(self) -> Any:
        """The Sonar of --sonar and the flags, which win, where no log is opened."""
        from sonarrec.sonar import Sonar, load_sonar

        file = self.values["sonar_file"]
        return (load_sonar(file) if file else Sonar()).updated(self.sonar())

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of what opens a log: sonar, sonar_file, topic; time where stated.

        Raises SonarrecError for a sonar_file that cannot be used: once, however many the logs.
        """
        from sonarrec.sonar import load_sonar

        file: Path | None = self.values["sonar_file"]
        if file is not None and file.is_file():  # a pipe is read but once
            load_sonar(file)
        time: Clock | None = self.values.get("time")
        return {
            "sonar": self.sonar(),
            "sonar_file": file,
            "topic": self.values["topic"],
            **({"time": time} if time else {}),
        }


def log_options(*, pixels: bool = True, time: bool = False) -> Decorator:
    """--topic, the geometry and, where wanted, pixels and --time, as one `log_choice`."""
    options = (
        {"topic": topic_option} | (_TIME if time else {}) | _GEOMETRY | (_PIXELS if pixels else {})
    )
    return as_one("log_choice", options, LogChoice)


# The geometry alone, as the Sonar `sonar`, where no log is opened.
geometry_options = as_one("sonar", _GEOMETRY, lambda values: LogChoice(values).sonar_without_log())
# Results and truth

landmarks_option = option(
    INPUT,
    "--landmarks",
    help="Landmark set: a built-in name or a TOML file.  "
    "[default: that of run.toml where one is read, else basin]",
)


def frames_option(text: str) -> Decorator:
    """--frames; text: what becomes of these frames."""
    text = f"{text} Either may be left out."
    return option(INPUT, "--frames", metavar="A:B", help=text)


def ground_truth_option(text: str, required: bool = False, kind: click.Path = FILE) -> Decorator:
    """--ground-truth; text: what it is for. kind: FILE_OR_URL where it may be on a server."""
    text = f"{text} Columns: sonarrec help truth."
    return option(INPUT, "--ground-truth", type=kind, required=required, help=text)


_SCORING = {
    "min_visible": option(
        SCORING,
        "--min-visible",
        type=float,
        default=0.9,
        show_default=True,
        help="Share of the disc that must be in view for a landmark to count; with less, it is "
        "ignored.",
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

    given = {key: values[key] for key in _SCORING}
    return ScoringOptions(**given, sonar=LogChoice(values).sonar_without_log())


# --min-visible, --tolerance, --landmarks and the geometry, as one `scoring`: ScoringOptions.
scoring_options = as_one("scoring", _SCORING | _GEOMETRY, _scoring)


# Settings

_SETTINGS = {
    "preset": option(
        SETTINGS,
        "--preset",
        metavar="NAME[,NAME]",
        help="default (frame by frame), offline (results are revised by what the log shows later) "
        "or paper (every rule as published). `sonarrec run` takes several, side by side.",
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
        help="Seed of all that is random.  [default: 0]",
    ),
}


@dataclass(frozen=True, slots=True)
class SettingsChoice:
    """What the command line says of the settings."""

    values: Mapping[str, Any]

    @property
    def file(self) -> Path | None:
        """The settings file, or the run.toml of an earlier run."""
        file: Path | None = self.values["config_file"]
        return file

    def configs(self) -> Any:
        """A Config per preset. Preset, then file, then --set, then --seed: the later wins."""
        from dataclasses import replace

        from sonarrec import config

        preset, seed = self.values["preset"], self.values["seed"]
        chosen = config.configs(preset.split(",") if preset else [], self.file)
        chosen = [config.with_assignments(c, self.values["assignments"]) for c in chosen]
        return chosen if seed is None else [replace(c, seed=seed) for c in chosen]

    def config(self) -> Any:
        """The one Config. Raises UsageError where several presets are asked for."""
        chosen, *more = self.configs()
        if more:
            raise UsageError("several presets: this command takes one; choose it with --preset")
        return chosen


settings_options = as_one("settings", _SETTINGS, SettingsChoice)


model_option = option(
    INPUT,
    "--model",
    type=FILE,
    help="Appearance model that `sonarrec calibrate` wrote.  [default: built in]",
)


# What goes out

quiet_option = option(
    OUTPUT,
    "-q",
    "--quiet",
    is_flag=True,
    help="No progress bar and no summary; notes and faults are still printed.",
)


verbose_option = option(
    OUTPUT, "-v", "--verbose", is_flag=True, help="Print a line on stderr for each finished log."
)


def out_option(kind: click.Path, text: str, **told: Any) -> Decorator:
    """-o, --out; text: what it names."""
    return option(OUTPUT, "-o", "--out", type=kind, help=text, **told)
