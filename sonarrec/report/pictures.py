"""Frames of the log with what a method says drawn on them, as pictures that the page contains."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.drawing import Mark, draw_frame
from sonarrec.readers.log import Log
from sonarrec.records import Estimate, Fan, Frame, SonarrecError
from sonarrec.report.logs import ReportedLog
from sonarrec.results.run_file import check_same
from sonarrec.results.stream import read_estimates

LARGEST = 640  # pixels of the longer side; draw_frame lays its text out for this
QUALITY = 80


@dataclass(frozen=True, slots=True)
class Wanted:
    """A frame to be shown with what one method says of it.

    log: name. frame: its number in the log. is_mistake: shown for what is wrong in it, with the
    truth marked; else for what was seen.
    """

    log: str
    method: str
    frame: int
    caption: str
    is_mistake: bool


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawn frame. source: a data URI. alt: what it shows, in words."""

    wanted: Wanted
    source: str
    width: int
    height: int
    alt: str


def draw(log: Log, reported: ReportedLog, wanted: Sequence[Wanted]) -> dict[Wanted, Picture]:
    """The wanted frames, drawn in one pass over the log that ends with the last of them.

    Raises SonarrecError where this is not the log that the results came from, or where it does
    not hold a wanted frame.
    """
    check_same(log, reported.folder, reported.run)
    numbers = {w.frame for w in wanted}
    pictures: dict[Wanted, Picture] = {}
    said: dict[str, dict[int, tuple[Estimate, ...]]] = {}
    for frame in log:
        if not said:  # the first frame brings the fan, which places the estimates
            said = {
                m: _estimates(reported, m, numbers, frame.fan) for m in {w.method for w in wanted}
            }
        if frame.index in numbers:
            numbers.remove(frame.index)
            marks = _marks(reported, frame)
            for w in wanted:
                if w.frame == frame.index:
                    estimates = said[w.method].get(w.frame, ())
                    truth = marks if w.is_mistake else []
                    pictures[w] = _picture(frame, reported, estimates, truth, w)
        if not numbers:
            break
    if numbers:
        raise SonarrecError(
            f"{log.path}: no frame {min(numbers)}, which the results have; "
            "give the log that they came from"
        )
    return pictures


def _estimates(
    reported: ReportedLog, method: str, numbers: set[int], fan: Fan
) -> dict[int, tuple[Estimate, ...]]:
    path = reported.folder / "estimates.csv"
    every = read_estimates(path, method, reported.results.landmarks, fan)
    return {number: estimates for number, estimates in every if number in numbers}


def _marks(reported: ReportedLog, frame: Frame) -> list[Mark]:
    """The landmarks of which anything shows in the frame, where truth says where."""
    truth, found = reported.truth, reported.results
    place = None if truth is None else truth.pixels(frame.fan)
    if truth is None or place is None:
        return []
    here = np.flatnonzero(found.frame[truth.frame_index] == frame.index)
    ids = found.landmarks.ids
    return [Mark(ids[truth.landmark_index[n]], *place[n].tolist()) for n in here]


def _picture(
    frame: Frame,
    reported: ReportedLog,
    estimates: Sequence[Estimate],
    marks: Sequence[Mark],
    wanted: Wanted,
) -> Picture:
    landmarks = reported.results.landmarks
    image = draw_frame(frame.image, frame.fan, landmarks, estimates, truth=marks)
    shrink = min(1.0, LARGEST / max(image.shape))
    if shrink < 1:
        size = (round(image.shape[1] * shrink), round(image.shape[0] * shrink))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    told = [f"{e.method} declares ID.{e.landmark} ({e.score:.2f})" for e in estimates if e.declared]
    told += [f"truth holds ID.{mark.landmark}" for mark in marks]
    coded, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    assert coded
    return Picture(
        wanted=wanted,
        source="data:image/webp;base64," + base64.b64encode(data.tobytes()).decode(),
        width=image.shape[1],
        height=image.shape[0],
        alt=f"Sonar image, frame {frame.index}: {'; '.join(told) or 'nothing declared'}",
    )
