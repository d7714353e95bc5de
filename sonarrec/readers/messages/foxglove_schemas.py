"""Foxglove's schemas, for reading its images and for writing its messages.

They are in the package `foxglove-schemas-protobuf`, which is imported only when it is needed.
"""

from __future__ import annotations

import importlib
from typing import Any


def message_class(name: str) -> Any:
    """The protobuf class of a message such as foxglove.RawImage."""
    short = name.removeprefix("foxglove.")
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)


def descriptor_set(name: str) -> bytes:
    """The serialised FileDescriptorSet of a message: its schema in an MCAP."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files: dict[str, Any] = {}

    def add(file: Any) -> None:
        for dependency in file.dependencies:
            add(dependency)
        files[file.name] = file

    add(message_class(name).DESCRIPTOR.file)
    schema = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(schema.file.add())
    return bytes(schema.SerializeToString())


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
