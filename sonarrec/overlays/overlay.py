"""Draws the results of one log onto its frames: `sonarrec overlay`."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.drawing.pen import draw_picture, write_png
from sonarrec.drawing.results import STRIP_FRAMES, Mark, Moment, draw_frame, draw_strip, trails
from sonarrec.errors import (
    Diagnostics,
    MissingError,
    SonarrecError,
    UsageError,
    command_line,
    number_of,
    refuse_url,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.overlays.foxglove_mcap import WriteFrame, foxglove_file
from sonarrec.readers import open_log
from sonarrec.readers.containers.video import opencv_name
from sonarrec.readers.decode.pixels import warnings_file, warnings_to
from sonarrec.readers.log import Log
from sonarrec.readers.open import Source, find_log
from sonarrec.results.folders import part_of, possible_names, rerun_left
from sonarrec.results.read import (
    check_same_log,
    choose_method,
    find_logs,
    read_estimates,
    read_frames,
    read_log,
)
from sonarrec.results.run_file import (
    LogOptions,
    frame_span,
    read_run,
    span_text,
    tables_changed,
)
from sonarrec.runs.recorded import outdated, recorded_at
from sonarrec.sonar.frame import Estimate, Fan, Frame
from sonarrec.sonar.stated import Sonar, sonar_from
from sonarrec.tables.outputs import (
    VIDEO_MARK,
    Kind,
    check_distinct,
    check_folder,
    check_output,
    replaced,
    writing,
)
from sonarrec.truth.check import misfit, without_rows
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import read_truth

Span = tuple[int, int | None]
"""The first frame and one past the last, None for the log's end."""
KINDS: dict[str, Kind] = {".mcap": "overlay", ".mp4": "video"}
"""By how the output's name ends; else it is a folder of pictures."""


@dataclass(frozen=True, slots=True, repr=False)
class OverlayReport:
    """The method shown, the number of frames written, and the notes and problems."""

    method: str
    frames: int
    diagnostics: Diagnostics

    def __repr__(self) -> str:
        return f"<{number_of(self.frames, 'frame')} of {self.method} drawn>"


