"""Writes images and polar pings into an MCAP, in the message types that the reader knows."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.readers.messages import foxglove
from sonarrec.readers.messages.ros import known_messages
from sonarrec.sonar import Geometry
from sonarrec.tables.outputs import writing
from sonarrec.tables.toml import brief
from tests.support import mcap_fields as fields
from tests.support.mcap_fields import MakeFields

_COMPRESSIONS = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}


# To add a message type, write one function that makes its fields and add one row here, and its
# definition to readers/messages/sonars.msg.
_IMAGE_TYPES: dict[str, MakeFields] = {
    "sensor_msgs/Image": fields.ros_image,
    "sensor_msgs/CompressedImage": fields.ros_compressed_image,
    "foxglove_msgs/RawImage": fields.foxglove_image,
    "foxglove_msgs/CompressedImage": fields.foxglove_compressed_image,
}
_PING_TYPES: dict[str, MakeFields] = {
    "marine_acoustic_msgs/ProjectedSonarImage": fields.projected_sonar_image,
    "marine_acoustic_msgs/RawSonarImage": fields.raw_sonar_image,
    "sonar_oculus/OculusPing": fields.oculus_ping,
    "oculus_interfaces/Ping": fields.oculus_interfaces_ping,
}
_ROS_TYPES = _IMAGE_TYPES | _PING_TYPES
_FOXGLOVE_TYPES = {
    "foxglove.RawImage": fields.foxglove_image,
    "foxglove.CompressedImage": fields.foxglove_compressed_image,
}
SCHEMAS = (
    *(n.replace("/", "/msg/") + suffix for n in _ROS_TYPES for suffix in ("", "+ros1", "+json")),
    *(name + suffix for name in _FOXGLOVE_TYPES for suffix in ("", "+json")),
)
"""What can be written: the name of a schema, with the encoding of the messages if it is not CDR
(ROS) or protobuf (Foxglove)."""


@dataclass(frozen=True, slots=True)
class _Family:
    """How messages of one type and encoding are written: the schema in the MCAP, and functions that
    make the fields of a message, and its bytes."""

    name: str
    schema_encoding: str
    schema_data: bytes
    message_encoding: str
    fields: MakeFields
    encode: Callable[[dict[str, Any]], bytes | memoryview]


def _ros_family(name: str, encoding: str) -> _Family:
    ros1, make, full = encoding == "ros1", _ROS_TYPES[name], name.replace("/", "/msg/")
    store = known_messages(ros1)
    text = store.generate_msgdef(full, ros_version=1 if ros1 else 2)[0].encode()
    if ros1:
        return _Family(
            name, "ros1msg", text, "ros1", make,
            lambda values: store.serialize_ros1(_ros_message(store, full, values), full),
        )  # fmt: skip
    if encoding == "json":
        dotted = full.replace("/", ".")  # as the BlueOS recorder names them
        schema = {"title": dotted, **_ros_json_schema(store, full)}
        return _Family(dotted, "jsonschema", json.dumps(schema).encode(), "json", make, _json)
    return _Family(
        full, "ros2msg", text, "cdr", make,
        lambda values: store.serialize_cdr(
            _ros_message(store, full, values), full, little_endian=True
        ),
    )  # fmt: skip


def _ros_message(store: Typestore, name: str, values: Mapping[str, Any]) -> Any:
    """A message object of rosbags, which needs sequences of numbers as arrays."""
    made = []
    for field, (node, detail) in store.fielddefs[name][1]:
        value = values[field]
        if node == Nodetype.NAME:
            value = _ros_message(store, str(detail), value)
        elif node == Nodetype.SEQUENCE:
            (inner, kind), _ = cast(Any, detail)
            if inner == Nodetype.NAME:
                value = [_ros_message(store, kind, item) for item in value]
            elif isinstance(value, bytes):
                value = np.frombuffer(value, np.uint8)
            else:
                value = np.asarray(value, kind[0])
        made.append(value)
    return store.types[name](*made)


_OCTETS = {"type": "string", "contentEncoding": "base64"}
_JSON_TYPES = {"bool": "boolean", "string": "string", "float32": "number", "float64": "number"}


def _ros_json_schema(store: Typestore, name: str) -> dict[str, Any]:
    properties: dict[str, Any] = {}
    for field, (node, detail) in store.fielddefs[name][1]:
        inner, kind = (
            cast(Any, detail)[0] if node == Nodetype.SEQUENCE else (node, cast(Any, detail))
        )
        if inner == Nodetype.NAME:
            schema = _ros_json_schema(store, kind)
        else:
            schema = {"type": _JSON_TYPES.get(kind[0], "integer")}
        if node == Nodetype.SEQUENCE:
            octets = kind == ("uint8", 0)
            schema = _OCTETS if octets else {"type": "array", "items": schema}
        properties[field] = schema
    return {"type": "object", "properties": properties}


def _json(values: dict[str, Any]) -> bytes:
    """Encode a message as JSON, with bytes as base64."""
    return json.dumps(values, default=lambda data: base64.b64encode(data).decode()).encode()


def _foxglove_family(name: str, encoding: str) -> _Family:
    make = _FOXGLOVE_TYPES[name]
    if encoding == "json":
        schema = json.dumps(foxglove.json_schema(name)).encode()
        named = partial(fields.with_clock, make, "sec", "nsec")
        return _Family(name, "jsonschema", schema, "json", named, _json)
    message = foxglove.message_class(name)
    named = partial(fields.with_clock, make, "seconds", "nanos")
    return _Family(
        name, "protobuf", descriptor_set(name), "protobuf", named,
        lambda values: bytes(message(**values).SerializeToString()),
    )  # fmt: skip


def is_polar(schema: str) -> bool:
    """Whether a schema of SCHEMAS holds polar pings, which state their own geometry."""
    return schema.partition("+")[0].replace("/msg/", "/") in _PING_TYPES


def check_schema(schema: str, compression: str, polar: bool) -> None:
    """Raise SonarrecError if McapImageWriter cannot write this. polar: whether the images are."""
    if schema not in SCHEMAS:
        near = get_close_matches(schema, SCHEMAS, 1)
        raise UsageError(
            f"no writer for schema {brief(schema)}; "
            + (f"did you mean {near[0]}?" if near else "`sonarrec help formats` lists them")
        )
    if compression not in _COMPRESSIONS:
        raise SonarrecError(
            f"no MCAP compression {compression!r}; one of {', '.join(_COMPRESSIONS)}"
        )
    if is_polar(schema) and not polar:
        raise UsageError(f"schema {schema!r} holds polar pings: it needs a polar scene")


class McapImageWriter:
    """Writes images into one channel of an MCAP file. Use it as a context manager.

    After an exception the file keeps what was written but gets no footer, so that readers see that
    it is cut short.
    """

    def __init__(
        self,
        path: Path,
        topic: str = "/sonar/image",
        schema: str = "sensor_msgs/msg/Image",
        compression: str = "zstd",
        sonar: Geometry | None = None,
    ) -> None:
        """schema: one of SCHEMAS. compression: none, lz4 or zstd. sonar: the geometry, if the
        images are polar; schemas of polar pings need it.

        Raises SonarrecError for another schema or compression, if a schema of polar pings lacks
        `sonar`, or if the file cannot be created.
        """
        check_schema(schema, compression, sonar is not None)
        name, _, encoding = schema.partition("+")
        make_family = _foxglove_family if name in _FOXGLOVE_TYPES else _ros_family
        self._family = family = make_family(name.replace("/msg/", "/"), encoding)
        self._sonar = sonar
        with writing(path):
            self._file = path.open("wb")
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
        family = self._family
        data = bytes(family.encode(family.fields(timestamp_ns, image, self._sonar)))
        self._writer.add_message(
            self._channel, timestamp_ns, data, publish_time=timestamp_ns, sequence=self._sequence
        )
        self._sequence += 1

    def __enter__(self) -> McapImageWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._writer.finish()  # type: ignore[no-untyped-call]
        else:
            self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.close()


def descriptor_set(name: str) -> bytes:
    """The serialised FileDescriptorSet of a message: its schema in an MCAP."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files: dict[str, Any] = {}

    def add(file: Any) -> None:
        for dependency in file.dependencies:
            add(dependency)
        files[file.name] = file

    add(foxglove.message_class(name).DESCRIPTOR.file)
    schema = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(schema.file.add())
    return bytes(schema.SerializeToString())
