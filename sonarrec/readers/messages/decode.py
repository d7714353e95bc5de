"""Decodes the fields of a message from its bytes, for every encoding that is read."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from sonarrec.readers.messages import foxglove
from sonarrec.readers.raw import UnusableError

Decode = Callable[[memoryview], Mapping[str, Any]]
"""Decodes a message into its fields; raises UnusableError if it is malformed. Texts of binary
messages may come as bytes."""


def fields_decoder(
    name: str, schema_encoding: str, schema_data: bytes, message_encoding: str
) -> Decode | None:
    """The decoder of a message type (package/Name); None if it cannot be decoded.

    Encodings: CDR, ROS 1, JSON, and for Foxglove's own types protobuf and flatbuffer. A ROS message
    is decoded by the definition in the file, whose version may differ from ours; if the file has
    none, by our own. Raises DefinitionError if the only definition cannot be used.
    """
    if message_encoding == "json":
        return decode_json
    if message_encoding in ("cdr", "ros1"):
        from sonarrec.readers.messages.ros import ros_decoder  # with rosbags, where needed

        definition = schema_data if schema_encoding in ("ros1msg", "ros2msg") else b""
        return ros_decoder(name, definition, message_encoding == "ros1")
    decode = foxglove.DECODERS.get(message_encoding)
    return None if decode is None or name not in foxglove.FIELDS else partial(decode, name)


def decode_json(message: memoryview) -> Mapping[str, Any]:
    """The fields of a JSON object. Raises UnusableError if the message is no JSON object."""
    try:
        table = json.loads(bytes(message))
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise UnusableError("malformed message (no JSON object)")
    return table
