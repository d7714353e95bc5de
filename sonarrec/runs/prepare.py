"""Finds and checks everything that the run of one log needs, before anything is written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from sonarrec.errors import SonarrecError, UsageError, listed, name_as_text
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.readers import open_log
from sonarrec.readers.containers.images import names_an_image
from sonarrec.readers.log import Log, digest_of
from sonarrec.readers.open import (
    LANDMARKS_FILE,
    SONAR_FILE,
    Source,
    find_log,
    misnamed,
    misspelt,
    names_a_log,
)
from sonarrec.readers.poses import POSES_FILE, read_poses
from sonarrec.recogniser.presets.side_by_side import SideBySide
from sonarrec.recogniser.restore.beam_width import with_beams
from sonarrec.recogniser.stage3.model_file import ModelFile, model_from_table, read_model
from sonarrec.results.folders import OURS
from sonarrec.results.run_file import LogOptions, RunFile, read_run, run_table, span_text
from sonarrec.runs.job import Job, RunOptions
from sonarrec.sonar.frame import Fan, Frame
from sonarrec.sonar.geometry import PoseTable, floor_depth
from sonarrec.sonar.stated import Sonar, load_sonar


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """An opened log, and what recognises landmarks in it."""

    job: Job
    log: Log
    log_options: LogOptions
    """As used: completed by an earlier run and the log's own files."""
    frames: Iterator[Frame]
    """Those asked for; the first one was read already."""
    first: list[Frame]
    """The first FIRST_FRAMES, as they come."""
    frame_count: int | None
    """How many; None if the log does not say."""
    fan: Fan
    landmarks: LandmarkSet
    poses: PoseTable | None
    recogniser: SideBySide
    basis: str
    """A line on what it goes by, see `help run`."""
    table: dict[str, Any]
    """The run.toml to write."""


@contextmanager
def prepare(job: Job) -> Iterator[PreparedRun]:
    """Open a job's log and prepare its run.

    Raises SonarrecError for input or settings that cannot be used.
    """
    given, options = job.log_options, job.run_options
    # Is the earlier run, if there is one, of this very log?
    earlier = read_run(options.earlier_run)
    source = find_log(job.path, given.up_to)
    # To compute it takes long, so only where there is one to compare with.
    digest = digest_of(source) if earlier.input.sha256 else None
    same_log = earlier.input.name == name_as_text(source.name)
    if digest is not None:
        same_log = earlier.input.is_of(*digest)
    # Options win over the earlier run, and that over the log's own files.
    log_options = earlier.complete(given, same_log=same_log)
    log_options = _with_companions(source, log_options, again=same_log)
    landmarks, from_where = chosen_landmarks(source, options.landmarks, earlier)
    model = _model(options, earlier, landmarks)
    poses = _poses(source, log_options, earlier if same_log else read_run(None))
    with open_log(source, **log_options.arguments()) as log:
        # The first frame has the geometry of all.
        span = log_options.frames or (0, None)
        frames = log.within(span)
        file, differs = _geometry_file(source, log_options, given, earlier, same_log)
        try:
            first = next(frames, None)  # raises if there is no usable frame at all
        except SonarrecError as error:
            if file is None or file == source.companion(SONAR_FILE):
                raise
            raise SonarrecError(f"{error}; {differs or f'its geometry is of {file}'}") from None
        if first is None:
            none = f"no frame lies in --frames {span_text(span)}{log.why_none()}"
            raise UsageError(f"{Path(job.path)}: {none}")
        configs, about_beams = with_beams(options.configs, log.beam_width_deg, first)
        recogniser = SideBySide(
            configs, first.fan, landmarks, None if model is None else model.weights, poses
        )
        log.diagnostics.note(
            *about_beams, *([] if poses is None else [*poses.doubts, *poses.too_fast()])
        )
        others = [differs]
        if file is None or file == source.companion(SONAR_FILE):
            others.append(misnamed(source.location, SONAR_FILE, file))
        if options.landmarks is None and "landmarks" not in earlier.table:
            own = source.companion(LANDMARKS_FILE)
            others.append(misnamed(source.location, LANDMARKS_FILE, own))
        log.diagnostics.note(*(text.removeprefix("; ") for text in others if text))
        _check_folder(job, source)
        table = run_table(
            configs,
            recogniser.methods,
            log.stated,
            first.fan,
            landmarks,
            (name_as_text(log.name), *(digest or log.digest_source())),
            log.reading(),
        )
        table["input"] |= _where(job)
        if log_options.frames is not None:
            table["input"]["frames"] = span_text(span)
        if poses is not None:
            table["odometry"] = dict(poses.source)
        if model is not None:
            table["model"] = model.as_table()
        geometry = _geometry(log, first.fan, file, given)
        yield PreparedRun(
            job=job,
            log=log,
            log_options=log_options,
            frames=chain([first], frames),
            first=[],
            frame_count=_frames_in(span, log.frame_count),
            fan=first.fan,
            landmarks=landmarks,
            poses=poses,
            recogniser=recogniser,
            basis=f"{geometry}; landmarks {landmarks.name} ({from_where})",
            table=table,
        )


def _frames_in(span: tuple[int, int | None], count: int | None) -> int | None:
    """How many of a log's frames lie in a span; None if it does not say how many it has."""
    if count is None:
        return None
    end = count if span[1] is None else min(span[1], count)
    return max(end - span[0], 0)


