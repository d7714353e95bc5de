"""Writes an MCAP file with annotations that Foxglove shows on top of the recording."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from sonarrec.arrays import FloatArray
from sonarrec.drawing.pen import TRUTH, UNNAMED, Colour, disc_outline, landmark_colours, pixel_unit
from sonarrec.drawing.results import AROUND, Mark, caption, outline_of
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Frame
from sonarrec.readers.messages.foxglove import json_schema
from sonarrec.tables.outputs import OVERLAY_LIBRARY, writing

ANNOTATIONS_TOPIC = "/sonarrec/annotations"
FAN_TOPIC = "/sonarrec/fan"
LINE_LOOP, LINE_STRIP, LINE_LIST = 2, 3, 4


class FoxgloveFile:
    """Annotations of every frame, and its fan image if `with_images`.

    Use it as a context manager. After an exception the file keeps what was written but gets no
    footer.
    """

    def __init__(self, path: Path, landmarks: LandmarkSet, *, with_images: bool) -> None:
        """Raises SonarrecError where the file cannot be made."""
        self._path, self._landmarks = path, landmarks
        with writing(path):
            self._file = path.open("wb")
            self._writer = Writer(self._file, compression=CompressionType.ZSTD)
            self._writer.start(library=OVERLAY_LIBRARY)
        self._annotations = self._channel(ANNOTATIONS_TOPIC, "foxglove.ImageAnnotations")
        self._images = self._channel(FAN_TOPIC, "foxglove.CompressedImage") if with_images else None

    def write(
        self,
        frame: Frame,
        estimates: Sequence[Estimate],
        paths: Mapping[int, FloatArray],
        truth: Sequence[Mark],
    ) -> None:
        """Append one frame. Raises SonarrecError where the disk takes no more."""
        logged = frame.timestamp_ns if frame.stamps.log is None else frame.stamps.log
        # Foxglove pairs annotations with the image whose own stamp is the same to the nanosecond.
        stamp = logged if frame.stamps.header is None else frame.stamps.header
        if self._images is not None:
            png = cv2.imencode(".png", np.asarray(frame.image))[1].tobytes()
            image = {
                "timestamp": _time(stamp),
                "frame_id": "sonar",
                "data": base64.b64encode(png).decode(),
                "format": "png",
            }
            self._add(self._images, _json(image), logged)
        message = annotations_message(frame, stamp, self._landmarks, estimates, paths, truth)
        self._add(self._annotations, _json(message), logged)

    def _channel(self, topic: str, message: str) -> int:
        data = json.dumps(json_schema(message)).encode()
        number = self._writer.register_schema(message, "jsonschema", data)
        return self._writer.register_channel(topic, "json", number)

    def _add(self, channel: int, message: bytes, log_time: int) -> None:
        with writing(self._path):
            self._writer.add_message(channel, log_time, message, log_time)

    def __enter__(self) -> FoxgloveFile:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Close the file. Raises SonarrecError where the disk takes no more."""
        try:
            with self._file:
                if kind is None:
                    self._writer.finish()  # type: ignore[no-untyped-call]
                else:
                    self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError as fault:
            if kind is None:  # else the first fault is reported
                raise SonarrecError(f"{self._path}: cannot be written ({fault.strerror})") from None


def annotations_message(
    frame: Frame,
    stamp_ns: int,
    landmarks: LandmarkSet,
    estimates: Sequence[Estimate],
    paths: Mapping[int, FloatArray],
    truth: Sequence[Mark] = (),
) -> dict[str, Any]:
    """A foxglove.ImageAnnotations message, in pixels of the fan image.

    It is never empty: older versions of Foxglove take the time from the elements and would hold
    back the image of a frame without any.
    """
    fan, size = frame.fan, pixel_unit(max(frame.fan.rows, frame.fan.columns))
    colours = landmark_colours(landmarks.ids)
    stamp, lines, texts = {"timestamp": _time(stamp_ns)}, [], []

    def line(kind: int, points: FloatArray, colour: Colour, width: float) -> None:
        drawn = {
            "type": kind,
            "points": [_point(x, y) for x, y in points.tolist()],
            "outline_color": _colour(colour),
            "outline_colors": [],
            "fill_color": _colour(colour, 0),
            "thickness": width * size,
        }
        lines.append(stamp | drawn)

    def text(words: str, left: float, bottom: float, colour: Colour) -> None:
        written = {
            "position": _point(left, bottom),
            "text": words,
            "font_size": 14 * size,
            "text_color": _colour(colour),
            "background_color": _colour((0, 0, 0), 0.75),
        }
        texts.append(stamp | written)

    text(f"frame {frame.index}", 4 * size, 18 * size, UNNAMED)
    for e in estimates:
        colour = colours[e.landmark] if e.declared else UNNAMED
        outline = outline_of(e, fan, landmarks)
        line(LINE_LOOP, outline, colour, 2 if e.declared else 1)
        if e.object in paths:
            line(LINE_STRIP, paths[e.object], colour, 1)
        if words := caption(e, landmarks):
            left, top = outline.min(axis=0)
            text(words, left, top - 4 * size, colour)
    for mark in truth:
        outline = disc_outline(fan, AROUND * landmarks.radius_m, mark.x_px, mark.y_px)
        line(LINE_LIST, outline, TRUTH, 1)
        left, bottom = outline[:, 0].min(), outline[:, 1].max()
        text(f"ID.{mark.landmark}", left, bottom + 18 * size, TRUTH)
    return {**stamp, "circles": [], "points": lines, "texts": texts, "metadata": []}


def _json(message: Mapping[str, Any]) -> bytes:
    return json.dumps(message).encode()


def _time(stamp_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return {"sec": seconds, "nsec": nanoseconds}


def _point(x: float, y: float) -> dict[str, float]:
    # Foxglove counts from the corner of the first pixel, this program from its centre.
    return {"x": round(x + 0.5, 2), "y": round(y + 0.5, 2)}


def _colour(colour: Colour, alpha: float = 1) -> dict[str, float]:
    return dict(zip("rgba", (*(round(c / 255, 3) for c in colour), alpha), strict=True))
