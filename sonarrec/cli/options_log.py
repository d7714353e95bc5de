"""Options of commands that open recordings: which logs, and how they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, get_args

import click

from sonarrec.cli.groups import FILE, Decorator, as_one, in_geometry, in_input, in_pixels
from sonarrec.errors import UsageError
from sonarrec.nouns import Clock, ColourMap

if TYPE_CHECKING:
    from sonarrec.results.run_file import LogOptions

GEOMETRY_TEXTS = {
    "range_min_m": "Slant range of the window's near end, m.",
    "range_max_m": "Slant range of the window's far end, m.",
    "field_of_view_deg": "Horizontal field of view, deg.",
    "tilt_deg": "Downward tilt of the sonar, deg.",
    "height_m": "Height of the sonar above the floor, m.",
    "frame_rate_hz": "Frames per second, if frames carry no time.",
    "beam_width_deg": "Width of the beams, two-way, between half-power points, deg.",
    "metres_per_pixel": "Scale of a fan image, m.",
}
GEOMETRY_OPTIONS = {
    "sonar_file": in_geometry(
        "--sonar sonar_file",
        type=FILE,
        help="Geometry file, in place of the sonar.toml beside the log.",
    ),
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
    "ranges_m": in_geometry(
        "--ranges-m", metavar="R,R,...", help="One slant range per row of a polar image, m."
    ),
}
_PIXELS = {
    "beam_order": in_pixels(
        "--beam-order",
        type=click.Choice(["range-major", "beam-major"]),
        help="Polar samples: all beams of one range first, or all ranges of one beam.  "
        "[default: found from the first ping]",
    ),
    "range_order": in_pixels(
        "--range-order",
        type=click.Choice(["near_first", "far_first"]),
        help="Rows of polar images: the nearest range on top, or the farthest.  "
        "[default: near_first]",
    ),
    "flip": in_pixels(
        "--flip/--no-flip", default=None, help="Exchange left and right, if a driver did."
    ),
    "colour_map": in_pixels(
        "--colour-map",
        type=click.Choice(get_args(ColourMap)),
        metavar="NAME",
        help="Colour map of pictures in false colour, such as jet or viridis; luminance if they "
        "are in none.  [default: found from the first frames; sonarrec help geometry]",
    ),
    "pixel_scale": in_pixels(
        "--pixel-scale",
        type=click.Choice(["linear", "log", "db"]),
        help="What pixels hold: grey levels (logarithms of the echo, ready to show), echo "
        "amplitudes, or decibels.  "
        "[default: found from their type and the first frames; sonarrec help geometry]",
    ),
    "full_scale": in_pixels(
        "--full-scale",
        type=float,
        metavar="VALUE",
        help="The pixel value that becomes white.  "
        "[default: the type's largest; for log and db from the first ping]",
    ),
    "dynamic_range_db": in_pixels(
        "--dynamic-range-db",
        type=float,
        help="Decibels from black to white, for log and db.  [default: 50]",
    ),
}
topic_option = in_input(
    "--topic", help="Channel of an MCAP or bag that holds several image channels."
)
_TIME = {
    "time": in_input(
        "--time",
        type=click.Choice(get_args(Clock)),
        help="Which time of a message of an MCAP or bag becomes the timestamp_ns of its frame. "
        "The order of frames is always that of log time.  [default: log]",
    )
}


def many_logs_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """--recursive and --from-file, of commands that take many logs."""
    from_file = in_input(
        "--from-file",
        type=click.File(encoding="utf-8-sig", errors="surrogateescape"),
        metavar="LIST",
        help="File with one LOG per line; - for standard input. Empty lines and lines that begin "
        "with # are skipped.",
    )
    text = "Also take the logs in all folders below a folder."
    return in_input("--recursive", is_flag=True, help=text)(from_file(function))


def named_logs(logs: tuple[str, ...], from_file: IO[str] | None, recursive: bool) -> Any:
    """The logs of a command that takes many: NamedLogs, and RemoteLogs for those on servers.

    Raises click's UsageError if there are none, ours if the list is not text.
    """
    from sonarrec.remote.run import all_logs

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

    return all_logs(logs, listed(), recursive=recursive)


@dataclass(frozen=True, slots=True)
class LogChoice:
    """How a log is to be read, as given on the command line."""

    values: Mapping[str, Any]  # of the options by name, None if not given

    def sonar(self) -> Any:
        """The Sonar of the flags alone. Raises UsageError if they are invalid."""
        from sonarrec.sonar import sonar_from_table

        keys = [key for key in (*GEOMETRY_OPTIONS, *_PIXELS) if key != "sonar_file"]
        stated = {key: self.values[key] for key in keys if self.values.get(key) is not None}
        for key in {"bearings_deg", "ranges_m"} & set(stated):
            try:
                stated[key] = [float(number) for number in stated[key].split(",")]
            except ValueError:
                flag = f"--{key.replace('_', '-')}"
                raise UsageError(f"{flag}: expected numbers separated by commas") from None
        sonar = sonar_from_table(stated, "command line")
        sonar.check_flags(sonar)
        return sonar

    def sonar_without_log(self) -> Any:
        """The Sonar of --sonar, changed by the flags, for commands that open no log."""
        from sonarrec.sonar import Sonar, load_sonar

        file = self.values["sonar_file"]
        return (load_sonar(file) if file else Sonar()).updated(self.sonar())

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of `open_log`: sonar, sonar_file, topic, and time if given.

        Raises SonarrecError if sonar_file cannot be used: once, not for each log.
        """
        from sonarrec.sonar import load_sonar

        file: Path | None = self.values["sonar_file"]
        if file is not None and file.is_file():  # a pipe can be read only once
            load_sonar(file)
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
            help="CSV of the sonar's poses: timestamp or timestamp_ns, yaw (deg, positive to the "
            "right) and, if known, x, y (m).  [default: NAME.poses.csv or poses.csv beside the "
            "log; without one the motion is measured between the images]",
        ),
        "odometry_topic": group(
            "--odometry-topic",
            metavar="TOPIC",
            help="Poses in the MCAP or bag itself: nav_msgs/Odometry or geometry_msgs/PoseStamped.",
        ),
    }


def log_options(*, pixels: bool = True, time: bool = False) -> Decorator:
    """--topic, the geometry and optionally pixels and --time, as one `log_choice`."""
    more = _TIME if time else {}
    options = {"topic": topic_option} | more | GEOMETRY_OPTIONS | (_PIXELS if pixels else {})
    return as_one("log_choice", options, LogChoice)


# The geometry alone, as the Sonar `sonar`, where no log is opened.
geometry_options = as_one(
    "sonar", GEOMETRY_OPTIONS, lambda values: LogChoice(values).sonar_without_log()
)
