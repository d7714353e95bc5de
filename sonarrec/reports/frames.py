"""Frames of the logs on the page: pictures with the estimates of a method, and those that a click
shows. Both are read in one pass over each log.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.drawing.pen import disc_outline
from sonarrec.drawing.results import AROUND, Mark, caption, draw_frame
from sonarrec.errors import SonarrecError
from sonarrec.nouns import Estimate, Frame
from sonarrec.readers.log import Log
from sonarrec.reports.logs import ReportedLog
from sonarrec.results.read import check_same_log, read_estimates

PICTURE_PX = 640  # pixels of the longer side; draw_frame lays its text out for this
PICTURE_QUALITY = 80


@dataclass(frozen=True, slots=True)
class PictureRequest:
    """A frame to draw with the estimates of one method.

    log: name. frame: its number in the log. group: "surest", "rarest" or "mistake". wrong: its
    mistake in words; then the truth is drawn too.
    """

    log: str
    method: str
    frame: int
    group: str
    caption: str
    wrong: str = ""


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawn frame. source: a data URI. alt: a description."""

    request: PictureRequest
    source: str
    width: int
    height: int
    alt: str


def _draw(
    frame: Frame,
    reported: ReportedLog,
    requests: Sequence[PictureRequest],
    estimates: Mapping[str, Sequence[Estimate]],
    marks: Sequence[Mark],
) -> dict[PictureRequest, Picture]:
    """The frame drawn for each request. estimates: its estimates by method. marks: its truth."""
    pictures = {}
    for request in requests:
        said, truth = estimates[request.method], marks if request.wrong else ()
        landmarks = reported.results.landmarks
        image = draw_frame(frame.image, frame.fan, landmarks, said, truth=truth, score=True)
        image = _shrunk(image, PICTURE_PX)
        parts = [f"{e.method} declares ID.{e.landmark} ({e.score:.2f})" for e in said if e.declared]
        parts += [f"truth holds ID.{mark.landmark}" for mark in truth]
        alt = f"Sonar image, frame {frame.index}: {'; '.join(parts) or 'nothing declared'}"
        rows, columns = image.shape[:2]
        pictures[request] = Picture(request, as_webp(image, PICTURE_QUALITY), columns, rows, alt)
    return pictures


def as_webp(image: ByteImage, quality: int) -> str:
    """A data URI. WebP takes a third less than JPEG for speckle."""
    coded, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    assert coded
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode()


