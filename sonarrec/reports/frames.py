"""Frames of the logs on the page: pictures with the estimates of a method, and those that a click
shows. Both are read in one pass over each log.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.drawing.pen import disc_outline
from sonarrec.drawing.results import AROUND, Mark, caption, draw_frame, outline_of
from sonarrec.errors import SonarrecError, UsageError, name_as_text
from sonarrec.readers import open_log
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log, log_name, names_a_log, results_name
from sonarrec.reports.logs import ReportedLog
from sonarrec.results.folders import possible_names
from sonarrec.results.read import check_same_log, read_estimates
from sonarrec.results.run_file import LogOptions
from sonarrec.sonar.frame import Estimate, Frame
from sonarrec.sonar.geometry import pixel_from_plane
from sonarrec.sonar.stated import Sonar

PICTURE_PX = 640  # pixels of the longer side; draw_frame lays its text out for this
PICTURE_QUALITY = 80
MOST_FRAMES = 200
MOST_BYTES = 3_000_000  # of the images of all frames together, as text
MOST_MARKED = 20  # estimates drawn per method and frame: declared ones first, then the best
LARGEST = 400  # pixels of the longer side
QUALITIES = (60, 40, 20)

Shown = dict[str, Any]
"""One log for the page's script. name; unit: of the times, "s" or none; methods; in_all: number of
its frames; frames: of each its number, time, image (a data URI), the fan's size, and outlines:
`said` by each method, and `truth`. An outline has ellipse (centre, half axes in fan pixels,
rotation in deg) or corners, label, colour (index of the ID) and declared."""


@dataclass(slots=True)
class Picture:
    """A frame drawn with the estimates of one method."""

    log: str
    """Its name."""
    method: str
    frame: int
    """Its number in the log."""
    group: str
    """One of "surest", "rarest" and "mistake"."""
    caption: str
    wrong: str = ""
    """Its mistake in words; then the truth is drawn too."""
    marked: int | None = None
    """Number of the object that it is about, whose outline is thick."""
    source: str = ""
    """Once drawn: a data URI. Also the next two are empty before."""
    size: tuple[int, int] = (0, 0)
    """(width, height)."""
    alt: str = ""
    """A description."""


# Which recording is which log's


def open_recording(path: Path, log: ReportedLog, sonar: Sonar, topic: str | None) -> Log:
    """The recording, read as the run read it."""
    source = find_log(path)
    log_options = log.results.run.complete(LogOptions(sonar, topic=topic), same_log=True)
    if not source.reader.has_topics:  # then the topic in run.toml is of another log
        log_options = replace(log_options, topic=topic, time=None)
    return open_log(source, **log_options.arguments())


def match_recordings(
    logs: Sequence[ReportedLog], paths: Sequence[Path], folders: Sequence[Path]
) -> tuple[dict[str, Path], list[str]]:
    """The recording of each log, by the log's name, and a line for each that was not found.

    paths: recordings, or folders with recordings; of one log alone the recording may have any name.
    Whether it is that log is checked when it is read. folders: of the results of all logs, also of
    those that are not shown. Raises UsageError for a path that is and holds no recording of these.
    """
    sources: dict[str, Path] = {}
    searched = []
    for path in paths:
        inside, own = _inside(path), _possible_names(path)
        matches = {log.name: inside[name] for log in logs for name in _names(log) if name in inside}
        if not matches:
            named = [log for log in logs if log.name in own]
            named = named or [log for log in logs if own & {*_names(log)}]
            matches = {log.name: path for log in named or ([] if inside or folders[1:] else logs)}
        if not matches and not {*own, *inside} & {name_as_text(f.resolve().name) for f in folders}:
            listed = ", ".join(log.name for log in logs)
            raise UsageError(f"--log {path}: neither one of these logs nor holds any: {listed}")
        searched += [str(path)] if inside else []
        sources = matches | sources
    unfound = [log.name for log in logs if searched and log.name not in sources]
    where = ", ".join(searched)
    lines = [
        f"--log {where}: no log of the name {n} in it; the page has no frames of it"
        for n in unfound
    ]
    return sources, lines


def _names(log: ReportedLog) -> list[str]:
    """Possible names of the log's recording, the surest last: as it was given to the run, then as
    its results, before which a run of several logs of one name puts those of their folders."""
    source = log.results.run.table.get("input", {})
    path = Path(str(source.get("path", log.folder.resolve().name)))
    names = path.name, str(source.get("name", log_name(path))), log.name, log.folder.resolve().name
    return [name for name in names if name]


def _possible_names(path: Path) -> set[str]:
    """Possible names of a recording in run.toml: its file, the target of a link, or its results."""
    names = possible_names(results_name(log_name(path)), path.resolve())
    return {name_as_text(path.name), name_as_text(path.resolve().name), *names}


def _inside(folder: Path) -> dict[str, Path]:
    """Folders and log files below a folder, by their possible names."""
    by_name: dict[str, Path] = {}
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(f for f in folders if not Path(root, f, "run.toml").exists())  # results
        for file in (*folders, *filter(names_a_log, sorted(files))):
            for name in _possible_names(path := Path(root, file)):
                by_name.setdefault(name, path)
    return by_name


# Which frames are shown, and what is drawn on them


def choose(
    logs: Sequence[ReportedLog], wanted: Iterable[tuple[str, int]], most: int = MOST_FRAMES
) -> dict[str, list[int]]:
    """The numbers of the frames to hold, per log.

    wanted: (log, frame), the most important first; each log gets at least one. The rest of `most`
    is filled with frames at equal steps through every log.
    """
    known = [pair for pair in wanted if pair[0] in {log.name for log in logs}]
    first = {log.name: int(log.results.frame[0]) for log in logs} | dict(reversed(known))
    chosen: dict[str, set[int]] = {log.name: set() for log in logs}
    for name, frame in list(dict.fromkeys([*first.items(), *known]))[:most]:
        chosen[name].add(frame)
    room = most - sum(map(len, chosen.values()))
    # Short logs first, so that longer ones get what they do not need.
    for n, log in enumerate(sorted(logs, key=lambda log: len(log.results.frame))):
        new = [f for f in log.results.frame.tolist() if f not in chosen[log.name]]
        share = min(room // (len(logs) - n), len(new))
        steps = np.linspace(0, len(new) - 1, share).round().astype(int)
        chosen[log.name].update(new[step] for step in steps.tolist())
        room -= share
    return {name: sorted(frames) for name, frames in chosen.items()}


def read_frames(
    log: Log,
    reported: ReportedLog,
    pictures: Sequence[Picture],
    held: Sequence[int],
    most_bytes: int,
) -> Shown:
    """Draw the pictures of a log, and return the frames to hold, in one pass over its recording.

    most_bytes: of each frame held. Raises SonarrecError if the results are of another log, or if
    it lacks a frame.
    """
    check_same_log(log, reported.folder, reported.results.run)
    methods, landmarks = list(reported.results.methods), reported.results.landmarks
    held = np.intersect1d(held, reported.results.frame).tolist()  # frames.csv may have been cut
    numbers = {picture.frame for picture in pictures} | set(held)
    of_method: dict[str, dict[int, tuple[Estimate, ...]]] = {}
    shown: Shown = {
        "name": reported.name,
        "unit": "s" if reported.clock == "s" else "",
        "methods": methods,
        "in_all": len(reported.results.frame),
        "frames": [],
    }
    for frame in log:
        if not of_method:  # the fan of the first frame gives the positions of the estimates
            table = reported.folder / "estimates.csv"
            for m in dict.fromkeys([*methods, *(picture.method for picture in pictures)]):
                every = read_estimates(table, m, landmarks, frame.fan)
                of_method[m] = {n: estimates for n, estimates in every if n in numbers}
        if frame.index in numbers:
            numbers.remove(frame.index)
            said = {m: by_frame.get(frame.index, ()) for m, by_frame in of_method.items()}
            truth = list(_truth_in(frame, reported))
            for picture in pictures:
                if picture.frame == frame.index:
                    _draw(picture, frame, reported, said[picture.method], truth)
            if frame.index in held:
                shown["frames"].append(
                    _held(frame, reported, [said[m] for m in methods], truth, most_bytes)
                )
        if not numbers:
            break
    if numbers:
        raise SonarrecError(
            f"{log.path}: no frame {min(numbers)}, which the results have; "
            "give the log that they came from"
        )
    return shown


def _truth_in(frame: Frame, log: ReportedLog) -> Iterator[Mark]:
    """The landmarks that are at least partly in view, if the truth has positions."""
    if log.matched is not None:
        truths = log.matched.truths
        rows = truths[log.results.frame[truths["at"]] == frame.index]
        pixels = pixel_from_plane(frame.fan, np.column_stack([rows["x"], rows["y"]])).tolist()
        for landmark, pixel in zip(rows["landmark"].tolist(), pixels, strict=True):
            if not np.isnan(pixel).any():
                yield Mark(landmark, *pixel)


def _draw(
    picture: Picture,
    frame: Frame,
    log: ReportedLog,
    said: Sequence[Estimate],
    truth: Sequence[Mark],
) -> None:
    """Draw a picture. said: the estimates of its method."""
    truth = truth if picture.wrong else ()
    view = frame.image, frame.fan, log.results.landmarks
    drawn = draw_frame(*view, said, truth=truth, score=True, marked=picture.marked)
    image = _reduced(drawn, PICTURE_PX)
    parts = [f"{e.method} declares ID.{e.landmark} ({e.score:.2f})" for e in said if e.declared]
    parts += [f"truth holds ID.{mark.landmark}" for mark in truth]
    picture.source, picture.size = as_jpeg(image, PICTURE_QUALITY), image.shape[1::-1]
    picture.alt = f"Sonar image, frame {frame.index}: {'; '.join(parts) or 'nothing declared'}"


def _held(
    frame: Frame,
    log: ReportedLog,
    said: Sequence[Sequence[Estimate]],
    truth: Sequence[Mark],
    most_bytes: int,
) -> Shown:
    """One of a log's frames for the page's script. said: the estimates of each method."""
    image, landmarks = _reduced(frame.image, LARGEST), log.results.landmarks

    def outlines(marked: Iterable[tuple[Estimate | Mark, str, bool]], size: float) -> list[Shown]:
        shapes = []
        for mark, label, declared in marked:
            colour = landmarks.ids.index(mark.landmark)
            outline: Shown = {"label": label, "colour": colour, "declared": declared}
            if isinstance(mark, Estimate) and mark.corners is not None:
                outline["corners"] = outline_of(mark, frame.fan, landmarks).round(1).tolist()
                shapes.append(outline)
                continue
            edge = disc_outline(frame.fan, size * landmarks.radius_m, mark.x_px, mark.y_px)
            if np.isfinite(edge).all():
                (x, y), (a, b), rotation = cv2.fitEllipse(edge.astype(np.float32))
                ellipse = [round(v, 1) for v in (x, y, a / 2, b / 2, rotation)]
                if np.isfinite(ellipse).all():
                    shapes.append(outline | {"ellipse": ellipse})
        return shapes

    by_method = []
    for estimates in said:
        most_sure = sorted(estimates, key=lambda e: (e.declared, e.score))[-MOST_MARKED:]
        labelled = ((e, caption(e, landmarks, score=True), e.declared) for e in most_sure)
        by_method.append(outlines(labelled, 1))
    return {
        "frame": frame.index,
        "at": round(float(log.time[np.searchsorted(log.results.frame, frame.index)]), 3),
        "image": _within(image, most_bytes),
        "size": (frame.fan.columns, frame.fan.rows),
        "said": by_method,
        "truth": outlines(((m, f"ID.{m.landmark}", False) for m in truth), AROUND),
    }


def as_jpeg(image: ByteImage, quality: int) -> str:
    """A data URI. WebP takes a third less for speckle, but fifty times as long."""
    coded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert coded
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _reduced(image: ByteImage, largest: int) -> ByteImage:
    """The image with a longer side of at most `largest` pixels."""
    share = min(1.0, largest / max(image.shape))
    if share == 1:
        return image
    size = (max(1, round(image.shape[1] * share)), max(1, round(image.shape[0] * share)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _within(image: ByteImage, most_bytes: int) -> str:
    """The image as text of at most so many bytes: of lower quality, then smaller."""
    while True:
        for quality in QUALITIES:
            source = as_jpeg(image, quality)
            if len(source) <= most_bytes or max(image.shape) <= 16:
                return source
        image = _reduced(image, max(image.shape) // 2)
