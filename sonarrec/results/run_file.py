"""run.toml: the inputs and settings of a run, written and read."""

from __future__ import annotations

import hashlib
import json
import math
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from cv2.version import opencv_version

from sonarrec import config
from sonarrec.errors import SonarrecError, UsageError, command_line, number_of
from sonarrec.landmarks import LandmarkSet, landmarks_from_table, load_landmarks
from sonarrec.results.folders import TABLES, is_file, parent_of
from sonarrec.results.identity import PROGRAM, identity, why_outdated
from sonarrec.sonar.frame import Clock, Fan
from sonarrec.sonar.geometry import fan_for_image
from sonarrec.sonar.stated import Sonar, sonar_from_table
from sonarrec.tables.outputs import free_name
from sonarrec.tables.toml import AtLeastOne, Count, Finite, checked, read_toml, types_of

_EDGES = ("bearing_min_deg", "bearing_max_deg")
_FAN = (
    *("rows", "columns", "metres_per_pixel", "apex_px", "range_min_m", "range_max_m"),
    *("field_of_view_deg", *_EDGES, "tilt_deg", "height_m"),
)
"""The keys of [fan]."""
_INPUT = ("name", "bytes", "sha256")


def run_table(
    settings: Sequence[config.Config],
    methods: Sequence[str],
    sonar: Sonar,
    fan: Fan,
    landmarks: LandmarkSet,
    source: tuple[str, int, str],
    reading: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """The tables of run.toml: all that is needed to get the same results again.

    methods: names in estimates.csv. sonar: the geometry as stated. fan: the complete geometry, with
    values from defaults and messages, so that fan pixels can be converted later. source: the
    input's name, and what identifies it, as `Input.is_of`. reading: how it was read
    (`Log.reading`).
    """
    tables = [asdict(c) for c in settings]
    of_fan = asdict(fan) | {
        "apex_px": [fan.apex_column, fan.apex_row],
        "field_of_view_deg": fan.bearing_max_deg - fan.bearing_min_deg,
    }
    instructions = np.show_config(mode="dicts")["SIMD Extensions"]["found"]
    table: dict[str, Any] = {
        "program": {**PROGRAM, "methods": list(methods)},
        "input": dict(zip(_INPUT, source, strict=True)) | dict(reading),
        "config": tables if len(tables) > 1 else tables[0],
        "sonar": sonar.as_table(),
        "fan": {key: of_fan[key] for key in _FAN if of_fan[key] is not None},
        "landmarks": landmarks.as_table(),
        # The last digits depend on it: numpy's exp and log round differently with AVX-512.
        "ran_on": {
            "processor": " ".join([platform.machine(), *instructions]),
            "numpy": np.__version__,
            "opencv": opencv_version,
        },
    }
    table["program"] |= identity(table)
    return table


_ROWS = {
    "frames.csv": "frames_processed",
    "estimates.csv": "estimates",
    "sightings.csv": "sightings",
}
"""The keys of [input] that state how many rows the tables have."""
_OF_THE_END = (*_ROWS.values(), "tables_sha256", "frames_unusable", "candidates", "problems")
"""Keys of [input] that only a finished run has."""


def csv_rows(path: Path) -> int:
    """The number of rows of a table that a run wrote: no cell of it holds a line end."""
    lines, last = 0, b"\n"
    with path.open("rb") as file:
        while block := file.read(2**20):
            lines, last = lines + block.count(b"\n"), block[-1:]
    return max(lines + (last != b"\n") - 1, 0)


def tables_written(folder: Path) -> dict[str, Any]:
    """The keys of [input] with the rows of the tables, and their SHA-256."""
    tables = [name for name in _ROWS if is_file(folder / name)]
    return {
        **{_ROWS[name]: csv_rows(folder / name) for name in tables},
        "tables_sha256": {name: _sha256(folder / name) for name in tables},
    }


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tables_changed(folder: Path, stated: Input) -> list[str]:
    """A line for each table that is not as the run wrote it, and as run.toml states it."""
    lines = []
    for name, key in _ROWS.items():
        if not is_file(folder / name):
            continue
        wrote = getattr(stated, key)
        if (held := csv_rows(folder / name)) < wrote:
            lines.append(f"{name} holds {held} of the {wrote} rows that the run wrote")
        elif stated.tables_sha256.get(name, digest := _sha256(folder / name)) != digest:
            lines.append(f"{name} was changed after the run ({wrote} rows then, {held} now)")
    return lines


def existing_results(folder: Path, table: dict[str, Any]) -> tuple[Input | None, str]:
    """Compare the finished results in a folder with the run.toml of a run to come.

    Returns their [input] if the run would give the same, else None; and why it would not, empty if
    there are none. Raises SonarrecError if they belong to another log (by path and SHA-256),
    another topic or another program, or if their run.toml is invalid.
    """
    path = folder / "run.toml"
    present = [name for name in ("run.toml", *TABLES) if (folder / name).is_file()]
    if present and not path.is_file():
        raise SonarrecError(
            f"{folder}: holds {present[0]} but no run.toml, so it may not be of sonarrec; choose "
            "another --out, or give --overwrite"
        )
    run = read_run(path) if len(present) > len(TABLES) else None
    if run is None or not run.table.get("finished") or "input" not in run.table:
        return None, ""
    coming = json.loads(json.dumps(table))  # tuples become lists, as in a file that is read
    old, new = run.table["input"], coming["input"]
    other, is_changed = "", not run.input.is_of(new["bytes"], new["sha256"])
    if is_changed and old.get("place") != new["place"]:
        other = f"another log ({old.get('path')})"
    elif old.get("topic", new.get("topic")) != new.get("topic"):
        other = f"topic {old['topic']} of this log"
    if other:
        raise SonarrecError(
            f"{folder}: holds the results of {other}; choose another --out, or give --overwrite"
        )
    if why := why_outdated(run.table):
        return None, why
    if is_changed:
        return None, "the log has changed"
    # Not compared: what only a finished run states, where it ran and what its log was called.
    before = {k: v for k, v in run.table.items() if k != "finished"}
    before["input"] = {k: v for k, v in old.items() if k not in _OF_THE_END}
    before["input"] |= {key: new[key] for key in ("path", "place") if key in new}
    before["ran_on"] = coming["ran_on"]
    if before == coming:
        changed = tables_changed(folder, run.input)
        return (None, changed[0]) if changed else (run.input, "")
    flat_old, flat_new = dict(flat(before)), dict(flat(coming))
    keys = [k for k in {**flat_new, **flat_old} if flat_old.get(k) != flat_new.get(k)]
    keys = [k for k in keys if k != "program.settings_sha256"]  # which sums up others
    more = f" and {len(keys) - 3} more" if len(keys) > 3 else ""
    return None, f"other settings: {', '.join(keys[:3])}{more}"


def flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of everything in a run.toml except the tables themselves.

    Settings are named as for --set; if there are several presets, with the preset in front.
    """
    for key, value in table.items():
        name = f"{prefix}{key}"
        if name == "config":
            several = isinstance(value, list)
            for n, settings in enumerate(value if several else [value]):
                preset = f"{settings.get('preset', n)}: " if several else ""
                yield from flat(settings, preset)
        elif isinstance(value, Mapping):
            yield from flat(value, f"{name}.")
        else:
            yield name, value


def frame_span(text: str) -> tuple[int, int | None]:
    """(first, one past the last or None) of "A:B", where A or B may be left out.

    Raises UsageError if the text has another form or the span is empty.
    """
    match = re.fullmatch(r"([0-9]{0,18}):([0-9]{0,18})", text)
    if match is None:
        raise UsageError(f"--frames: expected A:B, two frame numbers, not {text[:60]!r}")
    first, end = int(match[1] or 0), int(match[2]) if match[2] else None
    if end is not None and end <= first:
        raise UsageError(
            f"--frames {text}: there is no frame from {first} up to, not including, {end}"
        )
    return first, end


def frame_spans(text: str) -> list[tuple[int, int | None]]:
    """The spans of "A:B, C:D, N", where N is one frame; blanks do not count. Raises UsageError if
    the text has another form or a span is empty."""
    spans = list[tuple[int, int | None]]()
    for part in (part.strip() for part in text.split(",")):
        if part.isdecimal() and len(part) <= 18:
            spans.append((int(part), int(part) + 1))
        elif ":" in part:
            spans.append(frame_span(part))
        else:
            raise UsageError(
                f"--frames: expected frame numbers N and spans A:B with commas between them, such "
                f"as 12,40:50, not {part[:60]!r}"
            )
    return spans


def span_text(span: tuple[int, int | None]) -> str:
    """The text that `frame_span` reads."""
    return f"{span[0]}:{'' if span[1] is None else span[1]}"


def cut_short(name: str, frames: int, action: str) -> str:
    """A message on results whose run.toml says that they are not finished.

    frames: how many they hold. action: what a command does with these.
    """
    return (
        f"{name}: the run was cut short (run.toml says finished = false); "
        f"only {number_of(frames, 'frame')} could be {action}"
    )


def rerun(log: Path, run: Path, *options: object, poses: object = None) -> str:
    """The command that repeats a run with other options, into a folder that is not there yet.

    log: where it is. run: the run.toml. options: the last is the value that is new. poses: the
    table of the run, which its run.toml does not hold.
    """
    given = () if poses is None else ("--odometry", poses)
    results, how = parent_of(run.parent), re.sub(r"\W+", "-", str(options[-1]))
    out = free_name(results.parent / f"{results.resolve().name}_{how}")
    return command_line("run", log, "--config", run, *options, *given, "-o", out)


@dataclass(frozen=True, slots=True)
class LogOptions:
    """How to read a log, as given by the user; None: not given."""

    sonar: Sonar = field(default_factory=Sonar)
    """Keys that take precedence over every file."""
    sonar_file: Path | None = None
    """In place of the log's own sonar.toml."""
    topic: str | None = None
    """The image channel of an MCAP."""
    time: Clock | None = None
    """Which of a message's times is that of its frame; default: log time."""
    odometry: Path | None = None
    """A table of the sonar's poses, see readers/poses.py."""
    odometry_topic: str | None = None
    """The topic with the poses, in place of a table."""
    frames: tuple[int, int | None] | None = None
    """From the first up to, not including, the second."""
    up_to: Path | None = None
    """The highest folder searched for files that belong to the log."""

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of `open_log`."""
        named = {key: getattr(self, key) for key in ("sonar", "sonar_file", "topic", "up_to")}
        return named | {"time": self.time or "log"}


@dataclass(frozen=True, slots=True)
class Input:
    """[input] of run.toml: the log and how it was read; None: not stated."""

    name: str | None = None
    path: str | None = None
    """As it was given."""
    place: str | None = None
    """Relative to the results folder; or its URL."""
    bytes: Count | None = None
    sha256: str | None = None
    topic: str | None = None
    time: Clock | None = None
    frames: str | None = None
    frames_processed: Count = 0
    """This and the next four: of a finished run; earlier versions state fewer of them, or none."""
    frames_unusable: Count = 0
    candidates: Count = 0
    estimates: Count = 0
    sightings: Count = 0
    tables_sha256: dict[str, str] = field(default_factory=dict)
    """By name of the file."""
    problems: tuple[str, ...] = ()

    def is_of(self, size: int | None, sha256: str | None) -> bool:
        """Whether these are the log's size in bytes and its SHA-256."""
        return (self.bytes, self.sha256) == (size, sha256)

    @property
    def recording(self) -> tuple[str, str | None] | None:
        """SHA-256 and topic; None if the SHA-256 is not stated."""
        return (self.sha256, self.topic) if self.sha256 else None


@dataclass(frozen=True, slots=True)
class RunFile:
    """run.toml as it was read; a missing file counts as empty."""

    path: Path
    table: Mapping[str, Any]
    """The whole file."""
    finished: bool
    """False if the run was cut short."""
    methods: tuple[str, ...] | None
    """Of estimates.csv."""
    input: Input
    configs: tuple[Mapping[str, Any], ...]
    """The settings, of each preset."""
    odometry: Mapping[str, Any]
    """Empty: none was used."""
    model: Mapping[str, Any] | None
    """Of `sonarrec calibrate`; None: the built-in reader."""

    def landmark_set(self, choice: str | Path | None = None) -> LandmarkSet:
        """The set that the user chose by name or file, else the run's, else `basin`."""
        if choice is None and "landmarks" in self.table:
            return landmarks_from_table(self.table["landmarks"], f"{self.path}: [landmarks]")
        return load_landmarks(choice or "basin")

    def sonar(self) -> Sonar:
        """The geometry as it was stated for the run."""
        return sonar_from_table(self.table.get("sonar", {}), str(self.path))

    def complete(self, log_options: LogOptions, *, same_log: bool) -> LogOptions:
        """The options, completed with the run's geometry.

        same_log: complete it with the run's topic, time, frames and topic of poses as well.
        """
        own = self.input if same_log else Input()
        poses = self.odometry.get("topic") if same_log and log_options.odometry is None else None
        sonar = log_options.sonar
        return replace(
            log_options,
            sonar=sonar if log_options.sonar_file else self.sonar().updated(sonar),
            topic=log_options.topic or own.topic,
            time=log_options.time or own.time,
            odometry_topic=log_options.odometry_topic or poses,
            frames=log_options.frames or (self.span() if same_log else None),
        )

    @property
    def is_trained_on(self) -> bool:
        """Whether the model was learned from a log of the same name, as its comment says."""
        text = str((self.model or {}).get("text"))
        names = re.search(r"^# learned from \d+ frames? of (.+)$", text, re.MULTILINE)
        return names is not None and self.input.name in names[1].split(", ")

    def check_poses(self, log_options: LogOptions) -> None:
        """Raise UsageError if the run had a table of poses that is not given again."""
        if self.odometry and log_options.odometry is None and log_options.odometry_topic is None:
            raise UsageError(
                f"{self.path}: that run used the odometry {self.odometry.get('name')}; "
                "give it again with --odometry"
            )

    def span(self) -> tuple[int, int | None] | None:
        """The span of frames that the run was limited to; None if not stated."""
        return None if self.input.frames is None else frame_span(self.input.frames)

    def fan(self, override: Sonar | None = None) -> Fan | None:
        """The fan that pixel positions refer to; None if its scale or apex is not stated."""
        sonar_keys = {f.name for f in fields(Sonar)}
        # [fan] describes the images that pixels refer to, even if the recording was polar.
        table = {**self.table.get("sonar", {}), **self.table.get("fan", {})}
        table = {key: value for key, value in table.items() if key in sonar_keys}
        sonar = sonar_from_table(table, str(self.path)).updated(override or Sonar())
        if sonar.metres_per_pixel is None or sonar.apex_px is None:
            return None
        geometry = sonar.complete(str(self.path) if self.table else "command line")
        # If the image size is not stated, it is large enough for the whole fan.
        room = math.ceil(geometry.range_max_m / sonar.metres_per_pixel)
        size = self.table.get("fan", {})
        rows = size.get("rows", math.ceil(sonar.apex_px[1]) + room)
        columns = size.get("columns", math.ceil(sonar.apex_px[0]) + room)
        fan = fan_for_image(geometry, int(rows), int(columns))
        edges = {key: size[key] for key in _EDGES if key in size}
        if override is not None and (override.field_of_view_deg or override.bearings_deg):
            edges = {}
        return replace(fan, **edges)  # a field of view alone is symmetric


_SHAPES: dict[str, Any] = {
    **dict.fromkeys(("program", "input", "sonar", "fan", "landmarks", "odometry", "model"), dict),
    "config": dict | list[dict[str, Any]],
    "finished": bool,
}


def read_run(path: Path | None) -> RunFile:
    """A run.toml; None and a missing file count as empty.

    Raises SonarrecError if it cannot be read or a key in use is invalid. Unknown keys are allowed:
    a later version may have written them.
    """
    table = read_toml(path) if path is not None and is_file(path) else {}
    path = path or Path("run.toml")
    for name in _SHAPES.keys() & table.keys():
        checked(table[name], _SHAPES[name], f"{path}: {name}")

    def known_keys(name: str, types: Mapping[str, Any]) -> dict[str, Any]:
        """The keys of the table `name` that have a type here, each checked against it."""
        section = table.get(name, {})
        return {
            key: checked(section[key], types[key], f"{path}: {name}.{key}")
            for key in types
            if key in section
        }

    known_keys("sonar", types_of(Sonar))
    size = {"rows": AtLeastOne, "columns": AtLeastOne}
    known_keys("fan", types_of(Sonar) | size | dict.fromkeys(_EDGES, Finite))
    known_keys("odometry", types_of(Input))
    configs = table.get("config", [])
    return RunFile(
        path=path,
        table=table,
        finished=table.get("finished", True),
        methods=known_keys("program", {"methods": tuple[str, ...]}).get("methods"),
        input=Input(**known_keys("input", types_of(Input))),
        configs=tuple(configs) if isinstance(configs, list) else (configs,),
        odometry=table.get("odometry", {}),
        model=table.get("model"),
    )