def _shrunk(image: ByteImage, largest: int) -> ByteImage:
    """The image with a longer side of at most `largest` pixels."""
    share = min(1.0, largest / max(image.shape))
    if share == 1:
        return image
    size = (max(1, round(image.shape[1] * share)), max(1, round(image.shape[0] * share)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _ellipse(outline: FloatArray) -> tuple[float, ...] | None:
    """Centre, half axes and rotation (deg) of an ellipse fitted to (n, 2) points; None if none."""
    if not np.isfinite(outline).all():
        return None
    (x, y), (a, b), rotation = cv2.fitEllipse(outline.astype(np.float32))
    found = tuple(round(v, 1) for v in (x, y, a / 2, b / 2, rotation))
    return found if np.isfinite(found).all() else None


MOST_FRAMES = 200
MOST_BYTES = 3_000_000  # of the images of all frames together, as text
MOST_MARKED = 20  # estimates drawn per method and frame: declared ones first, then the best
LARGEST = 400  # pixels of the longer side
QUALITIES = (60, 40, 20)


@dataclass(frozen=True, slots=True)
class Outline:
    """The outline of a disc on a frame. ellipse: centre, half axes (pixels), rotation (deg)."""

    ellipse: tuple[float, ...]
    label: str
    colour: int
    """Index of the ID."""
    declared: bool


@dataclass(frozen=True, slots=True)
class ShownFrame:
    """One frame. at: position on the log's time axis. image: a data URI of size (width, height).
    said: the outlines of each method of the log."""

    frame: int
    at: float
    image: str
    size: tuple[int, int]
    said: list[list[Outline]]
    truth: list[Outline]


@dataclass(frozen=True, slots=True)
class ShownLog:
    """The frames of one log. unit: of `at`, "s" or none. in_all: number of frames of the log."""

    name: str
    unit: str
    methods: list[str]
    in_all: int
    frames: list[ShownFrame] = field(default_factory=list)


def choose(
    logs: Sequence[ReportedLog], requests: Iterable[tuple[str, int]], most: int = MOST_FRAMES
) -> dict[str, list[int]]:
    """The numbers of the frames to hold, per log.

    requests: (log, frame), the most important first; each log gets at least one. The rest of `most`
    is filled with frames at equal steps through every log.
    """
    first = {log.results.name: int(log.results.frame[0]) for log in logs}
    chosen: dict[str, set[int]] = {name: set() for name in first}
    known_requests = [w for w in requests if w[0] in first]
    first |= reversed(known_requests)
    for name, frame in list(dict.fromkeys([*first.items(), *known_requests]))[:most]:
        chosen[name].add(frame)
    room = most - sum(map(len, chosen.values()))
    # Short logs first, so that longer ones get what they do not need.
    for n, log in enumerate(sorted(logs, key=lambda log: len(log.results.frame))):
        chosen_here, all_frames = chosen[log.results.name], log.results.frame
        share = room // (len(logs) - n)
        new = [f for f in all_frames.tolist() if f not in chosen_here]
        if len(new) > share:
            steps = np.linspace(0, len(new) - 1, max(share, 0)).round().astype(int)
            new = [new[step] for step in steps.tolist()]
        chosen_here.update(new)
        room -= len(new)
    return {name: sorted(frames) for name, frames in chosen.items()}


def take(
    log: Log,
    reported: ReportedLog,
    requests: Sequence[PictureRequest],
    frames_held: Sequence[int],
    most_bytes: int,
) -> tuple[dict[PictureRequest, Picture], ShownLog]:
    """The pictures wanted and the frames to hold, from one pass over the log.

    most_bytes: of each frame. Raises SonarrecError if the results are of another log, or if the log
    lacks a frame.
    """
    check_same_log(log, reported.folder, reported.run)
    pictures: dict[PictureRequest, Picture] = {}
    methods = list(reported.results.methods)
    unit, in_all = "s" if reported.clock == "s" else "", len(reported.results.frame)
    shown_log = ShownLog(reported.results.name, unit, methods, in_all)
    truth, landmarks = reported.truth, reported.results.landmarks
    numbers_of, hold = reported.results.frame, set(frames_held)
    numbers = {w.frame for w in requests} | hold
    of_method: dict[str, dict[int, tuple[Estimate, ...]]] = {}
    for frame in log:
        if not of_method:  # the fan of the first frame gives the positions of the estimates
            table = reported.folder / "estimates.csv"
            for m in dict.fromkeys([*methods, *(w.method for w in requests)]):
                every = read_estimates(table, m, landmarks, frame.fan)
                of_method[m] = {n: estimates for n, estimates in every if n in numbers}
        if frame.index in numbers:
            numbers.remove(frame.index)
            estimates = {m: by_frame.get(frame.index, ()) for m, by_frame in of_method.items()}
            marks: list[Mark] = []  # landmarks at least partly in view, if truth has positions
            positions = None if truth is None else truth.pixels(frame.fan)
            if truth is not None and positions is not None:
                here = np.flatnonzero(numbers_of[truth.frame_index] == frame.index)
                ids = [landmarks.ids[truth.landmark_index[n]] for n in here]
                marks = [Mark(i, *positions[n].tolist()) for i, n in zip(ids, here, strict=True)]
            requests_here = [w for w in requests if w.frame == frame.index]
            pictures |= _draw(frame, reported, requests_here, estimates, marks)
            if frame.index in hold:
                shown_log.frames.append(_shown_frame(frame, reported, estimates, marks, most_bytes))
        if not numbers:
            break
    if numbers:
        raise SonarrecError(
            f"{log.path}: no frame {min(numbers)}, which the results have; "
            "give the log that they came from"
        )
    return pictures, shown_log


def _shown_frame(
    frame: Frame,
    reported: ReportedLog,
    estimates: Mapping[str, Sequence[Estimate]],
    marks: Sequence[Mark],
    most_bytes: int,
) -> ShownFrame:
    log = reported.results
    image = _shrunk(frame.image, LARGEST)
    scale = image.shape[1] / frame.fan.columns
    row = int(np.searchsorted(log.frame, frame.index))

    def outlines(marked: Sequence[tuple[Estimate | Mark, str, bool]], size: float) -> list[Outline]:
        found_outlines = []
        for one, label, declared in marked:
            edge = disc_outline(frame.fan, size * log.landmarks.radius_m, one.x_px, one.y_px)
            around = _ellipse((edge + 0.5) * scale)
            if around is not None:
                colour = log.landmarks.ids.index(one.landmark)
                found_outlines.append(Outline(around, label, colour, declared))
        return found_outlines

    said = []
    for method in log.methods:
        most_sure = sorted(estimates[method], key=lambda e: (e.declared, e.score))[-MOST_MARKED:]
        labelled = [(e, caption(e, log.landmarks, score=True), e.declared) for e in most_sure]
        said.append(outlines(labelled, 1))
    return ShownFrame(
        frame=frame.index,
        at=round(float(reported.time[row]), 3),
        image=_within(image, most_bytes),
        size=(image.shape[1], image.shape[0]),
        said=said,
        truth=outlines([(m, f"ID.{m.landmark}", False) for m in marks], AROUND),
    )


def _within(image: ByteImage, most_bytes: int) -> str:
    """The image as text of at most so many bytes: of lower quality, then smaller."""
    while True:
        for quality in QUALITIES:
            source = as_webp(image, quality)
            if len(source) <= most_bytes or max(image.shape) <= 16:
                return source
        image = _shrunk(image, max(image.shape) // 2)
