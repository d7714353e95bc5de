"""Takes Foxglove's image messages apart: protobuf and flatbuffers."""

from __future__ import annotations

import struct
from typing import Any

from sonarrec.readers.raw import UnusableError

# Their fields, in the order of the flatbuffers tables, with the protobuf field numbers. Both stay
# as they are in every version: that is how these formats grow.
FIELDS = {
    "foxglove/RawImage": {
        "timestamp": 1, "frame_id": 7, "width": 2, "height": 3, "encoding": 4, "step": 5, "data": 6,
    },
    "foxglove/CompressedImage": {"timestamp": 1, "frame_id": 4, "data": 2, "format": 3},
}  # fmt: skip
_TEXTS = ("frame_id", "encoding", "format")
_NUMBERS = ("width", "height", "step")


def decode_protobuf(name: str, message: memoryview) -> dict[str, Any]:
    """The fields of a protobuf message of FIELDS. Raises UnusableError where it is malformed."""
    numbered = protobuf_fields(message)
    fields: dict[str, Any] = {}
    for key, number in FIELDS[name].items():
        value = numbered.get(number)
        if value is None:  # proto3 leaves zeros and empty fields out
            value = 0 if key in _NUMBERS else memoryview(b"")
        if isinstance(value, int) != (key in _NUMBERS):
            raise UnusableError(f"malformed message (field {number} is not its {key})")
        fields[key] = value
    clock = protobuf_fields(fields["timestamp"])
    fields["timestamp"] = {"sec": clock.get(1, 0), "nanosec": clock.get(2, 0)}
    return _with_texts(fields)


def _with_texts(fields: dict[str, Any]) -> dict[str, Any]:
    texts = {k: bytes(fields[k]).decode(errors="replace") for k in _TEXTS if k in fields}
    return fields | texts


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """(value, position after it) of a protobuf varint."""
    value = 0
    for n, byte in enumerate(message[at : at + 10]):
        value |= (byte & 0x7F) << 7 * n
        if byte < 0x80:
            return value, at + n + 1
    raise UnusableError("malformed message (bad varint)")


def protobuf_fields(message: memoryview) -> dict[int, int | memoryview]:
    """The fields of one protobuf message by number; of repeated ones the last.

    Length-delimited fields are views of the message, everything else whole numbers.
    Raises UnusableError where the bytes are no protobuf message.
    """
    fields: dict[int, int | memoryview] = {}
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        wire_type = key & 7
        if wire_type == 0:
            fields[key >> 3], at = _varint(message, at)
            continue
        if wire_type == 2:
            size, at = _varint(message, at)
        elif wire_type in (1, 5):
            size = 8 if wire_type == 1 else 4
        else:
            raise UnusableError("malformed message (bad wire type)")
        value = message[at : at + size]
        if len(value) != size:
            raise UnusableError("malformed message (it ends too early)")
        at += size
        fields[key >> 3] = (
            value if wire_type == 2 else struct.unpack("<Q" if size == 8 else "<I", value)[0]
        )
    return fields


def decode_flatbuffer(name: str, message: memoryview) -> dict[str, Any]:
    """The fields of a flatbuffers message of FIELDS. Raises UnusableError where it is malformed."""
    try:
        root = _uint(message, 0)
        vtable = root - struct.unpack_from("<i", message, root)[0]
        if vtable < 0:
            raise UnusableError("malformed message (bad vtable)")
        slots = (struct.unpack_from("<H", message, vtable)[0] - 4) // 2
        fields: dict[str, Any] = {}
        for slot, key in enumerate(FIELDS[name]):
            # A table holds offsets to its fields; 0, or none so far, leaves the default.
            offset = (
                struct.unpack_from("<H", message, vtable + 4 + 2 * slot)[0] if slot < slots else 0
            )
            at = root + offset
            if key == "timestamp":
                sec, nanosec = struct.unpack_from("<II", message, at) if offset else (0, 0)
                fields[key] = {"sec": sec, "nanosec": nanosec}
            elif key in _NUMBERS:
                fields[key] = _uint(message, at) if offset else 0
            else:
                fields[key] = _vector(message, at) if offset else memoryview(b"")
    except struct.error:
        raise UnusableError("malformed message (it ends too early)") from None
    return _with_texts(fields)


def _uint(message: memoryview, at: int) -> int:
    return int(struct.unpack_from("<I", message, at)[0])


def _vector(message: memoryview, at: int) -> memoryview:
    """The bytes of the string or vector to which the offset at `at` points."""
    start = at + _uint(message, at)
    data = message[start + 4 : start + 4 + _uint(message, start)]
    if len(data) != _uint(message, start):
        raise UnusableError("malformed message (it ends too early)")
    return data
