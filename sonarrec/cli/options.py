"""The options that several commands share; one of a single command stands above its function.

An option that stands for several, such as `settings`, hands the command one object.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, get_args

import click

from sonarrec.cli.endings import inform
from sonarrec.cli.groups import (
    ANY,
    EXISTING,
    FILE,
    NUMBER,
    Decorator,
    FiniteRange,
    ListFile,
    as_one,
    file_names,
    in_geometry,
    in_input,
    in_output,
    in_scoring,
    in_settings,
)
from sonarrec.errors import UsageError, as_usage, foreign_path, is_url
from sonarrec.sonar.frame import Clock
from sonarrec.tables import IMAGE_SUFFIXES

if TYPE_CHECKING:
    from sonarrec.config import Config
    from sonarrec.evaluation.compare import Limits
    from sonarrec.evaluation.rows import ScoringOptions
    from sonarrec.readers.named_logs import NamedLog
    from sonarrec.sonar.stated import Sonar


ENDINGS = IMAGE_SUFFIXES | {
    *(".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".wmv", ".gif", ".webp", ".svg"),
    *(".mcap", ".bag", ".db3", ".aris", ".ddf", ".oculus", ".npy", ".zip", ".parquet"),
    *(".html", ".htm", ".pdf", ".csv", ".tsv", ".txt", ".json", ".geojson", ".xml", ".md"),
    *(".xlsx", ".ods", ".toml"),
}
"""Endings of names of files: a folder that is to be made has none of them."""

# Logs: which, and how they are read

_RECURSIVE = in_input(
    "--recursive", is_flag=True, help="Also take the logs in all folders below a folder."
)
_FROM_FILE = in_input(
    "--from-file",
    type=ListFile(encoding="utf-8-sig", errors="surrogateescape"),
    metavar="LIST",
    help="File with one LOG per line; - for standard input. # begins a comment.",
)


def many_logs(function: Any) -> Any:
    """--recursive and --from-file, of commands that take many logs; see `named_logs`."""
    return _RECURSIVE(_FROM_FILE(function))


def named_logs(logs: tuple[str, ...], from_file: IO[str] | None, recursive: bool) -> list[NamedLog]:
    """The logs of a command that takes many, also those on servers.

    Raises click's UsageError if there are none, ours if the list is not text.
    """
    from sonarrec.readers.named_logs import NamedLog, log_arguments, logs_named, unread_below

    if not logs and from_file is None:
        missing = "Missing argument 'LOG...' (or --from-file LIST)"
        raise click.UsageError(missing, click.get_current_context())
    listed = [*from_file] if from_file is not None else []
    if from_file is not None and any("\0" in line for line in listed):
        raise UsageError(
            f"--from-file {from_file.name}: not a list of logs, which is UTF-8 text with one LOG "
            "per line; to run a single log leave out --from-file"
        )
    named: list[NamedLog] = []
    for name in log_arguments(logs, listed):
        if is_url(name):
            from sonarrec.runs.remote import logs_at  # with fsspec, only where needed

            named += map(NamedLog, logs_at(name, recursive=recursive))
        else:
            named += logs_named(name, recursive=recursive)
            if unread := unread_below(name, recursive=recursive):
                inform(f"{name}: not read: {unread}")
    return named


def _span(_: click.Context, __: click.Parameter, text: str | None) -> Any:
    from sonarrec.results.run_file import frame_span

    return None if text is None else frame_span(text)


def frames(text: str) -> Decorator:
    """--frames A:B, as numbers. text: what is done with these frames."""
    help_text = f"{text} A or B may be left out."
    return in_input("--frames", metavar="A:B", callback=_span, help=help_text)


def _spans(_: click.Context, __: click.Parameter, text: str | None) -> Any:
    from sonarrec.results.run_file import frame_spans

    return None if text is None else frame_spans(text)


def frame_list(text: str) -> Decorator:
    """--frames A:B,C:D,N, as spans. text: what is done with these frames."""
    help_text = f"{text} From A up to, not including, B; N is one frame."
    return in_input("--frames", metavar="A:B,N,...", callback=_spans, help=help_text)


topic = in_input("--topic", help="Image channel of an MCAP or bag that has several.")
_SONAR_FILE = in_input(
    "--sonar sonar_file",
    type=FILE,
    help="Geometry file, or the run.toml of an earlier run, in place of the log's own sonar.toml.",
)
_TIME = in_input(
    "--time",
    type=click.Choice(get_args(Clock)),
    help="Time of a message that becomes its frame's timestamp_ns; the order is always that of "
    "log time.  [default: log]",
)
GEOMETRY_TEXTS = {
    "range_min_m": "Slant range of the window's near end, m.",
    "range_max_m": "Slant range of the window's far end, m.",
    "field_of_view_deg": "Horizontal field of view, deg.",
    "tilt_deg": "Downward tilt of the sonar, deg.",
    "height_m": "Height of the sonar above the floor, m.",
    "frame_rate_hz": "Frames per second, if frames carry no time.",
    "metres_per_pixel": "Scale of a fan image, m.",
}


def _choice(key: str, choices: str, text: str, **attributes: Any) -> Decorator:
    return in_geometry(_flag(key), type=click.Choice(choices.split()), help=text, **attributes)


def _flag(key: str) -> str:
    return f"--{key.replace('_', '-')} {key}"


_GEOMETRY = {
    "layout": _choice("layout", "fan polar", "Layout of the images."),
    **{k: in_geometry(_flag(k), type=NUMBER, help=text) for k, text in GEOMETRY_TEXTS.items()},
    "apex_px": in_geometry(
        "--apex-px", type=NUMBER, nargs=2, metavar="COLUMN ROW", help="Apex of a fan image, pixels."
    ),
    "bearings_deg": in_geometry(
        "--bearings-deg", metavar="B,B,...", help="One bearing per beam of a polar image, deg."
    ),
    "beam_order": _choice(
        "beam_order",
        "range-major beam-major",
        "range-major or beam-major polar samples.  [default: found]",
        metavar="ORDER",
    ),
    "range_order": _choice(
        "range_order",
        "near_first far_first",
        "near_first or far_first on top.  [default: near_first; of fans far_first]",
        metavar="ORDER",
    ),
    "flip": in_geometry(
        "--flip/--no-flip", default=None, help="Exchange left and right, if a driver did."
    ),
    "pixel_scale": _choice(
        "pixel_scale",
        "linear log db",
        "Pixels are grey levels (linear), echo amplitudes (log) or decibels (db).  "
        "[default: found]",
        metavar="SCALE",
    ),
}
"""Keys of sonar.toml as flags, of `run` and `info` alone."""


def _reading(values: dict[str, Any]) -> dict[str, Any]:
    """Keyword arguments of `open_log`: sonar, sonar_file, topic, and time if given.

    Raises UsageError for flags that are invalid and a sonar_file that cannot be used: once, not for
    each log.
    """
    from sonarrec.sonar.stated import load_sonar, sonar_from_table

    stated = {key: values[key] for key in _GEOMETRY if values.get(key) is not None}
    if "bearings_deg" in stated:
        stated["bearings_deg"] = numbers("--bearings-deg", stated["bearings_deg"])
    with as_usage():
        sonar = sonar_from_table(stated, "command line")
    sonar.check_stated(sonar, "command line")
    file: Path | None = values["sonar_file"]
    if file is not None and file.is_file():  # a pipe can be read only once
        load_sonar(file)
    time = {"time": values["time"]} if values.get("time") else {}
    return {"sonar": sonar, "sonar_file": file, "topic": values["topic"], **time}


def reading(*, geometry: bool = False, time: bool = False) -> Decorator:
    """--topic, --sonar and optionally --time and the geometry's flags, as `reading`: keyword
    arguments of `open_log`."""
    chosen = {"topic": topic, "sonar_file": _SONAR_FILE} | ({"time": _TIME} if time else {})
    return as_one("reading", chosen | (_GEOMETRY if geometry else {}), _reading)


def _stated_in(values: dict[str, Any]) -> Sonar:
    from sonarrec.sonar.stated import Sonar, load_sonar

    return load_sonar(values["sonar_file"]) if values["sonar_file"] else Sonar()


# --sonar as the Sonar `sonar`, of commands that open no log.
sonar = as_one("sonar", {"sonar_file": _SONAR_FILE}, _stated_in)


def numbers(flag: str, text: str, form: str | None = None) -> list[float]:
    """The numbers of A,B,... Raises UsageError if they are not, or not so many as `form` names."""
    try:
        values = [FiniteRange().convert(number, None, None) for number in text.split(",")]
    except click.BadParameter:
        values = []
    if not values or (form and len(values) != form.count(",") + 1):
        several = f"{form}, {form.count(',') + 1} numbers" if form else "numbers"
        raise UsageError(
            f"{flag} {text}: expected {several} separated by commas, and decimals with a point"
        )
    return values


# Landmarks, results and truth


landmarks = in_input(
    "--landmarks",
    shell_complete=file_names,
    help="Landmark set: a built-in name, a TOML file, or the run.toml of an earlier run.  "
    "[default: that of the run.toml that is read, or the log's own landmarks.toml; else basin]",
)
pairs = in_input(
    "--pairs",
    type=FILE,
    help="In place of RESULTS and truth: a CSV with the columns results,ground_truth[,log], a row "
    "per log. With --compare: the truth of each log.",
)


def ground_truth(text: str, *, of_each: bool = False) -> Decorator:
    """--ground-truth. text: what it is for. of_each: or a folder that has one of each log."""
    kind = EXISTING if of_each else FILE
    return in_input("--ground-truth", type=kind, help=f"{text} Columns: sonarrec help truth.")


def compare(text: str) -> Decorator:
    """--compare OLD NEW. text: what is made of the two."""
    kind: Any = ANY, ANY
    return in_input("--compare", type=kind, metavar="OLD NEW", shell_complete=file_names, help=text)


def _one(_: click.Context, __: click.Parameter, methods: tuple[str, ...]) -> str | None:
    if len(methods) > 1:
        raise UsageError(f"--method: this command takes one method, not {', '.join(methods)}")
    return methods[0] if methods else None


method = in_input(
    "--method",
    multiple=True,
    callback=_one,
    metavar="NAME",
    help="Method of estimates.csv.  [default: framework, else the first with tracks]",
)

# Scoring

_SCORING = {
    "min_visible": in_scoring(
        "--min-visible",
        type=NUMBER,
        default=0.9,
        help="Strict: least share of the disc in view; with less a landmark is ignored.",
    ),
    "within_m": in_scoring(
        "--within within_m",
        type=NUMBER,
        metavar="M",
        help="Strict: how far a claim may lie from the truth, m.  [default: half a disc]",
    ),
    "tolerance_s": in_scoring(
        "--tolerance tolerance_s",
        type=NUMBER,
        metavar="SECONDS",
        help="Longest time from a row of truth to its frame.  [default: half a frame]",
    ),
    "landmarks": landmarks,
    "methods": in_scoring(
        "--method methods",
        multiple=True,
        metavar="NAME",
        help="Method of estimates.csv; repeatable, the first leads.  [default: all]",
    ),
    "sonar_file": _SONAR_FILE,
}


def _scoring(values: dict[str, Any]) -> ScoringOptions:
    from sonarrec.evaluation.rows import ScoringOptions

    sonar = _stated_in(values)
    return ScoringOptions(sonar=sonar, **{k: v for k, v in values.items() if k != "sonar_file"})


# What is scored, how, and in which geometry, as one `scoring`: ScoringOptions.
scoring = as_one("scoring", _SCORING, _scoring)


class _MethodRate(click.ParamType[tuple[str, float]]):
    """RATE, for every method looked at, or METHOD=RATE: (method or "", rate)."""

    name = "[METHOD=]RATE"

    def convert(self, value: Any, *context: Any) -> tuple[str, float]:
        method, _, rate = str(value).rpartition("=")
        return method, FiniteRange(0, 1).convert(rate, *context)


_LIMITS = {
    "least_tpr": in_scoring(
        "--least-tpr",
        type=_MethodRate(),
        multiple=True,
        help="Exit with 4 if the TPR over all IDs is lower.",
    ),
    "most_fpr": in_scoring(
        "--most-fpr",
        type=_MethodRate(),
        multiple=True,
        help="Exit with 4 if the FPR over all IDs is higher.",
    ),
}


def _limits(values: dict[str, Any]) -> Limits:
    from sonarrec.evaluation.compare import Limits

    return Limits(least_tpr=dict(values["least_tpr"]), most_fpr=dict(values["most_fpr"]))


# --least-tpr and --most-fpr, as one `limits`: Limits.
limits = as_one("limits", _LIMITS, _limits)

# Settings


_SETTINGS = {
    "preset": in_settings(
        "--preset",
        metavar="NAME[,NAME]",
        help="default (frame by frame), offline (results are revised by what the log shows later) "
        "or paper (every rule as published). `run` and `check` take several.",
    ),
    "config_file": in_settings(
        "--config config_file",
        type=FILE,
        help="Settings (TOML), or the run.toml of an earlier run.",
    ),
    "assignments": in_settings(
        "--set assignments",
        multiple=True,
        metavar="STAGE.KEY=VALUE",
        help="Change one setting; repeatable. All: `sonarrec config`.",
    ),
}


@dataclass(frozen=True, slots=True)
class SettingsChoice:
    """The settings as given on the command line."""

    preset: str | None
    config_file: Path | None
    """Of settings, or the run.toml of an earlier run."""
    assignments: tuple[str, ...]

    def configs(self) -> list[Config]:
        """A Config per preset, changed by the file, then by --set."""
        from sonarrec import config

        chosen = config.configs(self.preset.split(",") if self.preset else [], self.config_file)
        return [config.with_assignments(c, self.assignments) for c in chosen]

    def config(self) -> Config:
        """The only Config. Raises UsageError if several presets are given."""
        first, *more = self.configs()
        if more:
            raise UsageError("several presets are given, but this command takes one --preset")
        return first


settings = as_one("settings", _SETTINGS, lambda values: SettingsChoice(**values))

# Output

quiet = in_output(
    "-q --quiet",
    is_flag=True,
    help="No progress bar and no summary; problems and notes are still printed.",
)


def json(text: str = "Print one JSON document on stdout.") -> Decorator:
    """--json, as `as_json`."""
    return in_output("--json as_json", is_flag=True, help=text)


def out(kind: click.Path, text: str, *endings: str, **options: Any) -> Decorator:
    """-o, --out. text: what it names. endings: of the files that the command writes there.

    Other endings of files are refused, so that no page is called .pdf, and no folder x.avi.
    """
    written = [*endings, *(["a folder (a name without an ending)"] if kind.dir_okay else [])]

    def checked(_: click.Context, __: click.Parameter, value: Path | str | None) -> Any:
        path = Path(value or "")
        if not path.exists() and (meant := foreign_path(str(path))):
            raise UsageError(f"--out {value}: not a name of a file or folder{meant}")
        ending = path.suffix.lower()
        is_wrong = ending in ENDINGS if kind.dir_okay else ending != ""
        if is_wrong and ending not in endings and (path.is_file() or not path.exists()):
            raise UsageError(
                f"--out {value}: {ending} is not written here; choose {' or '.join(written)}"
            )
        return value

    return in_output("-o --out", type=kind, help=text, callback=checked, **options)
