"""How the fields of a message come out of its bytes, whatever it was encoded in."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from sonarrec.readers.mcap import foxglove
from sonarrec.readers.raw import UnusableError

Decode = Callable[[memoryview], Mapping[str, Any]]
"""Gives the fields of a message; raises UnusableError where it is malformed. A text of a binary
message may come as its bytes."""


def fields_decoder(
    name: str, schema_encoding: str, schema_data: bytes, message_encoding: str
) -> Decode | None:
    """What gives the fields of a message (package/Name) in CDR, ROS 1, JSON or, of Foxglove's own,
    protobuf and flatbuffer. None for another encoding, and for a ROS message that neither the file
    nor we define.

    A ROS message is read by the definition in the file, which may be of another version than ours;
    by ours where there is none. Raises DefinitionError where there is only one that cannot be used.
    """
    if message_encoding == "json":
        return decode_json
    if message_encoding in ("cdr", "ros1"):
        from sonarrec.readers.mcap.ros import ros_decoder  # with rosbags, where needed

        definition = schema_data if schema_encoding in ("ros1msg", "ros2msg") else b""
        return ros_decoder(name, definition, message_encoding == "ros1")
    decode = foxglove.DECODERS.get(message_encoding)
    return None if decode is None or name not in foxglove.FIELDS else partial(decode, name)


def decode_json(message: memoryview) -> Mapping[str, Any]:
    """The fields of a JSON object. Raises UnusableError where it is none."""
    try:
        table = json.loads(bytes(message))
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise UnusableError("malformed message (no JSON object)")
    return table
