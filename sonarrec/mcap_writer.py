"""Writes images as MCAP logs: the message families that the MCAP reader reads."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from sonarrec.records import SonarrecError

_COMPRESSIONS = {
    "": CompressionType.NONE,
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}

# Message definitions of ROS 2: dependencies follow below a line of 80 "=", as rosbag2 writes them.
_ROS2_HEADER = f"""\
{"=" * 80}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_ROS2_IMAGE = f"""\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
{_ROS2_HEADER}"""
_ROS2_COMPRESSED_IMAGE = f"""\
std_msgs/Header header
string format
uint8[] data
{_ROS2_HEADER}"""

FRAME_ID = "sonar"


def _encoding(image: np.ndarray) -> str:
    return "mono8" if image.dtype == np.uint8 else "mono16"


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


# ROS 2: CDR, little-endian; every number aligned to its own size, counted after the 4-byte header.


def _cdr_pad(buffer: bytearray, size: int) -> None:
    buffer.extend(bytes(-(len(buffer) - 4) % size))


def _cdr_uint32(buffer: bytearray, value: int) -> None:
    _cdr_pad(buffer, 4)
    buffer.extend(struct.pack("<I", value))


def _cdr_string(buffer: bytearray, text: str) -> None:
    data = text.encode() + b"\0"
    _cdr_uint32(buffer, len(data))
    buffer.extend(data)


def _cdr_header(timestamp_ns: int) -> bytearray:
    seconds, nanoseconds = divmod(timestamp_ns, 1_000_000_000)
    buffer = bytearray(b"\x00\x01\x00\x00" + struct.pack("<iI", seconds, nanoseconds))
    _cdr_string(buffer, FRAME_ID)
    return buffer


def _ros2_image(timestamp_ns: int, image: np.ndarray) -> bytes:
    buffer = _cdr_header(timestamp_ns)
    _cdr_uint32(buffer, image.shape[0])
    _cdr_uint32(buffer, image.shape[1])
    _cdr_string(buffer, _encoding(image))
    buffer.append(0)  # is_bigendian
    _cdr_uint32(buffer, image.shape[1] * image.itemsize)
    _cdr_uint32(buffer, image.nbytes)
    buffer.extend(image.tobytes())
    return bytes(buffer)


def _ros2_compressed_image(timestamp_ns: int, image: np.ndarray) -> bytes:
    buffer = _cdr_header(timestamp_ns)
    data = _png(image)
    _cdr_string(buffer, f"{_encoding(image)}; png compressed {_encoding(image)}")
    _cdr_uint32(buffer, len(data))
    buffer.extend(data)
    return bytes(buffer)


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


def _timestamp(timestamp_ns: int) -> bytes:
    seconds, nanoseconds = divmod(timestamp_ns, 1_000_000_000)
    return _bytes(1, _number(1, seconds) + _number(2, nanoseconds))


def _foxglove_image(timestamp_ns: int, image: np.ndarray) -> bytes:
    return (
        _timestamp(timestamp_ns)
        + _fixed32(2, image.shape[1])
        + _fixed32(3, image.shape[0])
        + _bytes(4, _encoding(image))
        + _fixed32(5, image.shape[1] * image.itemsize)
        + _bytes(6, image.tobytes())
        + _bytes(7, FRAME_ID)
    )


def _foxglove_compressed_image(timestamp_ns: int, image: np.ndarray) -> bytes:
    return (
        _timestamp(timestamp_ns) + _bytes(2, _png(image)) + _bytes(3, "png") + _bytes(4, FRAME_ID)
    )


# Field types as descriptor.proto numbers them.
_INT64, _INT32, _FIXED32, _STRING, _MESSAGE, _BYTES = 3, 5, 7, 9, 11, 12


def _descriptor_file(
    path: str, message: str, dependencies: tuple[str, ...], rows: tuple[tuple[str, int, int], ...]
) -> bytes:
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


def _descriptor_set(message: str, rows: tuple[tuple[str, int, int], ...]) -> bytes:
    """A FileDescriptorSet, as MCAP asks of a protobuf schema, built without the protobuf package:
    the layouts are fixed and this small."""
    timestamp = "google/protobuf/timestamp.proto"
    clock = (("seconds", 1, _INT64), ("nanos", 2, _INT32))
    path = message.replace(".", "/") + ".proto"
    return _bytes(1, _descriptor_file(timestamp, "google.protobuf.Timestamp", (), clock)) + _bytes(
        1, _descriptor_file(path, message, (timestamp,), rows)
    )


_IMAGE_FIELDS = (
    ("timestamp", 1, _MESSAGE),
    ("width", 2, _FIXED32),
    ("height", 3, _FIXED32),
    ("encoding", 4, _STRING),
    ("step", 5, _FIXED32),
    ("data", 6, _BYTES),
    ("frame_id", 7, _STRING),
)
_COMPRESSED_IMAGE_FIELDS = (
    ("timestamp", 1, _MESSAGE),
    ("data", 2, _BYTES),
    ("format", 3, _STRING),
    ("frame_id", 4, _STRING),
)


# JSON


