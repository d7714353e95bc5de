"""Foxglove's messages: decodes images from protobuf and flatbuffers.

Their schemas are in the package `foxglove-schemas-protobuf`, imported only when it is needed.
"""

from __future__ import annotations

import importlib
import struct
from typing import Any

from sonarrec.readers.raw import UnusableError

# Fields in the order of the flatbuffers tables. New versions only append fields.
FIELDS = {
    "foxglove/RawImage": (
        "timestamp", "frame_id", "width", "height", "encoding", "step", "data",
    ),
    "foxglove/CompressedImage": ("timestamp", "frame_id", "data", "format"),
}  # fmt: skip
_NUMBERS = ("width", "height", "step")


def decode_protobuf(name: str, message: memoryview) -> dict[str, Any]:
    """The fields of an image message (foxglove/Name). Raises UnusableError if it is malformed."""
    from google.protobuf.message import DecodeError

    try:
        parsed = message_class(name.replace("/", ".")).FromString(message)
    except DecodeError:
        raise UnusableError("malformed message (no protobuf of its schema)") from None
    clock = parsed.timestamp
    fields = {key: getattr(parsed, key) for key in FIELDS[name]}
    return fields | {"timestamp": {"sec": clock.seconds, "nanosec": clock.nanos}}


def decode_flatbuffer(name: str, message: memoryview) -> dict[str, Any]:
    """The fields of an image message (foxglove/Name). Raises UnusableError if it is malformed.
    Decoded here: forty lines in place of two packages."""
    try:
        root = _uint(message, 0)
        vtable = root - struct.unpack_from("<i", message, root)[0]
        if vtable < 0:
            raise UnusableError("malformed message (bad vtable)")
        slots = (struct.unpack_from("<H", message, vtable)[0] - 4) // 2
        fields: dict[str, Any] = {}
        for slot, key in enumerate(FIELDS[name]):
            # A table holds offsets to its fields. An offset of 0, or none, means the default.
            offset = (
                struct.unpack_from("<H", message, vtable + 4 + 2 * slot)[0] if slot < slots else 0
            )
            position = root + offset
            if key == "timestamp":
                sec, nanosec = struct.unpack_from("<II", message, position) if offset else (0, 0)
                fields[key] = {"sec": sec, "nanosec": nanosec}
            elif key in _NUMBERS:
                fields[key] = _uint(message, position) if offset else 0
            else:
                fields[key] = _vector(message, position) if offset else b""
    except struct.error:
        raise UnusableError("malformed message (it ends too early)") from None
    return fields


def _uint(message: memoryview, position: int) -> int:
    return int(struct.unpack_from("<I", message, position)[0])


def _vector(message: memoryview, position: int) -> memoryview:
    """The bytes of the string or vector that the offset at `position` points to."""
    start = position + _uint(message, position)
    data = message[start + 4 : start + 4 + _uint(message, start)]
    if len(data) != _uint(message, start):
        raise UnusableError("malformed message (it ends too early)")
    return data


DECODERS = {"protobuf": decode_protobuf, "flatbuffer": decode_flatbuffer}
"""By a channel's message encoding."""


def message_class(name: str) -> Any:
    """The protobuf class of a message such as foxglove.RawImage."""
    short = name.removeprefix("foxglove.")
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)
