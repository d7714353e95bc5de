"""Writes images and polar pings as MCAP logs: the message types that the MCAP reader reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType

import numpy as np
from mcap.writer import CompressionType, Writer

from sonarrec.mcap_writer import fields
from sonarrec.mcap_writer.fields import MakeFields
from sonarrec.mcap_writer.protobuf import descriptor_set, encode_protobuf
from sonarrec.mcap_writer.ros import encode_cdr, encode_json, encode_ros1, json_schema
from sonarrec.readers.ros_definitions import definition_text, parse_definition
from sonarrec.records import SonarrecError, UsageError
from sonarrec.sonar import Geometry

_COMPRESSIONS = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}


@dataclass(frozen=True, slots=True)
class _Type:
    """A message type: its fields, and whether it holds polar pings."""

    fields: MakeFields
    polar: bool = False


# A further message type is one function and one row; its definition is in ros_definitions.
_ROS_TYPES = {
    "sensor_msgs/Image": _Type(fields.ros_image),
    "sensor_msgs/CompressedImage": _Type(fields.ros_compressed_image),
    "foxglove_msgs/RawImage": _Type(fields.foxglove_image),
    "foxglove_msgs/CompressedImage": _Type(fields.foxglove_compressed_image),
    "marine_acoustic_msgs/ProjectedSonarImage": _Type(fields.projected_sonar_image, polar=True),
    "marine_acoustic_msgs/RawSonarImage": _Type(fields.raw_sonar_image, polar=True),
    "sonar_oculus/OculusPing": _Type(fields.oculus_ping, polar=True),
    "oculus_interfaces/Ping": _Type(fields.oculus_interfaces_ping, polar=True),
}
_FOXGLOVE_TYPES = {
    "foxglove.RawImage": "foxglove_msgs/RawImage",
    "foxglove.CompressedImage": "foxglove_msgs/CompressedImage",
}
_ROS_ENCODINGS = ("", "+ros1", "+json")  # CDR without a suffix
SCHEMAS = (
    *(name.replace("/", "/msg/") + suffix for name in _ROS_TYPES for suffix in _ROS_ENCODINGS),
    *(name + suffix for name in _FOXGLOVE_TYPES for suffix in ("", "+json", "+flatbuffer")),
)
"""What can be written: a schema's name, with the messages' encoding where it is another than CDR
(ROS) or protobuf (Foxglove)."""


@dataclass(frozen=True, slots=True)
class _Family:
    """How one kind of message is written: its schema and the bytes of one image."""

    name: str
    schema_encoding: str
    schema_data: bytes
    message_encoding: str
    encode: Callable[[int, np.ndarray, Geometry | None], bytes]


def _ros_family(name: str, encoding: str) -> _Family:
    make = _ROS_TYPES[name].fields
    text = definition_text(name, ros1=encoding == "ros1")
    layout = parse_definition(text, name)
    if encoding == "ros1":
        encode = partial(_encoded, make, partial(encode_ros1, layout))
        return _Family(name, "ros1msg", text.encode(), "ros1", encode)
    if encoding == "json":
        dotted = name.replace("/", ".msg.")  # as the BlueOS recorder names them
        encode = partial(_encoded, make, encode_json)
        return _Family(dotted, "jsonschema", json_schema(layout, dotted), "json", encode)
    encode = partial(_encoded, make, partial(encode_cdr, layout))
    return _Family(name.replace("/", "/msg/"), "ros2msg", text.encode(), "cdr", encode)


def _foxglove_family(name: str, encoding: str) -> _Family:
    ros_name = _FOXGLOVE_TYPES[name]
    make = _ROS_TYPES[ros_name].fields
    if encoding == "json":  # where nanoseconds have another name
        layout = parse_definition(definition_text(ros_name).replace("nanosec", "nsec"), ros_name)
        encode = partial(_encoded, partial(fields.in_foxglove_json, make), encode_json)
        return _Family(name, "jsonschema", json_schema(layout, name), "json", encode)
    if encoding == "flatbuffer":
        from sonarrec.mcap_writer.flatbuffer import binary_schema, encode_flatbuffer

        encode = partial(_encoded, make, partial(encode_flatbuffer, name))
        return _Family(name, "flatbuffer", binary_schema(name), "flatbuffer", encode)
    encode = partial(_encoded, make, partial(encode_protobuf, name))
    return _Family(name, "protobuf", descriptor_set(name), "protobuf", encode)


def _encoded(
    make: MakeFields,
    encode: Callable[[dict[str, object]], bytes],
    timestamp_ns: int,
    image: np.ndarray,
    sonar: Geometry | None,
) -> bytes:
    return encode(make(timestamp_ns, image, sonar))


def is_polar(schema: str) -> bool:
    """Whether a schema of SCHEMAS holds polar pings, which tell their own geometry."""
    kind = _ROS_TYPES.get(schema.partition("+")[0].replace("/msg/", "/"))
    return kind is not None and kind.polar


def check_schema(schema: str, compression: str, polar: bool) -> None:
    """Raise SonarrecError for what McapImageWriter cannot write. polar: the images are."""
    if schema not in SCHEMAS:
        raise UsageError(f"no writer for schema {schema!r}; one of {', '.join(SCHEMAS)}")
    if compression not in _COMPRESSIONS:
        raise SonarrecError(
            f"no MCAP compression {compression!r}; one of {', '.join(_COMPRESSIONS)}"
        )
    if is_polar(schema) and not polar:
        raise UsageError(f"schema {schema!r} holds polar pings: it needs a polar scene")


class McapImageWriter:
    """Writes one channel of an MCAP file; use it as a context manager.

    Left by an exception, the file keeps what was written but gets no footer, so that readers
    see that it is cut.
    """

    def __init__(
        self,
        path: Path,
        topic: str = "/sonar/image",
        schema: str = "sensor_msgs/msg/Image",
        compression: str = "zstd",
        sonar: Geometry | None = None,
    ) -> None:
        """schema: one of SCHEMAS. compression: none, lz4 or zstd. sonar: the window and bearings
        of polar images, which the schemas of polar pings need.

        Raises SonarrecError for another schema or compression, for polar pings of images that are
        not polar, or where the file cannot be made.
        """
        check_schema(schema, compression, sonar is not None)
        name, _, encoding = schema.partition("+")
        make_family = _foxglove_family if name in _FOXGLOVE_TYPES else _ros_family
        self._family = family = make_family(name.replace("/msg/", "/"), encoding)
        self._sonar = sonar
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise SonarrecError(f"{path}: cannot be written ({error.strerror})") from None
        self._writer = Writer(self._file, compression=_COMPRESSIONS[compression])
        profile = {"cdr": "ros2", "ros1": "ros1"}.get(family.message_encoding, "")
        self._writer.start(profile=profile, library="sonarrec")
        schema_id = self._writer.register_schema(
            family.name, family.schema_encoding, family.schema_data
        )
        self._channel = self._writer.register_channel(topic, family.message_encoding, schema_id)
        self._sequence = 0

    def write(self, timestamp_ns: int, image: np.ndarray) -> None:
        """Append an image of (rows, columns), or (range bins, beams), uint8 or uint16.

        timestamp_ns becomes the log time, the publish time and the header's stamp.
        Raises ValueError for any other kind of array.
        """
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise ValueError(
                f"expected a 2-D uint8 or uint16 image, not {image.dtype} {image.shape}"
            )
        data = self._family.encode(timestamp_ns, image, self._sonar)
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
