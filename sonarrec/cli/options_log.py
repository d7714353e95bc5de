"""Options of commands that open recordings: which logs, and how they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, get_args

import click

from sonarrec.cli.groups import FILE, Decorator, as_one, in_geometry, in_input
from sonarrec.errors import UsageError, is_url
from sonarrec.nouns import Clock

if TYPE_CHECKING:
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.results.run_file import LogOptions

GEOMETRY_TEXTS = {
    "range_min_m": "Slant range of the window's near end, m.",
    "range_max_m": "Slant range of the window's far end, m.",
    "field_of_view_deg": "Horizontal field of view, deg.",
    "tilt_deg": "Downward tilt of the sonar, deg.",
    "height_m": "Height of the sonar above the floor, m.",
    "frame_rate_hz": "Frames per second, if frames carry no time.",
    "metres_per_pixel": "Scale of a fan image, m.",
}
_FLAGS = {
    "layout": in_geometry(
        "--layout", type=click.Choice(["fan", "polar"]), help="Layout of the images."
    ),
    **{
        key: in_geometry(f"--{key.replace('_', '-')} {key}", type=float, help=text)
        for key, text in GEOMETRY_TEXTS.items()
    },
    "apex_px": in_geometry(
        "--apex-px", type=float, nargs=2, metavar="COLUMN ROW", help="Apex of a fan image, pixels."
    ),
    "bearings_deg": in_geometry(
        "--bearings-deg", metavar="B,B,...", help="One bearing per beam of a polar image, deg."
    ),
    "beam_order": in_geometry(
        "--beam-order",
        type=click.Choice(["range-major", "beam-major"]),
        metavar="ORDER",
        help="range-major or beam-major polar samples.  [default: found]",
    ),
    "range_order": in_geometry(
        "--range-order",
        type=click.Choice(["near_first", "far_first"]),
        metavar="ORDER",
        help="near_first or far_first on top.  [default: near_first]",
    ),
    "flip": in_geometry(
        "--flip/--no-flip", default=None, help="Exchange left and right, if a driver did."
    ),
    "pixel_scale": in_geometry(
        "--pixel-scale",
        type=click.Choice(["linear", "log", "db"]),
        metavar="SCALE",
        help="Pixels are grey levels (linear), echo amplitudes (log) or decibels (db).  "
        "[default: found]",
    ),
}
"""Keys of sonar.toml as flags, of `run` and `info` alone."""
sonar_file = in_input(
    "--sonar sonar_file",
    type=FILE,
    help="Geometry file, in place of the sonar.toml beside the log.",
)
topic_option = in_input("--topic", help="Image channel of an MCAP or bag that has several.")
_TIME = {
    "time": in_input(
        "--time",
        type=click.Choice(get_args(Clock)),
        help="Time of a message that becomes its frame's timestamp_ns; the order is always that of "
        "log time.  [default: log]",
    )
}


def many_logs_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """--recursive and --from-file, of commands that take many logs."""
    from_file = in_input(
        "--from-file",
        type=click.File(encoding="utf-8-sig", errors="surrogateescape"),
        metavar="LIST",
        help="File with one LOG per line; - for standard input. # begins a comment.",
    )
    text = "Also take the logs in all folders below a folder."
    return in_input("--recursive", is_flag=True, help=text)(from_file(function))


def named_logs(logs: tuple[str, ...], from_file: IO[str] | None, recursive: bool) -> list[NamedLog]:
    """The logs of a command that takes many, also those on servers.

    Raises click's UsageError if there are none, ours if the list is not text.
    """
    from sonarrec.readers.named_logs import NamedLog, log_arguments, logs_named

    if not logs and from_file is None:
        missing = "Missing argument 'LOG...' (or --from-file LIST)"
        raise click.UsageError(missing, click.get_current_context())

    def listed() -> Iterator[str]:
        for line in from_file or ():
            if from_file is not None and "\0" in line:
                raise UsageError(
                    f"--from-file {from_file.name}: not a list of logs, "
                    "which is UTF-8 text with one LOG per line; to run a single log leave out "
                    "--from-file"
                )
            yield line

    found: list[NamedLog] = []
    for name in log_arguments(logs, listed()):
        if is_url(name):
            from sonarrec.runs.remote import logs_at  # with fsspec, only where needed

            found += map(NamedLog, logs_at(name, recursive=recursive))
        else:
            found += logs_named(name, recursive=recursive)
    return found


@dataclass(frozen=True, slots=True)
class LogChoice:
    """How a log is to be read, as given on the command line."""

    values: Mapping[str, Any]  # of the options by name, None if not given

    def sonar(self) -> Any:
        """The Sonar of the flags alone. Raises UsageError if they are invalid."""
        from sonarrec.sonar import sonar_from_table

        stated = {key: self.values[key] for key in _FLAGS if self.values.get(key) is not None}
        if "bearings_deg" in stated:
            try:
                stated["bearings_deg"] = [float(b) for b in stated["bearings_deg"].split(",")]
            except ValueError:
                wrong = "--bearings-deg: expected numbers separated by commas"
                raise UsageError(wrong) from None
        sonar = sonar_from_table(stated, "command line")
        sonar.check_flags(sonar)
        return sonar

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of `open_log`: sonar, sonar_file, topic, and time if given.

        Raises SonarrecError if sonar_file cannot be used: once, not for each log.
        """
        file: Path | None = self.values["sonar_file"]
        if file is not None and file.is_file():  # a pipe can be read only once
            stated_in(file)
        time = {"time": self.values["time"]} if self.values.get("time") else {}
        return {"sonar": self.sonar(), "sonar_file": file, "topic": self.values["topic"], **time}

    def log_options(
        self, odometry: Path | None, odometry_topic: str | None, frames: str | None
    ) -> LogOptions:
        """How the log is to be read, with its poses and its frames A:B.

        Raises UsageError for values that are invalid.
        """
        from sonarrec.results.run_file import LogOptions, frame_span

        if odometry is not None and odometry_topic is not None:
            raise UsageError("--odometry and --odometry-topic: choose one of the two")
        poses = {"odometry": odometry, "odometry_topic": odometry_topic}
        span = None if frames is None else frame_span(frames)
        return LogOptions(**self.arguments(), **poses, frames=span)  # type: ignore[arg-type]


