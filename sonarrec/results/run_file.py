"""run.toml: what a run was made of, written, read back, and held against a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from sonarrec import __version__, config
from sonarrec.geometry import fan_for_image
from sonarrec.landmarks import LandmarkSet, landmarks_from_table, load_landmarks
from sonarrec.records import Clock, Fan, SonarrecError, UsageError
from sonarrec.sonar import Sonar, sonar_from_table
from sonarrec.toml import Count, checked, read_toml, types_of


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

    methods: names in estimates.csv. sonar: as stated, which serves a run again. source: the
    input's name, size in bytes and SHA-256. reading: how it was read (`Log.reading`). The fan is
    written out also where the geometry leaves it to defaults or to the log's messages, so that fan
    pixels can be read later.
    """
    resolved = Sonar(metres_per_pixel=fan.metres_per_pixel, apex_px=(fan.apex_column, fan.apex_row))
    table = sonar.as_table() | {
        key: value
        for key, value in resolved.as_table().items()
        # A polar image has no pixels of its own: these describe the fan it became.
        if sonar.layout == "fan"
    }
    name, size, digest = source
    tables = [config.as_table(c) for c in settings]
    return {
        "program": {"name": "sonarrec", "version": __version__, "methods": list(methods)},
        "input": {"name": name, "bytes": size, "sha256": digest, **reading},
        "config": tables if len(tables) > 1 else tables[0],
        "sonar": table,
        "fan": {
            "rows": fan.rows,
            "columns": fan.columns,
            "metres_per_pixel": fan.metres_per_pixel,
            "apex_px": [fan.apex_column, fan.apex_row],
            "range_min_m": fan.range_min_m,
            "range_max_m": fan.range_max_m,
            "field_of_view_deg": fan.bearing_max_deg - fan.bearing_min_deg,
            "tilt_deg": fan.tilt_deg,
            **({} if fan.height_m is None else {"height_m": fan.height_m}),
        },
        "landmarks": landmarks.as_table(),
    }


_SHAPES: dict[str, Any] = {
    **dict.fromkeys(("program", "input", "sonar", "fan", "landmarks", "odometry", "model"), dict),
    "config": dict | list[dict[str, Any]],
}
_INPUT: dict[str, Any] = {
    **dict.fromkeys(("name", "sha256", "topic"), str),
    "bytes": Count,
    "time": Clock,
    "problems": tuple[str, ...],
}
_PROGRAM: dict[str, Any] = {"methods": tuple[str, ...]}


def read_run(path: Path) -> dict[str, Any]:
    """run.toml as a table, {} where it is missing or empty.

    Raises SonarrecError where it cannot be read, or what sonarrec uses of it cannot be meant; of
    a later version's keys nothing is said.
    """
    if not path.is_file():
        return {}
    run = read_toml(path)
    for name, wanted in _SHAPES.items():
        if name in run:
            checked(run[name], wanted, f"{path}: {name}")
    geometry = types_of(Sonar)
    for name, known in (
        ("program", _PROGRAM),
        ("input", _INPUT),
        ("odometry", _INPUT),
        ("sonar", geometry),
        ("fan", geometry),
    ):
        for key in known.keys() & run.get(name, {}).keys():
            checked(run[name][key], known[key], f"{path}: {name}.{key}")
    return run


def fan_of_run(run: dict[str, Any], path: Path, given: Sonar | None) -> Fan | None:
    """The fan that pixel positions refer to; None where its scale and apex are not stated."""
    known = {field.name for field in fields(Sonar)}
    table = {key: value for key, value in run.get("sonar", {}).items() if key in known}
    # [fan] describes the images that pixels refer to, also where the recording was polar.
    fan = run.get("fan", {})
    table |= {key: value for key, value in fan.items() if key in known}
    sonar = sonar_from_table(table, str(path)).updated(given or Sonar())
    if sonar.metres_per_pixel is None or sonar.apex_px is None:
        return None
    geometry = sonar.complete(str(path) if run else "command line")
    # Scale and apex are stated, so the image's size does not enter the conversion.
    return fan_for_image(geometry, rows=1, columns=1)