def _json_time(timestamp_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(timestamp_ns, 1_000_000_000)
    return {"sec": seconds, "nsec": nanoseconds}


def _json_image(timestamp_ns: int, image: np.ndarray) -> bytes:
    return json.dumps(
        {
            "timestamp": _json_time(timestamp_ns),
            "frame_id": FRAME_ID,
            "width": image.shape[1],
            "height": image.shape[0],
            "encoding": _encoding(image),
            "step": image.shape[1] * image.itemsize,
            "data": base64.b64encode(image.tobytes()).decode(),
        }
    ).encode()


def _json_compressed_image(timestamp_ns: int, image: np.ndarray) -> bytes:
    return json.dumps(
        {
            "timestamp": _json_time(timestamp_ns),
            "frame_id": FRAME_ID,
            "data": base64.b64encode(_png(image)).decode(),
            "format": "png",
        }
    ).encode()


def _json_schema(title: str, rows: tuple[tuple[str, int, int], ...]) -> bytes:
    kinds: dict[int, dict[str, Any]] = {
        _FIXED32: {"type": "integer", "minimum": 0},
        _STRING: {"type": "string"},
        _BYTES: {"type": "string", "contentEncoding": "base64"},
        _MESSAGE: {
            "type": "object",
            "title": "time",
            "properties": {
                "sec": {"type": "integer", "minimum": 0},
                "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
            },
        },
    }
    properties = {name: kinds[kind] for name, _, kind in rows}
    return json.dumps({"title": title, "type": "object", "properties": properties}).encode()


@dataclass(frozen=True, slots=True)
class _Family:
    """How one kind of message is written: its schema and the bytes of one image."""

    name: str
    schema_encoding: str
    schema_data: bytes
    message_encoding: str
    encode: Callable[[int, np.ndarray], bytes]


_RAW, _COMPRESSED = "foxglove.RawImage", "foxglove.CompressedImage"
_FAMILIES = {
    "sensor_msgs/msg/Image": _Family(
        "sensor_msgs/msg/Image", "ros2msg", _ROS2_IMAGE.encode(), "cdr", _ros2_image
    ),
    "sensor_msgs/msg/CompressedImage": _Family(
        "sensor_msgs/msg/CompressedImage",
        "ros2msg",
        _ROS2_COMPRESSED_IMAGE.encode(),
        "cdr",
        _ros2_compressed_image,
    ),
    _RAW: _Family(
        _RAW, "protobuf", _descriptor_set(_RAW, _IMAGE_FIELDS), "protobuf", _foxglove_image
    ),
    _COMPRESSED: _Family(
        _COMPRESSED,
        "protobuf",
        _descriptor_set(_COMPRESSED, _COMPRESSED_IMAGE_FIELDS),
        "protobuf",
        _foxglove_compressed_image,
    ),
    f"{_RAW}+json": _Family(
        _RAW, "jsonschema", _json_schema(_RAW, _IMAGE_FIELDS), "json", _json_image
    ),
    f"{_COMPRESSED}+json": _Family(
        _COMPRESSED,
        "jsonschema",
        _json_schema(_COMPRESSED, _COMPRESSED_IMAGE_FIELDS),
        "json",
        _json_compressed_image,
    ),
}
SCHEMAS = tuple(_FAMILIES)


class McapImageWriter:
    """Writes one channel of images to an MCAP file; use it as a context manager.

    Left by an exception, the file keeps what was written but gets no footer, so that readers
    see that it is cut.
    """

    def __init__(
        self,
        path: Path,
        topic: str = "/sonar/image",
        schema: str = "sensor_msgs/msg/Image",
        compression: str = "zstd",
    ) -> None:
        """schema: one of SCHEMAS ("+json": JSON messages in place of protobuf).
        compression: "none", "lz4" or "zstd".

        Raises SonarrecError for another schema or compression, or where the file cannot be made.
        """
        if schema not in _FAMILIES:
            raise SonarrecError(f"no writer for schema {schema!r}; one of {', '.join(SCHEMAS)}")
        if compression not in _COMPRESSIONS:
            raise SonarrecError(f"no MCAP compression {compression!r}; one of none, lz4, zstd")
        self._family = family = _FAMILIES[schema]
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise SonarrecError(f"{path}: cannot be written ({error.strerror})") from None
        self._writer = Writer(self._file, compression=_COMPRESSIONS[compression])
        self._writer.start(
            profile="ros2" if family.message_encoding == "cdr" else "", library="sonarrec"
        )
        schema_id = self._writer.register_schema(
            family.name, family.schema_encoding, family.schema_data
        )
        self._channel = self._writer.register_channel(topic, family.message_encoding, schema_id)
        self._sequence = 0

    def write(self, timestamp_ns: int, image: np.ndarray) -> None:
        """Append an image of (rows, columns) uint8 (mono8) or uint16 (mono16).

        timestamp_ns becomes the log time, the publish time and the header's stamp.
        Raises ValueError for any other kind of array.
        """
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise ValueError(
                f"expected a 2-D uint8 or uint16 image, not {image.dtype} {image.shape}"
            )
        data = self._family.encode(timestamp_ns, image)
        self._writer.add_message(
            self._channel, timestamp_ns, data, publish_time=timestamp_ns, sequence=self._sequence
        )
        self._sequence += 1

    def __enter__(self) -> McapImageWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._writer.finish()  # type: ignore[no-untyped-call]
        else:
            self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.close()
