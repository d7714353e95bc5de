"""Draws the results of one log onto its frames: `sonarrec overlay`."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from sonarrec.drawing.pen import draw_picture
from sonarrec.drawing.results import STRIP_FRAMES, Mark, Moment, draw_frame, draw_strip, trails
from sonarrec.errors import Diagnostics, MissingError, SonarrecError, UsageError, number_of
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan, Frame
from sonarrec.overlays.foxglove_mcap import FAN_TOPIC, LAYOUT_BEGIN, FoxgloveFile, write_layout
from sonarrec.overlays.video import ImageFolder, VideoFile
from sonarrec.readers import open_log
from sonarrec.readers.log import Log
from sonarrec.readers.open import Source, find_log
from sonarrec.results.folders import estimates_of, part_of, possible_names
from sonarrec.results.read import read_frames, read_log
from sonarrec.results.run_file import LogOptions, read_run
from sonarrec.results.same_log import check_same_log, last_frame
from sonarrec.results.stream import choose_method, read_estimates
from sonarrec.sonar import Sonar
from sonarrec.tables.outputs import Kind, check_output, writing
from sonarrec.truth.fits import misfit, without_rows
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import read_truth


@dataclass(frozen=True, slots=True)
class Targets:
    """The files to write: an MCAP file for Foxglove and ROS 2, an MP4, a folder of PNGs, a Foxglove
    layout for the MCAP file. Those that are None are not written."""

    mcap: Path | None = None
    video: Path | None = None
    images: Path | None = None
    layout: Path | None = None


@dataclass(frozen=True, slots=True, repr=False)
class OverlayReport:
    """The method shown, the number of frames written, and what is to be told."""

    method: str
    frames: int
    diagnostics: Diagnostics

    def __repr__(self) -> str:
        return f"<{number_of(self.frames, 'frame')} of {self.method} drawn>"


def write_overlay(
    path: str | Path,
    targets: Targets,
    *,
    results: Path = Path("sonarrec_out"),
    method: str | None = None,
    span: tuple[int, int | None] | None = None,
    ground_truth: Path | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
    sonar_file: Path | None = None,
    topic: str | None = None,
    grid: bool = False,
    observe: Callable[[int | None], None] | None = None,
) -> OverlayReport:
    """Draw the results of one log onto its frames, in one pass.

    results: the folder of this log's results, or one that holds it. method: None: the framework.
    span: (first frame, one past the last; None: to the end); None: the frames of the run.
    landmarks, sonar, sonar_file, topic: replace what run.toml says. grid: whether to draw range
    rings and bearings. observe: called after every frame with the number of frames, or None if
    unknown.
    Raises SonarrecError if something cannot be used or the results are of another log, UsageError
    for an invalid option.
    """
    path = Path(path)
    _check_targets(targets, path, ground_truth)
    source = find_log(path)
    folder = _results_folder(path, source, results)
    run = read_run(folder / "run.toml")
    landmark_set = run.landmark_set(landmarks)
    log_options = run.complete(
        LogOptions(sonar or Sonar(), sonar_file, topic),
        same_log=source.reader.has_topics,  # else a topic in run.toml is another log's
    )
    span = span or run.span() or (0, None)
    table = estimates_of(folder)
    method = choose_method(table, method)
    with open_log(source, **log_options.arguments()) as log:
        check_same_log(log, folder, run)
        told = Diagnostics()
        if not run.finished:
            last = last_frame(folder)
            told.problem(f"{folder}: the run was cut short; frames after {last} have no results")
        frames = iter(log)
        first = next(frames)  # raises where there is no usable frame
        truth: dict[int, list[Mark]] = {}
        if ground_truth is not None:
            truth = _truth_marks(ground_truth, folder, landmarks, log.sonar, first.fan, told)
        rows = read_estimates(table, method, landmark_set, first.fan)
        history: deque[Moment] = deque(maxlen=STRIP_FRAMES)
        outputs: _Outputs | None = None
        written = 0
        with ExitStack() as stack:
            index, of_index = -1, tuple[Estimate, ...]()
            for frame in chain([first], frames):
                if span[1] is not None and frame.index >= span[1]:
                    break
                while index < frame.index:  # both come in rising order
                    index, of_index = next(rows, (sys.maxsize, ()))
                estimates = of_index if index == frame.index else ()
                # Frames before the span only show in the first strips.
                history.append(Moment(frame.index, frame.timestamp_ns, estimates))
                if observe:
                    observe(log.frame_count)
                if frame.index < span[0]:
                    continue
                if outputs is None:  # an older overlay stays if there is nothing to write
                    outputs = _open_outputs(targets, stack, log, first, landmark_set, folder, told)
                outputs.write(frame, history, truth.get(frame.index, []), grid=grid)
                written += 1
            told.problem(*log.diagnostics.problems)
    if outputs is None:
        raise UsageError(
            f"{path}: no frame lies in --frames {span[0]}:{span[1] or ''}{log.why_none()}"
        )
    if topic and run.input.topic not in (None, topic):
        told.note(f"{folder}: results of topic {run.input.topic}, drawn onto {topic}")
    return OverlayReport(method, written, told)


def _check_targets(targets: Targets, path: Path, ground_truth: Path | None) -> None:
    """Raises UsageError if a target would replace a file of other origin, or another target."""
    outputs: dict[Kind, Path | None] = {
        "overlay": targets.mcap,
        "video": targets.video,
        "picture": targets.images,
        "JSON": targets.layout,
    }
    paths = [target.resolve() for target in outputs.values() if target is not None]
    for place in paths:
        if paths.count(place) > 1 and (place.is_file() or not place.exists()):
            raise UsageError(f"{place.name}: each output needs a name of its own")
    for kind, target in outputs.items():
        # A folder of pictures is checked picture by picture.
        if target is not None and not (kind == "picture" and target.is_dir()):
            check_output(target, kind, [path, ground_truth], header=LAYOUT_BEGIN)
        elif target is not None:
            check_output(target / "000000.png", kind, [path])


@dataclass(frozen=True, slots=True)
class _Outputs:
    """The open outputs."""

    annotations: FoxgloveFile | None
    pictures: list[VideoFile | ImageFolder]
    landmarks: LandmarkSet

    def write(
        self, frame: Frame, history: Sequence[Moment], marks: Sequence[Mark], *, grid: bool
    ) -> None:
        """Write the frame's annotations, and its picture above the strip of the frames before.

        history: up to this frame. marks: its truth. grid: as of `write_overlay`.
        """
        estimates, paths = history[-1].estimates, trails(history)
        if self.annotations is not None:
            self.annotations.write(frame, estimates, paths, marks)
        if not self.pictures:
            return
        picture = draw_frame(
            frame.image, frame.fan, self.landmarks, estimates, paths=paths, truth=marks, grid=grid
        )
        strip = draw_strip(history, self.landmarks, max(picture.shape[1], 512))
        picture = draw_picture(picture, strip)
        for target in self.pictures:
            target.write(frame.index, picture)


def _open_outputs(
    targets: Targets,
    stack: ExitStack,
    log: Log,
    first: Frame,
    landmarks: LandmarkSet,
    results: Path,
    told: Diagnostics,
) -> _Outputs:
    """Open the outputs; they are closed with the stack."""
    annotations = None
    pictures: list[VideoFile | ImageFolder] = []
    for target in (targets.mcap, targets.video):
        if target is not None:
            with writing(target):
                target.parent.mkdir(parents=True, exist_ok=True)
    if targets.mcap is not None:
        # If Foxglove cannot show the recording as this fan, the overlay brings the fan images.
        unseen = first.stamps.log is None or log.sonar.layout == "polar" or bool(log.sonar.flip)
        annotations = FoxgloveFile(targets.mcap, landmarks, told, with_images=unseen)
        stack.enter_context(annotations)
        if targets.layout is not None:
            topic = None if unseen else log.reading().get("topic")
            write_layout(targets.layout, topic or FAN_TOPIC)
    if targets.video is not None:
        times = read_frames(results).get("timestamp_ns", ())
        between = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        rate_hz = 1e9 / between if between > 0 else log.sonar.frame_rate_hz or 10.0
        pictures.append(stack.enter_context(VideoFile(targets.video, rate_hz)))
    if targets.images is not None:
        pictures.append(ImageFolder(targets.images))
    return _Outputs(annotations, pictures, landmarks)


def _results_folder(path: Path, source: Source, results: Path) -> Path:
    """The folder of the log's results, else of what a stopped run left.

    source: the log at `path`. Raises SonarrecError if there is none.
    """
    # A run of several logs of one name put the names of their folders in front.
    names = possible_names(source.name, source.place.resolve())
    for place in (results, *(results / name for name in names)):
        for folder in (place, part_of(place)):
            if (folder / "frames.csv").is_file():
                return folder
    kind = SonarrecError if results.is_dir() else MissingError
    raise kind(
        f"{results}: no results of {path} here (no frames.csv, nor {source.name}/frames.csv); "
        f"`sonarrec run {path}` writes them"
    )


def _truth_marks(
    path: Path, folder: Path, landmarks: str | None, sonar: Sonar, fan: Fan, told: Diagnostics
) -> dict[int, list[Mark]]:
    """The landmarks in view by frame; none, which is told, if the truth cannot be that of the log.

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
        unlike = misfit(table, log, truth)
    else:
        unlike = without_rows(path, len(table.at), [log.name], "it shows no landmark")
    if unlike is not None:
        told.problem(f"{unlike}; no truth is drawn")
        return {}
    marks: dict[int, list[Mark]] = {}
    frames = log.frame[truth.frame_index].tolist()
    for frame, k, (x, y) in zip(frames, truth.landmark_index, positions.tolist(), strict=True):
        marks.setdefault(frame, []).append(Mark(log.landmarks.ids[k], x, y))
    return marks