def _where(job: Job) -> dict[str, str]:
    """`path` and `place` of the log, for run.toml."""
    path = Path(job.path)
    if (url := job.shown(path)) != str(path):
        return {"path": url, "place": url}
    relative = os.path.relpath(path.resolve(), job.folder.resolve())
    return {"path": name_as_text(path), "place": name_as_text(relative)}


def _check_folder(job: Job, source: Source) -> None:
    """Raise UsageError if the results would replace the log or lie in it, SonarrecError if they
    cannot be written there."""
    folder = job.folder
    try:
        itself = source.location.resolve() in (folder.resolve(), Path(job.out).resolve())
    except OSError as error:  # the current folder is gone
        raise SonarrecError(f"{folder}: cannot be written ({error.strerror})") from None
    if itself:
        raise UsageError(f"{source.path}: this is the log itself; choose another --out")
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise SonarrecError(
            f"{folder}: a file or a link is where the folder of the results would be; rename "
            "it, or choose another --out"
        )
    if folder.is_dir() and not any((folder / name).exists() for name in OURS):
        logs = (f for f in folder.iterdir() if names_a_log(f.name) or names_an_image(f.name))
        if (log := next(logs, None)) is not None:
            raise UsageError(
                f"{folder}: holds {log.name}, so it may be a recording; choose another --out"
            )


def _with_companions(source: Source, log_options: LogOptions, again: bool) -> LogOptions:
    """The options with the poses that belong to the log.

    There is a note on them, since nobody named them. again: the run of a run.toml is repeated, so
    only its own poses may be used.
    """
    if again or log_options.odometry is not None or log_options.odometry_topic is not None:
        return log_options
    poses = source.companion(POSES_FILE)
    if poses is None:
        if near := misspelt(source.location, POSES_FILE):
            source.diagnostics.note(f"it has no poses{near}")
        return log_options
    source.diagnostics.note(f"its poses are those of {poses}")
    return replace(log_options, odometry=poses)


def _model(options: RunOptions, earlier: RunFile, landmarks: LandmarkSet) -> ModelFile | None:
    """The model of the file, else of the earlier run; None for the built-in one."""
    if options.model is not None:
        model = read_model(options.model)
        if all(c.features.measurement == "single" for c in options.configs):
            raise UsageError(
                f"--model {options.model}: only features.measurement = track uses a model, and "
                "this preset measures single frames by the published one"
            )
    elif earlier.model is not None:
        model = model_from_table(earlier.model, str(earlier.path))
    else:
        return None
    if isinstance(landmarks, DrawnSet):
        raise UsageError(f"--model: it is of discs, and {landmarks.name} has drawn plates")
    return model


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
    """The set that the user chose, else the earlier run's, else the log's own, else basin;
    and where it is from. Raises SonarrecError if it is invalid."""
    if choice is not None:
        return earlier.landmark_set(choice), f"option, {choice}"
    if "landmarks" in earlier.table:
        return earlier.landmark_set(), str(earlier.path)
    own = None if source is None else source.companion(LANDMARKS_FILE)
    return earlier.landmark_set(own), "built in" if own is None else str(own)


def _geometry_file(
    source: Source, used: LogOptions, given: LogOptions, earlier: RunFile, same_log: bool
) -> tuple[Path | None, str]:
    """The file that states the geometry, and in what another's differs from the log's own.

    used, given: the options with those of the earlier run, and of the command alone.
    """
    file = own = source.companion(SONAR_FILE)
    if given.sonar_file or earlier.sonar() != Sonar():
        file = given.sonar_file or earlier.path
    if own is None or file == own or (same_log and not given.sonar_file):
        return file, ""
    keys = list[str]()
    with suppress(SonarrecError):  # the log's own is not needed
        stated = load_sonar(own).updated(given.sonar).as_table()
        going_by = source.stated_sonar(used.sonar, used.sonar_file)[0].as_table()
        keys = [key for key, value in stated.items() if going_by.get(key) != value]
    how = f"{file} is used, which differs from the log's own {own} in {listed(keys, 3)}"
    return file, f"{how}; leave it out to use its own" if keys else ""


def _geometry(log: Log, fan: Fan, file: Path | None, given: LogOptions) -> str:
    """The geometry that a run goes by, in words. file: what states it. given: the options of the
    command alone."""
    topic = log.reading().get("topic")
    options = "options" if given.sonar != Sonar() else ""
    origins = [*filter(None, (topic and f"topic {topic}", options, file and str(file)))]
    tilt = " assumed" if log.sonar.tilt_deg is None else ""
    height = " assumed" if fan.height_m is None else " estimated"
    parts = (
        f"geometry {fan.range_min_m:.4g} to {fan.range_max_m:.4g} m",
        f"{fan.bearing_max_deg - fan.bearing_min_deg:.4g} deg wide",
        f"{log.sonar.order_of_ranges.removesuffix('_first')} range on top",
        f"tilt {fan.tilt_deg:.4g} deg{tilt}",
        f"height {floor_depth(fan):.3g} m{height if log.stated.height_m is None else ''}",
    )
    return f"{', '.join(parts)} ({', '.join(origins) or 'log'})"