def overlay(
    log: str | Path,
    out: str | Path,
    *,
    results: str | Path | None = None,
    method: str | None = None,
    frames: Span | Sequence[Span] | None = None,
    ground_truth: str | Path | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    sonar_file: str | Path | None = None,
    topic: str | None = None,
    observe: Callable[[int | None], None] | None = None,
) -> OverlayReport:
    """Draw the results of one log onto its frames, in one pass over the log.

    Parameters
    ----------
    log : str or Path
        The log; or the results of one, whose run.toml says where the log is.
    out : str or Path
        What to write: NAME.mcap for annotations that Foxglove shows, NAME.mp4 for a video, else a
        folder for PNGs.
    results : str or Path, optional
        The folder of this log's results, or one that holds it. Default: sonarrec_out.
    method : str, optional
        Whose estimates are drawn. Default: the framework.
    frames : tuple of int, or sequence of these, optional
        (first, end) of the frames to draw, without `end`, which may be None: to the last. Default:
        those of the run.
    ground_truth : str or Path, optional
        A gt.csv, whose landmarks are drawn too.
    landmarks : str, optional
        A landmark set, in place of that of run.toml.
    sonar : Sonar or mapping, optional
        Geometry that takes precedence over run.toml, with the keys and units of sonar.toml.
    sonar_file : str or Path, optional
        A sonar.toml, in place of that of run.toml.
    topic : str, optional
        The image channel of an MCAP or bag, in place of that of run.toml.
    observe : callable, optional
        Called after every frame with the number of frames, None if that is not known.

    Returns
    -------
    OverlayReport
        The method drawn, the number of frames written, notes and problems.

    Raises
    ------
    SonarrecError
        Something cannot be used, or the results are of another log.
    UsageError
        An option is invalid.
    """
    source, folder = find_both(Path(log), None if results is None else Path(results))
    path, out = source.path, Path(refuse_url(out))
    truth_file = None if ground_truth is None else Path(refuse_url(ground_truth))
    kind = KINDS.get(out.suffix.lower(), "picture")
    if kind == "picture":
        check_distinct(out)
        check_output(out / "000000.png", kind, [path])
        check_folder(out, [])
    else:
        check_output(out, kind, [path, truth_file])
    run = read_run(folder / "run.toml")
    landmark_set = run.landmark_set(landmarks)
    log_options = run.complete(
        LogOptions(sonar_from(sonar), Path(sonar_file) if sonar_file else None, topic),
        same_log=source.reader.has_topics,  # else a topic in run.toml is another log's
    )
    spans = _spans(frames) or [run.span() or (0, None)]
    method, diagnostics = choose_method(folder / "estimates.csv", method), Diagnostics()
    with open_log(source, **log_options.arguments()) as recording, ExitStack() as stack:
        check_same_log(recording, folder, run)
        if not run.finished:
            last = read_frames(folder)["frame"].max(initial=-1)
            diagnostics.problem(
                f"{folder}: the run was cut short; frames after {last} have no results"
            )
        diagnostics.note(*outdated([folder]), *rerun_left(folder))
        diagnostics.problem(*(f"{folder}: {line}" for line in tables_changed(folder, run.input)))
        rest = iter(recording)
        first = next(rest)  # raises where there is no usable frame
        truth: dict[int, list[Mark]] = {}
        if truth_file is not None:
            truth = _truth_marks(
                truth_file, folder, landmarks, recording.sonar, first.fan, diagnostics
            )
        rows = read_estimates(folder / "estimates.csv", method, landmark_set, first.fan)
        history: deque[Moment] = deque(maxlen=STRIP_FRAMES)
        write: WriteFrame | None = None
        index, of_index, written = -1, tuple[Estimate, ...](), 0
        empty = {*spans}
        for frame in chain([first], rest):
            if all(end is not None and frame.index >= end for _, end in spans):
                break
            while index < frame.index:  # both come in rising order
                index, of_index = next(rows, (sys.maxsize, ()))
            estimates = of_index if index == frame.index else ()
            # Frames before the span only show in the first strips.
            history.append(Moment(frame.index, frame.timestamp_ns, estimates, frame.stretch))
            if observe:
                observe(recording.frame_count)
            if hits := {
                (a, b) for a, b in spans if a <= frame.index and (not b or frame.index < b)
            }:
                empty -= hits
                if write is None:  # an older overlay stays if there is nothing to write
                    write = stack.enter_context(
                        _opened(out, kind, recording, first, landmark_set, folder)
                    )
                write(frame, history, truth.get(frame.index, ()))
                written += 1
        diagnostics.problem(*recording.diagnostics.problems)
    if empty:
        without = ",".join(span_text(span) for span in spans if span in empty)
        line = f"{path}: no frame lies in --frames {without}{recording.why_none()}"
        if write is None:
            raise UsageError(line)
        diagnostics.problem(line)
    if topic and run.input.topic not in (None, topic):
        diagnostics.note(f"{folder}: results of topic {run.input.topic}, drawn onto {topic}")
    return OverlayReport(method, written, diagnostics)


def _opened(
    out: Path, kind: Kind, log: Log, first: Frame, landmarks: LandmarkSet, results: Path
) -> AbstractContextManager[WriteFrame]:
    """The output. first: a frame of the log. results: their folder."""
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    if kind == "overlay":
        # If Foxglove cannot show the recording as this fan, the overlay brings the fan images.
        unseen = first.stamps.log is None or log.sonar.layout == "polar" or bool(log.sonar.flip)
        return foxglove_file(out, landmarks, unseen)
    if kind == "picture":
        return _image_folder(out, landmarks)
    times = read_frames(results).get("timestamp_ns", ())
    between = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return _video_file(
        out, landmarks, 1e9 / between if between > 0 else log.sonar.frame_rate_hz or 10.0
    )


def _spans(frames: Span | Sequence[Span] | None) -> list[Span]:
    """By their texts, as of --frames: what that could not state is refused."""
    several = [] if frames is None else [frames] if isinstance(frames[0], int) else [*frames]
    return [frame_span(span_text(span)) for span in several]  # type: ignore[arg-type]


def results_in(path: Path) -> list[Path]:
    """The folders of the results in a folder, each of one log; none if the path is a log."""
    if (path / "frames.csv").is_file():
        return [path]
    for find in (find_log, find_logs):
        with suppress(SonarrecError):
            source = find(path)
            return source if isinstance(source, list) else []
    return []


