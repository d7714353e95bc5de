"""Encodes Foxglove's image messages as protobuf, and the descriptors that go with them."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

# protobuf: (field number, wire type) as a varint, then the value.


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _fixed32(field: int, value: int) -> bytes:
    return _varint(field << 3 | 5) + struct.pack("<I", value)


def _bytes(field: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | 2) + _varint(len(data)) + data


# Field types as descriptor.proto numbers them.
_INT64, _INT32, _FIXED32, _STRING, _MESSAGE, _BYTES = 3, 5, 7, 9, 11, 12
_Rows = tuple[tuple[str, int, int], ...]  # field name, number, type

_TIMESTAMP: _Rows = (("sec", 1, _INT64), ("nanosec", 2, _INT32))


MESSAGES: dict[str, _Rows] = {
    "foxglove.RawImage": (
        ("timestamp", 1, _MESSAGE),
        ("width", 2, _FIXED32),
        ("height", 3, _FIXED32),
        ("encoding", 4, _STRING),
        ("step", 5, _FIXED32),
        ("data", 6, _BYTES),
        ("frame_id", 7, _STRING),
    ),
    "foxglove.CompressedImage": (
        ("timestamp", 1, _MESSAGE),
        ("data", 2, _BYTES),
        ("format", 3, _STRING),
        ("frame_id", 4, _STRING),
    ),
}


def encode_protobuf(message: str, fields: Mapping[str, Any]) -> bytes:
    """A message of MESSAGES."""
    return _encoded(MESSAGES[message], fields)


def _encoded(rows: _Rows, fields: Mapping[str, Any]) -> bytes:
    out = bytearray()
    for name, number, kind in rows:
        value = fields[name]
        if kind == _MESSAGE:
            out += _bytes(number, _encoded(_TIMESTAMP, value))
        elif kind == _FIXED32:
            out += _fixed32(number, value)
        elif kind in (_STRING, _BYTES):
            out += _bytes(number, value)
        else:
            out += _number(number, value)
    return bytes(out)


def _descriptor_file(path: str, message: str, dependencies: tuple[str, ...], rows: _Rows) -> bytes:
    """One FileDescriptorProto of one message. rows: (field name, number, type); the only message
    type ever used is google.protobuf.Timestamp."""
    package, _, name = message.rpartition(".")
    fields = b"".join(
        _bytes(
            2,
            _bytes(1, field)
            + _number(3, number)
            + _number(4, 1)  # label: optional
            + _number(5, kind)
            + (_bytes(6, ".google.protobuf.Timestamp") if kind == _MESSAGE else b""),
        )
        for field, number, kind in rows
    )
    return (
        _bytes(1, path)
        + _bytes(2, package)
        + b"".join(_bytes(3, d) for d in dependencies)
        + _bytes(4, _bytes(1, name) + fields)
        + _bytes(12, "proto3")
    )


def descriptor_set(message: str) -> bytes:
    """The FileDescriptorSet of a message of MESSAGES, as MCAP asks of a protobuf schema; built
    without the protobuf package, for the layouts are fixed and small."""
    rows = MESSAGES[message]
    timestamp = "google/protobuf/timestamp.proto"
    clock = (("seconds", 1, _INT64), ("nanos", 2, _INT32))
    path = message.replace(".", "/") + ".proto"
    return _bytes(1, _descriptor_file(timestamp, "google.protobuf.Timestamp", (), clock)) + _bytes(
        1, _descriptor_file(path, message, (timestamp,), rows)
    )
