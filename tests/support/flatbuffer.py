"""Encodes Foxglove's image messages as flatbuffers, by the code that flatc made of its schemas."""

from __future__ import annotations

import importlib
import importlib.resources
from collections.abc import Mapping
from typing import Any

from flatbuffers import Builder
from foxglove_schemas_flatbuffer.Time import CreateTime


def encode_flatbuffer(message: str, fields: Mapping[str, Any]) -> bytes:
    """A message of foxglove.RawImage or foxglove.CompressedImage."""
    table = importlib.import_module(_module(message))
    builder = Builder(len(fields["data"]) + 1024)
    # Texts and bytes lie outside the table, and before it; times and numbers inside.
    values = dict(fields)
    for key, value in fields.items():
        if isinstance(value, str):
            values[key] = builder.CreateString(value)
        elif isinstance(value, bytes):
            values[key] = builder.CreateByteVector(value)
    table.Start(builder)
    for key, value in values.items():
        if key == "timestamp":
            value = CreateTime(builder, value["sec"], value["nanosec"])
        add = getattr(table, "Add" + key.title().replace("_", ""), None)
        if add is not None:  # else a field of ROS alone
            add(builder, value)
    builder.Finish(table.End(builder))
    return bytes(builder.Output())


def binary_schema(message: str) -> bytes:
    """The .bfbs of a message, as MCAP asks of a flatbuffer schema."""
    package, _, name = _module(message).rpartition(".")
    return importlib.resources.files(package).joinpath(f"{name}.bfbs").read_bytes()


def _module(message: str) -> str:
    return message.replace("foxglove", "foxglove_schemas_flatbuffer")
