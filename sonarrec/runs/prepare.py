"""Finds and checks everything that the run of one log needs, before anything is written."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any

from sonarrec.config import Config
from sonarrec.drawing.landmarks import distances, doubts
from sonarrec.errors import SonarrecError, UsageError, name_as_text
from sonarrec.geometry import PoseTable, floor_depth
from sonarrec.landmarks import DrawnSet, LandmarkSet, load_landmarks
from sonarrec.nouns import Fan, Frame
from sonarrec.readers import open_log
from sonarrec.readers.log import Log, digest_of
from sonarrec.readers.open import LANDMARKS_FILE, SONAR_FILE, Source, find_log
from sonarrec.readers.poses import POSES_FILE, read_poses
from sonarrec.recogniser.presets.side_by_side import SideBySide
from sonarrec.recogniser.restore.beam_width import with_beams
from sonarrec.recogniser.stage3.model import ModelFile, model_from_table, read_model
from sonarrec.results.folders import MADE, MADE_BY
from sonarrec.results.run_file import LogOptions, RunFile, read_run, run_table, span_text
from sonarrec.sonar import Sonar


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The user's choices for a run, apart from how the log is read."""

    configs: Sequence[Config]  # several: side by side, each under its own method name
    landmarks: str | Path | None = None  # a set by name or file; default: the earlier run's, basin
    model: Path | None = None  # of appearance; default: the earlier run's, else the built-in one
    earlier_run: Path | None = None  # a run.toml, whose geometry, landmarks and model serve where
    # none are given; a plain file of settings has none of these

    def check(self) -> None:
        """Raise UsageError if landmarks or model are invalid, before any log is opened."""
        if self.landmarks is not None:
            load_landmarks(self.landmarks)
        if self.model is not None:
            read_model(self.model)


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """An opened log, with its recogniser and the folder of its results."""

    log: Log
    frames: Iterator[Frame]  # those asked for; the first ones were read already
    frame_count: int | None  # how many; None if the log does not say
    fan: Fan
    landmarks: LandmarkSet
    poses: PoseTable | None
    recogniser: SideBySide
    basis: str  # a line on what it goes by, see `basis`
    table: dict[str, Any]  # the run.toml to write
    folder: Path  # of the results


@contextmanager
def prepare(
    path: Path,
    out: Path,
    log_options: LogOptions,
    run_options: RunOptions,
    name: str | None,
    served_as: Callable[[str], str] = str,
) -> Iterator[PreparedRun]:
    """Open a log and prepare its run into `out`/<name>/; name: default, the log's own.

    served_as: as of `process`.

    Raises SonarrecError for input or settings that cannot be used.
    """
    earlier = read_run(run_options.earlier_run)
    source = find_log(path, log_options.up_to)
    digest = digest_asked(earlier, source)
    same_log = is_same_log(earlier, source, digest)
    given, log_options = log_options, earlier.complete(log_options, same_log=same_log)
    log_options = _with_companions(source, log_options, again=same_log)
    landmarks, from_where = chosen_landmarks(source, run_options.landmarks, earlier)
    learned = _model(run_options, earlier)
    if learned is not None and isinstance(landmarks, DrawnSet):
        raise UsageError(f"--model: it is of discs, and {landmarks.name} has drawn plates")
    poses = _poses(source, log_options, earlier if same_log else read_run(None))
    with open_log(source, **log_options.arguments()) as log:
        span = log_options.frames or (0, None)
        frames = log.within(span)
        first = next(frames, None)  # raises if there is no usable frame at all
        if first is None:
            raise UsageError(f"{path}: no frame lies in --frames {span_text(span)}{log.why_none()}")
        fan = first.fan
        configs, about_beams = with_beams(run_options.configs, log.beam_width_deg, first)
        recogniser = SideBySide(configs, fan, landmarks, learned.model if learned else None, poses)
        log.diagnostics.note(*about_beams, *_about_landmarks(landmarks, fan, configs))
        folder = _results_of(source, out, name or log.name)
        identity = (name_as_text(log.name), *(digest or log.digest_source()))
        table = run_table(
            configs, recogniser.methods, log.stated, fan, landmarks, identity, log.reading()
        )
        served = served_as(str(path))
        if served != str(path):
            table["input"] |= dict.fromkeys(("path", "place"), served)
        else:
            place = os.path.relpath(path.resolve(), folder.resolve())
            table["input"] |= {"path": name_as_text(path), "place": name_as_text(place)}
        if log_options.frames is not None:
            table["input"]["frames"] = span_text(span)
        if poses is not None:
            table["odometry"] = dict(poses.source)
        if learned is not None:
            table["model"] = learned.as_table()
        frame_count = None  # not known
        if log.frame_count is not None:
            end = log.frame_count if span[1] is None else min(span[1], log.frame_count)
            frame_count = max(end - span[0], 0)
        seen = chain([first], frames)
        beams = beams_in_words(run_options.configs, configs, log, about_beams)
        line = basis(log, fan, source, given, earlier, (landmarks, from_where), beams)
        yield PreparedRun(
            log, seen, frame_count, fan, landmarks, poses, recogniser, line, table, folder
        )


