"""Finds and checks everything that the run of one log needs, before anything is written."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from sonarrec.config import Config
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

    served_as: as of `process`. Raises SonarrecError for input or settings that cannot be used.
    """
    earlier = read_run(run_options.earlier_run)
    source = find_log(path, log_options.up_to)
    # To compute it takes long, so only where there is one to compare with.
    digest = digest_of(source) if earlier.input.sha256 else None
    same_log = earlier.input.name == name_as_text(source.name)
    if digest is not None:
        same_log = digest[1] == earlier.input.sha256
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
        log.diagnostics.note(*about_beams)
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
        geometry = _geometry(log, fan, source, given, earlier)
        line = f"{geometry}; landmarks {landmarks.name} ({from_where})"
        yield PreparedRun(
            log, seen, frame_count, fan, landmarks, poses, recogniser, line, table, folder
        )


def _results_of(source: Source, out: Path, name: str) -> Path:
    """The folder of a log's results in `out`. Raises UsageError if it would replace the log or lie
    in it, SonarrecError if it cannot be made there.
    """
    folder = out / name
    try:
        itself = source.path.resolve() in (folder.resolve(), out.resolve())
    except OSError as error:  # the current folder is gone
        raise SonarrecError(f"{folder}: cannot be written ({error.strerror})") from None
    if itself:
        raise UsageError(f"{source.path}: this is the log itself; choose another --out")
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise SonarrecError(
            f"{folder}: a file or a link is where the folder of the results would be; move it "
            "away, or choose another --out"
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
        from sonarrec.readers.poses import read_topic  # with its decompressors, where needed

        return read_topic(source.path, topic, log_options.time or "log")
    return None if log_options.odometry is None else read_poses(log_options.odometry)


def chosen_landmarks(
    source: Source | None, choice: str | Path | None, earlier: RunFile
) -> tuple[LandmarkSet, str]:
    """The set that the user chose, else the earlier run's, else that beside the log, else basin;
    and where it is from. Raises SonarrecError if it is invalid."""
    if choice is not None:
        return earlier.landmark_set(choice), f"option, {choice}"
    if "landmarks" in earlier.table:
        return earlier.landmark_set(), str(earlier.path)
    beside = None if source is None else source.beside(LANDMARKS_FILE)
    return earlier.landmark_set(beside), "built in" if beside is None else str(beside)


def _geometry(log: Log, fan: Fan, source: Source, given: LogOptions, earlier: RunFile) -> str:
    """The geometry that a run goes by, in words. given: the options of the command alone."""
    topic, file = log.reading().get("topic"), given.sonar_file or source.beside(SONAR_FILE)
    if not given.sonar_file and earlier.sonar() != Sonar():
        file = earlier.path
    origins = [f"topic {topic}"] * (topic is not None) + ["options"] * (given.sonar != Sonar())
    origins += [str(file)] * (file is not None)
    top = log.sonar.range_order or ("near_first" if log.sonar.layout == "polar" else "far_first")
    parts = (
        f"geometry {fan.range_min_m:.4g} to {fan.range_max_m:.4g} m",
        f"{fan.bearing_max_deg - fan.bearing_min_deg:.4g} deg wide",
        f"{top.removesuffix('_first')} range on top",
        f"tilt {fan.tilt_deg:.4g} deg" + " assumed" * (log.sonar.tilt_deg is None),
        f"height {floor_depth(fan):.3g} m" + " assumed" * (fan.height_m is None),
    )
    return f"{', '.join(parts)} ({', '.join(origins) or 'log'})"
