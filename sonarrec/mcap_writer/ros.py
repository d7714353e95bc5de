"""Encodes messages by their ROS definition: CDR, the serialisation of ROS 1, and JSON."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from sonarrec.readers.mcap.ros_definitions import Struct


def encode_cdr(layout: Struct, fields: Mapping[str, Any]) -> bytes:
    """A CDR message, little-endian: every number is aligned to its own size."""
    return b"\x00\x01\x00\x00" + _Wire(aligned=True).encode(layout, fields)


def encode_ros1(layout: Struct, fields: Mapping[str, Any]) -> bytes:
    """A ROS 1 message: nothing is aligned."""
    return _Wire(aligned=False).encode(layout, fields)


class _Wire:
    def __init__(self, aligned: bool) -> None:
        self._aligned = aligned
        self._out = bytearray()

    def encode(self, layout: Struct, fields: Mapping[str, Any]) -> bytes:
        self._struct(layout, fields)
        return bytes(self._out)

    def _struct(self, layout: Struct, fields: Mapping[str, Any]) -> None:
        for field in layout.fields:
            value, kind = fields[field.name], field.kind
            if field.count is None:
                self._value(kind, value)
                continue
            if not field.count:
                self._numbers("I", [len(value)])
            if isinstance(kind, Struct) or kind == "string":
                for item in value:
                    self._value(kind, item)
            else:
                self._numbers(kind, value)

    def _value(self, kind: str | Struct, value: Any) -> None:
        if isinstance(kind, Struct):
            self._struct(kind, value)
        elif kind == "string":
            data = value.encode() + (b"\0" if self._aligned else b"")  # ROS 1 has no closing NUL
            self._numbers("I", [len(data)])
            self._out += data
        else:
            self._numbers(kind, [value])

    def _numbers(self, kind: str, values: bytes | list[float]) -> None:
        if self._aligned and len(values):
            self._out += bytes(-len(self._out) % struct.calcsize(f"<{kind}"))
        self._out += (
            values if isinstance(values, bytes) else np.asarray(values, f"<{kind}").tobytes()
        )


def encode_json(fields: Mapping[str, Any]) -> bytes:
    """A JSON message; bytes are base64."""
    return json.dumps(fields, default=lambda data: base64.b64encode(data).decode()).encode()


def json_schema(layout: Struct, title: str) -> bytes:
    """The JSON schema of a message."""
    return json.dumps({"title": title, **_schema_of(layout)}).encode()


def _schema_of(kind: str | Struct) -> dict[str, Any]:
    if isinstance(kind, Struct):
        properties = {}
        for field in kind.fields:
            schema = _schema_of(field.kind)
            if field.count is not None:
                schema = (
                    {"type": "string", "contentEncoding": "base64"}
                    if field.kind == "B"
                    else {"type": "array", "items": schema}
                )
            properties[field.name] = schema
        return {"type": "object", "properties": properties}
    if kind == "string":
        return {"type": "string"}
    return {"type": {"?": "boolean", "f": "number", "d": "number"}.get(kind, "integer")}