def digest_asked(earlier: RunFile, source: Source) -> tuple[int, str] | None:
    """As `digest_of`, which takes long; None if the earlier run states none to compare with."""
    return digest_of(source) if earlier.input.sha256 else None


def is_same_log(earlier: RunFile, source: Source, digest: tuple[int, str] | None) -> bool:
    """Whether the earlier run was of this log; a note is told if of another of the same name.

    digest: from `digest_asked`; if None, names are compared.
    """
    name = name_as_text(source.name)
    alike = earlier.input.name == name
    if digest is None:
        return alike
    is_same = digest[1] == earlier.input.sha256
    if alike and not is_same:
        source.diagnostics.note(
            f"made from another {name}; only its settings and its geometry are used",
            about=earlier.path,
        )
    return is_same


def _results_of(log: Source, out: Path, name: str) -> Path:
    """The folder of a log's results in `out`; a note is told if another command writes there, too.

    Raises UsageError if it would replace the log, SonarrecError if it cannot be made there.
    """
    folder = out / name
    try:
        itself = folder.resolve() == log.path.resolve()
    except OSError as error:  # the current folder is gone
        raise SonarrecError(f"{folder}: cannot be written ({error.strerror})") from None
    if itself:
        raise UsageError(f"{folder}: this is the log itself; choose another --out")
    if folder.is_symlink():
        raise SonarrecError(
            f"{folder}: a link, through which no results are written; remove it, or choose another "
            "--out, which may be a link itself"
        )
    if folder.exists() and not folder.is_dir():
        raise SonarrecError(
            f"{folder}: a file is where the folder of the results would be; move it "
            "away, or choose another --out"
        )
    if folder.name in MADE:
        log.diagnostics.note(
            f"`sonarrec {MADE_BY[folder.name]} {out}` writes into this folder, too; give it an "
            "--out, or rename the log",
            about=folder,
        )
    return folder


def _with_companions(source: Source, log_options: LogOptions, again: bool) -> LogOptions:
    """The options with the poses that belong to the log.

    There is a note on them, since nobody named them. again: the run of a run.toml is repeated, so
    only its own poses may be used.
    """
    if again or log_options.odometry is not None or log_options.odometry_topic is not None:
        return log_options
    poses = source.beside(POSES_FILE)
    if poses is None:
        return log_options
    source.diagnostics.note(f"its poses are those of {poses}")
    return replace(log_options, odometry=poses)


def _about_landmarks(landmarks: LandmarkSet, fan: Fan, configs: Sequence[Config]) -> list[str]:
    """A note on a set that is hard to recognise in the middle of the window; none if it is not."""
    width_deg = max(c.features.beam_width_deg for c in configs)
    middle_m = (fan.range_min_m + fan.range_max_m) / 2
    beam_m = middle_m * math.radians(width_deg)
    found = doubts(landmarks, beam_m, distances(landmarks, beam_m))
    where = f"landmark set {landmarks.name}, at {middle_m:.2g} m"
    return [f"{where}: {'; '.join(found)} (see `sonarrec landmarks`)"] if found else []


def _model(run_options: RunOptions, earlier: RunFile) -> ModelFile | None:
    """The appearance model of the file, else of the earlier run; None for the built-in one."""
    if run_options.model is None:
        return None if earlier.model is None else model_from_table(earlier.model, str(earlier.path))
    learned = read_model(run_options.model)
    if all(c.features.measurement == "single" for c in run_options.configs):
        raise UsageError(
            f"--model {run_options.model}: only features.measurement = track uses a model, and "
            "this preset measures single frames by the published one"
        )
    return learned


