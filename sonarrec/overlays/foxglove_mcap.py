"""Writes an MCAP file with annotations that Foxglove shows on top of the recording."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from sonarrec.arrays import FloatArray
from sonarrec.drawing.pen import TRUTH, UNNAMED, Colour, disc_outline, landmark_colours, pixel_unit
from sonarrec.drawing.results import AROUND, Mark, Moment, caption, outline_of, trails
from sonarrec.landmarks import LandmarkSet
from sonarrec.readers.messages.foxglove import message_class
from sonarrec.sonar.frame import Frame
from sonarrec.tables.outputs import OVERLAY_LIBRARY, replaced, writing

ANNOTATIONS_TOPIC = "/sonarrec/annotations"
FAN_TOPIC = "/sonarrec/fan"
LINE_LOOP, LINE_STRIP, LINE_LIST = 2, 3, 4

WriteFrame = Callable[[Frame, Sequence[Moment], Sequence[Mark]], None]
"""Appends a frame. Its history is that of one method and ends with the frame; then its truth."""


@contextmanager
def foxglove_file(path: Path, landmarks: LandmarkSet, with_images: bool) -> Iterator[WriteFrame]:
    """Annotations of every frame, and its fan image if `with_images`.

    After an exception there is none. Raises SonarrecError where it cannot be written.
    """
    with writing(path), replaced(path) as new, new.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(library=OVERLAY_LIBRARY)

        def channel(topic: str, message: str) -> int:
            schema = json.dumps(json_schema(message)).encode()
            number = writer.register_schema(message, "jsonschema", schema)
            return writer.register_channel(topic, "json", number)

        annotations = channel(ANNOTATIONS_TOPIC, "foxglove.ImageAnnotations")
        images = channel(FAN_TOPIC, "foxglove.CompressedImage") if with_images else None

        def write(frame: Frame, history: Sequence[Moment], truth: Sequence[Mark]) -> None:
            logged = frame.timestamp_ns if frame.stamps.log is None else frame.stamps.log
            # Foxglove pairs annotations with the image whose own stamp is the same to the ns.
            stamp = logged if frame.stamps.header is None else frame.stamps.header
            messages = {}
            if images is not None:
                png = cv2.imencode(".png", np.asarray(frame.image))[1].tobytes()
                image = {
                    "frame_id": "sonar",
                    "data": base64.b64encode(png).decode(),
                    "format": "png",
                }
                messages[images] = {"timestamp": _time(stamp), **image}
            messages[annotations] = _annotations(frame, stamp, landmarks, history, truth)
            for to, message in messages.items():
                writer.add_message(to, logged, json.dumps(message).encode(), logged)

        yield write
        writer.finish()  # type: ignore[no-untyped-call]


def _annotations(
    frame: Frame,
    stamp_ns: int,
    landmarks: LandmarkSet,
    history: Sequence[Moment],
    truth: Sequence[Mark],
) -> dict[str, Any]:
    """A foxglove.ImageAnnotations message, in pixels of the fan image.

    It is never empty: older versions of Foxglove take the time from the elements and would hold
    back the image of a frame without any.
    """
    fan, size = frame.fan, pixel_unit(max(frame.fan.rows, frame.fan.columns))
    colours, paths = landmark_colours(landmarks.ids), trails(history)
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
    for e in history[-1].estimates:
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


def _time(stamp_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return {"sec": seconds, "nsec": nanoseconds}


def _point(x: float, y: float) -> dict[str, float]:
    # Foxglove counts from the corner of the first pixel, this program from its centre.
    return {"x": round(x + 0.5, 2), "y": round(y + 0.5, 2)}


def _colour(colour: Colour, alpha: float = 1) -> dict[str, float]:
    return dict(zip("rgba", (*(round(c / 255, 3) for c in colour), alpha), strict=True))


def json_schema(name: str) -> dict[str, Any]:
    """The JSON schema of a message, as Foxglove publishes it, without the descriptions."""
    return {"title": name, **_object(message_class(name).DESCRIPTOR)}


_TIME = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
    "required": ["sec", "nsec"],
}


def _object(message: Any) -> dict[str, Any]:
    if message.full_name == "google.protobuf.Timestamp":
        return _TIME
    properties = {}
    for field in message.fields:
        single = _single(field)
        properties[field.name] = {"type": "array", "items": single} if field.is_repeated else single
    required = [name for name in properties if name not in ("timestamp", "metadata")]
    return {"type": "object", "properties": properties, "required": required}


def _single(field: Any) -> dict[str, Any]:
    if field.message_type is not None:
        return _object(field.message_type)
    if field.enum_type is not None:
        return {"oneOf": [{"const": value.number} for value in field.enum_type.values]}
    if field.type == field.TYPE_BYTES:
        return {"type": "string", "contentEncoding": "base64"}
    if field.type == field.TYPE_STRING:
        return {"type": "string"}
    return {"type": "number" if field.cpp_type == field.CPPTYPE_DOUBLE else "integer"}