@dataclass(frozen=True, slots=True)
class Stated:
    """What a run is told beside its settings: by the user, and under that by an earlier run.

    topic, time, odometry_topic: None where neither names one. odometry: what the earlier run used,
    empty where that was none or the log another. model: its appearance model, None for the
    built-in one.
    """

    landmarks: LandmarkSet
    sonar: Sonar
    topic: str | None
    time: Clock | None
    odometry_topic: str | None
    odometry: Mapping[str, Any]
    model: Mapping[str, Any] | None


def lay_under(
    earlier_run: Path | None,
    log: str,
    *,
    landmarks: str | None,
    sonar: Sonar,
    sonar_file: Path | None,
    topic: str | None,
    time: Clock | None,
    odometry: Path | None,
    odometry_topic: str | None,
) -> Stated:
    """What the user states of a log, with what an earlier run.toml states laid under it.

    Topic, time and odometry serve only where that run was of the log of this name. A plain
    settings file has none of the tables and changes nothing. Raises SonarrecError for tables that
    cannot be used, UsageError where the earlier run had a table of poses that is not given again.
    """
    run = {} if earlier_run is None else read_run(earlier_run)
    landmark_set, sonar = as_run(run, str(earlier_run), landmarks, sonar, sonar_file)
    same_log = run.get("input", {}).get("name") == log
    read_as = run["input"] if same_log else {}
    used = run.get("odometry", {}) if same_log else {}
    if used and odometry is None:
        odometry_topic = odometry_topic or used.get("topic")
        if odometry_topic is None:
            raise UsageError(
                f"{earlier_run}: that run used the odometry {used.get('name')}; "
                "give it again with --odometry"
            )
    return Stated(
        landmark_set,
        sonar,
        topic or read_as.get("topic"),
        time or read_as.get("time"),
        odometry_topic,
        used,
        run.get("model"),
    )


def as_run(
    run: Mapping[str, Any],
    where: str,
    landmarks: str | None,
    sonar: Sonar,
    sonar_file: Path | None,
) -> tuple[LandmarkSet, Sonar]:
    """The landmark set and geometry of a run, under what the user states.

    where: names run.toml in errors (SonarrecError).
    """
    if "sonar" in run and sonar_file is None:
        sonar = sonar_from_table(run["sonar"], where).updated(sonar)
    if landmarks is None and "landmarks" in run:
        return landmarks_from_table(run["landmarks"], f"{where}: [landmarks]"), sonar
    return load_landmarks(landmarks or "basin"), sonar


class RecordedLog(Protocol):
    """What tells one log from another; a `readers.log.Log` is one."""

    @property
    def path(self) -> Path: ...
    @property
    def frame_count(self) -> int | None: ...
    def digest_source(self) -> tuple[int, str]: ...


def check_same(log: RecordedLog, folder: Path, run: dict[str, Any]) -> list[str]:
    """What is amiss, in lines; SonarrecError where the results are of another log."""
    made_from = run.get("input", {})
    if "sha256" in made_from:
        size, digest = log.digest_source()
        if (size, digest) != (made_from.get("bytes"), made_from["sha256"]):
            raise SonarrecError(
                f"{folder}: results of another log, {made_from.get('name')} with "
                f"{made_from.get('bytes')} bytes and SHA-256 {made_from['sha256'][:12]}..., not of "
                f"{log.path} with {size} and {digest[:12]}...; give the log they were made from, "
                f"or `sonarrec run {log.path}`"
            )
    last = int(frames_table(folder)["frame"].max(initial=-1))
    if "sha256" not in made_from and log.frame_count is not None and last >= log.frame_count:
        raise SonarrecError(
            f"{folder / 'frames.csv'}: results of another log: frame {last} is listed, but "
            f"{log.path} has only {log.frame_count} frames"
        )
    if run.get("finished", True) is False:
        return [f"{folder}: the run was cut short; frames after {last} have no results"]
    return []


def frames_table(folder: Path) -> dict[str, Any]:
    """The frame and, where there is one, timestamp_ns column of frames.csv: name to array."""
    from sonarrec.tables import read_table  # with pandas, which `sonarrec run` does not need

    kinds: dict[str, Any] = {"frame": "whole", "timestamp_ns": "whole"}
    return read_table(folder / "frames.csv", kinds, ("frame",), "frame,timestamp_ns")