def _poses(source: Source, log_options: LogOptions, earlier: RunFile) -> PoseTable | None:
    """The poses from a topic of the log, else from a table, if either is asked for.

    earlier: the run of this log that is repeated. Raises UsageError if it had a table of poses that
    is not given again.
    """
    earlier.check_poses(log_options)
    topic = log_options.odometry_topic
    if topic is not None:
        from sonarrec.readers.poses import (
            read_topic,  # with its decompressors, where needed
        )

        poses = read_topic(source.path, topic, log_options.time or "log")
    elif log_options.odometry is not None:
        poses = read_poses(log_options.odometry)
    else:
        return None
    if earlier.odometry and earlier.odometry != poses.source:
        source.diagnostics.note(
            f"the earlier run used other poses than {poses.name}", about=earlier.path
        )
    return poses


OPTION = "option"


def chosen_landmarks(
    source: Source | None, choice: str | Path | None, earlier: RunFile
) -> tuple[LandmarkSet, str]:
    """The set that the user chose, else the earlier run's, else that beside the log, else basin;
    and where it is from. Raises SonarrecError if it is invalid."""
    if choice is not None:
        return earlier.landmark_set(choice), f"{OPTION}, {choice}"
    if "landmarks" in earlier.table:
        return earlier.landmark_set(), str(earlier.path)
    beside = None if source is None else source.beside(LANDMARKS_FILE)
    return earlier.landmark_set(beside), "built in" if beside is None else str(beside)


def basis(
    log: Log,
    fan: Fan,
    source: Source,
    given: LogOptions,
    earlier: RunFile,
    landmarks: tuple[LandmarkSet, str],
    beams: str,
) -> str:
    """The line. given: the options of the command alone. earlier: the run.toml that completed
    them. landmarks: from `chosen_landmarks`. beams: from `beams_in_words`."""
    file = given.sonar_file or source.beside(SONAR_FILE)
    again = Sonar() if given.sonar_file else earlier.sonar()

    def origin(key: str) -> str:
        if getattr(given.sonar, key) is not None:
            return OPTION
        if getattr(again, key) is not None:
            return str(earlier.path)
        stated = getattr(log.stated, key)
        if stated is not None and stated != getattr(log.header, key):
            return str(file)
        return "log" if getattr(log.sonar, key) is not None else "assumed"

    height = origin("height_m")
    if height == "assumed" and fan.height_m is not None:
        height = "as the first frames show"
    view = "field_of_view_deg" if log.sonar.bearings_deg is None else "bearings_deg"
    window = [f"{fan.range_min_m:.4g}", f"to {fan.range_max_m:.4g} m"]
    ends = [origin("range_min_m"), origin("range_max_m")]
    one = [(" ".join(window), ends[0])] if ends[0] == ends[1] else [*zip(window, ends, strict=True)]
    parts = [
        *one,
        (f"{fan.bearing_max_deg - fan.bearing_min_deg:.4g} deg wide", origin(view)),
        (f"tilt {fan.tilt_deg:.4g} deg", origin("tilt_deg")),
        (f"height {floor_depth(fan):.3g} m", height),
    ]
    told = {"layout", "range_min_m", "range_max_m", view, "tilt_deg", "height_m", "frame_rate_hz"}
    others = [key for key in log.sonar.as_table() if key not in told]
    parts += [(key, where) for key in others if (where := origin(key)) not in ("log", "assumed")]
    chosen, from_where = landmarks
    # An origin once for those that follow each other.
    groups = groupby(parts, key=lambda part: part[1])
    by_origin = [f"{', '.join(text for text, _ in same)} ({where})" for where, same in groups]
    line = f"geometry {', '.join(by_origin)}; landmarks {chosen.name} ({from_where}); {beams}"
    unused = source.others(SONAR_FILE, file)
    unused += source.others(LANDMARKS_FILE, source.beside(LANDMARKS_FILE))
    if from_where.startswith(OPTION) or "landmarks" in earlier.table:
        unused += filter(None, [source.beside(LANDMARKS_FILE)])
    seen = [str(place) for place in unused if str(place) not in from_where]
    return line + (f"; not used: {', '.join(seen)}" if seen else "")


def beams_in_words(
    stated: Sequence[Config], used: Sequence[Config], log: Log, about: Sequence[str]
) -> str:
    """The beams' width, and where it is from. stated, used: the settings before and after
    `with_beams`. about: its notes."""
    widths = {c.features.beam_width_deg for c in used if c.features.beam_width_deg}
    if not widths:
        return "no beam width needed"
    how = "by its beams" if about else "usual for this view"
    if log.beam_width_deg is not None:
        how = "stated"
    if any(c.features.beam_width_deg for c in stated):
        how = "setting"
    return f"beams {' and '.join(f'{width:g}' for width in sorted(widths))} deg wide ({how})"
