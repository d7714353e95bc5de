"""Decodes the image messages of Foxglove: protobuf and JSON."""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np

from sonarrec.readers.raw import UnusableError, decode_image, raw_pixels


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


def _number(fields: dict[int, int | memoryview], number: int) -> int:
    value = fields.get(number, 0)  # proto3 leaves zeros out
    if not isinstance(value, int):
        raise UnusableError(f"malformed message (field {number} is no number)")
    return value


def _octets(fields: dict[int, int | memoryview], number: int) -> memoryview:
    value = fields.get(number, memoryview(b""))
    if isinstance(value, int):
        raise UnusableError(f"malformed message (field {number} holds no bytes)")
    return value


def protobuf_raw_image(message: memoryview) -> np.ndarray:
    """Pixels of a protobuf foxglove.RawImage. Raises UnusableError where it is malformed."""
    fields = protobuf_fields(message)
    encoding = bytes(_octets(fields, 4)).decode(errors="replace")
    width, height, step = (_number(fields, n) for n in (2, 3, 5))
    return raw_pixels(_octets(fields, 6), height, width, encoding, step, big_endian=False)


def protobuf_compressed_image(message: memoryview) -> np.ndarray:
    """Pixels of a protobuf foxglove.CompressedImage. Raises UnusableError where malformed."""
    return decode_image(_octets(protobuf_fields(message), 2))


def _json_object(message: memoryview) -> tuple[dict[str, Any], bytes]:
    """A JSON message and its decoded data."""
    try:
        table = json.loads(bytes(message))
        return table, base64.b64decode(table["data"], validate=True)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise UnusableError("malformed message (no JSON object with base64 data)") from None


def json_raw_image(message: memoryview) -> np.ndarray:
    """Pixels of a JSON foxglove.RawImage. Raises UnusableError where it is malformed."""
    table, data = _json_object(message)
    values = [table.get(key, 0) for key in ("height", "width", "step")]
    encoding = table.get("encoding")
    if not all(type(v) is int and v >= 0 for v in values) or not isinstance(encoding, str):
        raise UnusableError("malformed message (height, width, step or encoding)")
    height, width, step = values
    return raw_pixels(data, height, width, encoding, step, big_endian=False)


def json_compressed_image(message: memoryview) -> np.ndarray:
    """Pixels of a JSON foxglove.CompressedImage. Raises UnusableError where it is malformed."""
    return decode_image(_json_object(message)[1])
