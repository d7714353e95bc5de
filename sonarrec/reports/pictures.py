"""Pictures on the page: frames of the log with the estimates of a method."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.drawing.results import Mark, draw_frame
from sonarrec.nouns import Estimate, Frame
from sonarrec.reports.logs import ReportedLog

LARGEST = 640  # pixels of the longer side; draw_frame lays its text out for this
QUALITY = 80


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


def draw(
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
        image = shrunk(image, LARGEST)
        parts = [f"{e.method} declares ID.{e.landmark} ({e.score:.2f})" for e in said if e.declared]
        parts += [f"truth holds ID.{mark.landmark}" for mark in truth]
        alt = f"Sonar image, frame {frame.index}: {'; '.join(parts) or 'nothing declared'}"
        rows, columns = image.shape[:2]
        pictures[request] = Picture(request, as_webp(image, QUALITY), columns, rows, alt)
    return pictures


def as_webp(image: ByteImage, quality: int) -> str:
    """A data URI. WebP takes a third less than JPEG for speckle."""
    coded, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    assert coded
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode()


def shrunk(image: ByteImage, largest: int) -> ByteImage:
    """The image with a longer side of at most `largest` pixels."""
    share = min(1.0, largest / max(image.shape))
    if share == 1:
        return image
    size = (max(1, round(image.shape[1] * share)), max(1, round(image.shape[0] * share)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def ellipse(outline: FloatArray) -> tuple[float, ...] | None:
    """Centre, half axes and rotation (deg) of an ellipse fitted to (n, 2) points; None if none."""
    if not np.isfinite(outline).all():
        return None
    (x, y), (a, b), rotation = cv2.fitEllipse(outline.astype(np.float32))
    found = tuple(round(v, 1) for v in (x, y, a / 2, b / 2, rotation))
    return found if np.isfinite(found).all() else None
