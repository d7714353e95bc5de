"""Which messages are sonar images, and how each is decoded."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sonarrec.readers import foxglove, ros2
from sonarrec.readers.raw import Ping

Decoder = Callable[[memoryview], Ping]
"""One message's bytes to a Ping; raises UnusableError where they cannot be used."""

_PIXELS: dict[tuple[str, str], Callable[[memoryview], np.ndarray]] = {
    ("sensor_msgs/Image", "cdr"): ros2.ros2_image,
    ("sensor_msgs/CompressedImage", "cdr"): ros2.ros2_compressed_image,
    ("foxglove/RawImage", "protobuf"): foxglove.protobuf_raw_image,
    ("foxglove/CompressedImage", "protobuf"): foxglove.protobuf_compressed_image,
    ("foxglove/RawImage", "json"): foxglove.json_raw_image,
    ("foxglove/CompressedImage", "json"): foxglove.json_compressed_image,
}

KINDS = tuple(_PIXELS)
"""The (message type, message encoding) pairs that are read."""


def message_type(schema_name: str) -> str:
    """package/Name of a schema: "sensor_msgs/msg/Image" and the dotted names of some recorders
    mean the same."""
    return schema_name.replace(".", "/").replace("/msg/", "/")


def decoder_for(
    schema_name: str, schema_encoding: str, schema_data: bytes, message_encoding: str
) -> Decoder | None:
    """The decoder of a channel's messages, or None where they are no sonar images.

    schema_encoding, schema_data: the message definition as the file holds it ("ros2msg", ...).
    """
    pixels = _PIXELS.get((message_type(schema_name), message_encoding))
    return None if pixels is None else lambda message: Ping(pixels(message))