def odometry_options(group: Callable[..., Decorator]) -> dict[str, Decorator]:
    """--odometry and --odometry-topic. group: in_input or another."""
    return {
        "odometry": group(
            "--odometry",
            type=FILE,
            help="CSV of the sonar's poses (sonarrec help geometry).  [default: NAME.poses.csv or "
            "poses.csv beside the log; else the motion is measured between the images]",
        ),
        "odometry_topic": group(
            "--odometry-topic",
            metavar="TOPIC",
            help="Poses in the MCAP or bag: nav_msgs/Odometry or geometry_msgs/PoseStamped.",
        ),
    }


def log_options(*, flags: bool = False, time: bool = False) -> Decorator:
    """--topic, --sonar and optionally --time and the flags of the geometry, as `log_choice`."""
    options = {"topic": topic_option, "sonar_file": sonar_file}
    more = (_TIME if time else {}) | (_FLAGS if flags else {})
    return as_one("log_choice", options | more, LogChoice)


def stated_in(file: Path | None) -> Any:
    """The Sonar of a --sonar FILE, for commands that open no log; of None one without a key."""
    from sonarrec.sonar import Sonar, load_sonar

    return load_sonar(file) if file else Sonar()


# --sonar as the Sonar `sonar`, where no log is opened.
sonar_option = as_one(
    "sonar", {"sonar_file": sonar_file}, lambda values: stated_in(values["sonar_file"])
)