def find_both(path: Path, results: Path | None = None) -> tuple[Source, Path]:
    """A log and the folder of its results, else of what a stopped run left.

    path: of either. results: the folder, or one that holds it. Raises MissingError if one of them
    is not found, UsageError for results of both.
    """
    if (path / "frames.csv").is_file():
        if results is not None:
            try:
                find_log(results)
            except SonarrecError:
                raise UsageError(
                    f"{path} and {results}: both hold results; leave one out"
                ) from None
            raise UsageError(f"{path} holds results, {results} is a log: name the log first")
        try:
            return recorded_at(path, read_run(path / "run.toml").input), path
        except SonarrecError as error:
            raise MissingError(
                f"{path}: its log is not found ({error}); give both: sonarrec overlay LOG {path}"
            ) from None
    source, results = find_log(path), results or Path("sonarrec_out")
    # A run of several logs of one name put the names of their folders in front.
    names = possible_names(source.name, source.location.resolve())
    for base in (results, *(results / name for name in names)):
        for folder in (base, part_of(base)):
            if (folder / "frames.csv").is_file():
                return source, folder
    raise MissingError(
        f"{results}: no results of {path} here (no frames.csv, nor {source.name}/frames.csv); "
        f"{command_line('run', path, '-o', results)} writes them"
    )


def _truth_marks(
    path: Path,
    folder: Path,
    landmarks: str | None,
    sonar: Sonar,
    fan: Fan,
    diagnostics: Diagnostics,
) -> dict[int, list[Mark]]:
    """The landmarks in view by frame; none, and a problem, if the truth is not of the log.

    Raises SonarrecError if gt.csv has no positions.
    """
    pixels = Sonar(metres_per_pixel=fan.metres_per_pixel, apex_px=(fan.apex_column, fan.apex_row))
    log = read_log(folder, landmarks, sonar.updated(pixels))
    table = read_truth(path)
    truth = match_truth(table, log)
    positions = truth.pixels(fan)
    if positions is None:
        raise SonarrecError(f"{path}: no positions (x_px,y_px or range_m,bearing_deg) to draw")
    if truth.rows:
        why = misfit(table, log, truth)
    else:
        why = without_rows(path, len(table.keys), [log.name], "it shows no landmark")
    if why is not None:
        diagnostics.problem(f"{why}; no truth is drawn")
        return {}
    marks: dict[int, list[Mark]] = {}
    frames = log.frame[truth.frame_index].tolist()
    for frame, k, (x, y) in zip(frames, truth.landmark_index, positions.tolist(), strict=True):
        marks.setdefault(frame, []).append(Mark(log.landmarks.ids[k], x, y))
    return marks


@contextmanager
def _video_file(path: Path, landmarks: LandmarkSet, frame_rate_hz: float) -> Iterator[WriteFrame]:
    """Frames as an MP4: MPEG-4 Part 2 is the most widely played that every OpenCV writes.

    Raises SonarrecError if the name is not UTF-8, or where it did not become a whole video.
    """
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # MPEG-4 divides a second into 65,535 parts at the most; players want one frame a second.
    rate = round(min(max(frame_rate_hz, 1.0), 60.0), 3)
    video, frames, said = cv2.VideoWriter(), 0, warnings_file()  # faults are reported below
    with writing(path), replaced(path) as new:
        name = opencv_name(new)

        def write(frame: Frame, history: Sequence[Moment], truth: Sequence[Mark]) -> None:
            nonlocal frames
            picture = _picture(frame, landmarks, history, truth)
            size = (picture.shape[1], picture.shape[0])
            with warnings_to(said):
                if not (frames or video.open(name, cv2.VideoWriter.fourcc(*"mp4v"), rate, size)):
                    raise SonarrecError(f"{path}: cannot be written")
                video.write(picture)
            frames += 1

        try:
            yield write
        finally:
            with warnings_to(said):
                video.release()
        # OpenCV does not report a failed write.
        if cv2.VideoCapture(name).get(cv2.CAP_PROP_FRAME_COUNT) != frames:
            raise SonarrecError(
                f"{path}: {number_of(frames, 'frame')} did not become a whole video (is the disk "
                "full?)"
            )
        with new.open("ab") as file:
            file.write(VIDEO_MARK)


@contextmanager
def _image_folder(folder: Path, landmarks: LandmarkSet) -> Iterator[WriteFrame]:
    """Frames as DIR/NNNNNN.png, NNNNNN the frame's number.

    Raises SonarrecError where one cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)

    def write(frame: Frame, history: Sequence[Moment], truth: Sequence[Mark]) -> None:
        path = folder / f"{frame.index:06d}.png"
        write_png(path, _picture(frame, landmarks, history, truth))

    yield write


def _picture(
    frame: Frame, landmarks: LandmarkSet, history: Sequence[Moment], truth: Sequence[Mark]
) -> ByteImage:
    """(rows, columns, 3) uint8 BGR: the frame with what is drawn on it, above its strip."""
    drawn = draw_frame(
        *(frame.image, frame.fan, landmarks, history[-1].estimates),
        paths=trails(history),
        truth=truth,
    )
    return draw_picture(drawn, draw_strip(history, landmarks, max(drawn.shape[1], 512)))
