"""The message types that hold sonar images, and how each is decoded.

To add a message type, write one function from Fields to Decoded and add one row to IMAGES or PINGS.
`fields_decoder` finds what turns the bytes into Fields: CDR, ROS 1, JSON, protobuf, flatbuffers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.readers.containers.oculus import oculus_geometry, oculus_samples
from sonarrec.readers.decode.pixels import decode_image, raw_pixels
from sonarrec.readers.messages import foxglove
from sonarrec.readers.messages.fields import Fields
from sonarrec.readers.raw import Decoded, UnusableError, ping_geometry

WIDEST_BEAM_DEG = 5.0
Decode = Callable[[memoryview], Mapping[str, Any]]
"""Decodes a message into its fields; raises UnusableError if it is malformed. Texts of binary
messages may come as bytes."""


def read_image(message: Fields) -> Decoded:
    """sensor_msgs/Image, foxglove.RawImage: uncompressed pixels."""
    encoding = message.text("encoding")
    height, width = message.integer("height"), message.integer("width")
    step = message.integer("step", 0)
    big_endian = message.integer("is_bigendian", 0) != 0
    pixels = raw_pixels(message.octets("data"), height, width, encoding, step, big_endian)
    return Decoded(pixels, message.stamp_ns())


def read_compressed_image(message: Fields) -> Decoded:
    """sensor_msgs/CompressedImage, foxglove.CompressedImage: an image file. The field `format`
    ("png", "mono8; png compressed mono8", ...) is ignored, because the data begin with the file's
    own mark."""
    return Decoded(decode_image(message.octets("data")), message.stamp_ns())


# In the order in which marine_acoustic_msgs/SonarImageData numbers them.
_SAMPLE_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")


def _samples(message: Fields, bins: int, bearings_deg: FloatArray) -> np.ndarray:
    """(bins, beams) samples of a message's SonarImageData, assumed to be range-major."""
    image = message.inner("image")
    beams, number = image.integer("beam_count"), image.integer("dtype")
    if beams != len(bearings_deg):
        raise UnusableError(f"{beams} beams with {len(bearings_deg)} directions")
    if bins < 2 or beams < 2:
        raise UnusableError(f"{beams} beams of {bins} samples are no image")
    if number >= len(_SAMPLE_TYPES):
        raise UnusableError(f"unknown sample type {number}")
    dtype = np.dtype((">" if image.integer("is_bigendian") else "<") + _SAMPLE_TYPES[number])
    data = image.octets("data")
    if bins * beams * dtype.itemsize != len(data):
        raise UnusableError(
            f"{beams} beams of {bins} samples, {dtype.itemsize} bytes each, do not fit "
            f"{len(data)} bytes"
        )
    return np.frombuffer(data, dtype).reshape(bins, beams)


def _left_to_right(bearings_deg: FloatArray) -> FloatArray:
    """(beams,) bearings, deg, rising. Drivers disagree on which side is positive, but all list
    their beams from left to right."""
    falls = len(bearings_deg) > 1 and bearings_deg[0] > bearings_deg[-1]
    return -bearings_deg if falls else bearings_deg


def _fan_bearings(directions: FloatArray) -> tuple[FloatArray, float]:
    """((beams,) bearings in their plane from left to right, its pitch, both in deg). directions:
    (beams, 3) unit vectors, which a driver may give in the axes of a vehicle. The forward axis is
    the one along which their mean is largest (z in the definition, x in some drivers). The axis
    across is the one along which they differ most."""
    if len(directions) < 2:
        raise UnusableError("fewer than two beams")
    middle = directions.mean(axis=0)
    forward = int(np.argmax(np.abs(middle)))
    spread = np.ptp(directions, axis=0)
    spread[forward] = -1
    across = int(np.argmax(spread))
    ahead = directions[:, forward] * np.sign(middle[forward])
    off = directions[:, 3 - forward - across]
    side = directions[:, across]
    pitch = np.arctan2(off.mean(), ahead.mean())
    ahead, off = (
        ahead * np.cos(pitch) + off * np.sin(pitch),
        off * np.cos(pitch) - ahead * np.sin(pitch),
    )
    roll = np.arctan2(off @ side, side @ side)  # by least squares
    side = side * np.cos(roll) + off * np.sin(roll)
    bearings = _left_to_right(np.degrees(np.arctan2(side, ahead)))
    return bearings, float(np.degrees(pitch))


def read_projected_sonar_image(message: Fields) -> Decoded:
    """marine_acoustic_msgs/ProjectedSonarImage: states a direction per beam and a range per bin."""
    bearings, pitch_deg = _fan_bearings(message.vectors("beam_directions"))
    ranges = message.numbers("ranges")
    pixels = _samples(message, len(ranges), bearings)
    return _acoustic_ping(message, pixels, ranges, bearings, pitch_deg)


def read_raw_sonar_image(message: Fields) -> Decoded:
    """marine_acoustic_msgs/RawSonarImage: ranges are computed from the times of the samples."""
    bearings = _left_to_right(np.degrees(message.numbers("rx_angles")))
    speed = message.inner("ping_info").number("sound_speed")
    rate = message.number("sample_rate")
    if speed <= 0 or rate <= 0:
        raise UnusableError(f"sound speed {speed:g} m/s at {rate:g} samples a second")
    pixels = _samples(message, message.integer("samples_per_beam"), bearings)
    ranges = (message.integer("sample0") + np.arange(len(pixels))) * speed / (2 * rate)
    return _acoustic_ping(message, pixels, ranges, bearings)


def _acoustic_ping(
    message: Fields,
    pixels: np.ndarray,
    ranges_m: FloatArray,
    bearings_deg: FloatArray,
    pitch_deg: float = 0.0,
) -> Decoded:
    ping = ping_geometry(ranges_m, bearings_deg)
    ping = replace(ping, beam_width_deg=_beam_width(message), pitch_deg=pitch_deg)
    return Decoded(pixels, message.stamp_ns(), ping)


def _beam_width(message: Fields) -> float | None:
    """Median width of the receiving beams at -3 dB, deg; None if it is not reported. The message
    states radians (PingInfo of marine_acoustic_msgs at docs.ros.org). Impossible widths are
    ignored, because some drivers fill in degrees or zeros."""
    try:
        degrees = np.degrees(message.inner("ping_info").numbers("rx_beamwidths"))
    except UnusableError:  # the image can be used without it
        return None
    degrees = degrees[(degrees > 0) & (degrees <= WIDEST_BEAM_DEG)]
    return round(float(np.median(degrees)), 3) if len(degrees) else None


def read_oculus_ping(message: Fields) -> Decoded:
    """sonar_oculus/OculusPing: an image (compressed in later versions) and its geometry."""
    inner = message.inner("ping")
    image = read_image(inner) if "encoding" in inner else read_compressed_image(inner)
    return _oculus_ping(message, image.pixels)


def read_oculus_interfaces_ping(message: Fields) -> Decoded:
    """oculus_interfaces/Ping: a row may begin with a gain; it is divided by the gain's root."""
    bins, beams, step = (message.integer(k) for k in ("n_ranges", "n_beams", "step"))
    size = message.integer("sample_size")
    data = message.octets("ping_data")
    gains = message.integer("has_gains") != 0
    if len(data) != bins * step:  # a wrong step is ignored, as in images
        step = 0
    pixels = oculus_samples(data, bins, beams, size, gains=gains, step=step)
    return _oculus_ping(message, pixels)


def _oculus_ping(message: Fields, pixels: np.ndarray) -> Decoded:
    bearings, resolution = message.numbers("bearings"), message.number("range_resolution")
    ping = oculus_geometry(bearings, resolution, *pixels.shape[:2])
    return Decoded(pixels, message.stamp_ns(), ping)


Read = Callable[[Fields], Decoded]
IMAGES: dict[str, Read] = {
    "sensor_msgs/Image": read_image,
    "sensor_msgs/CompressedImage": read_compressed_image,
    "foxglove/RawImage": read_image,
    "foxglove/CompressedImage": read_compressed_image,
    "foxglove_msgs/RawImage": read_image,
    "foxglove_msgs/CompressedImage": read_compressed_image,
}
PINGS: dict[str, Read] = {
    "marine_acoustic_msgs/ProjectedSonarImage": read_projected_sonar_image,
    "marine_acoustic_msgs/RawSonarImage": read_raw_sonar_image,
    "acoustic_msgs/ProjectedSonarImage": read_projected_sonar_image,  # its name before 2022
    "sonar_oculus/OculusPing": read_oculus_ping,
    "sonar_oculus/OculusPingUncompressed": read_oculus_ping,
    "sonar_oculus_interface/OculusPing": read_oculus_ping,
    "oculus_interfaces/Ping": read_oculus_interfaces_ping,
}
"""Polar: they state their own geometry."""
MESSAGES = IMAGES | PINGS


def message_type(schema_name: str) -> str:
    """The message type (package/Name) that a schema's name stands for. "sensor_msgs/msg/Image" and
    "sensor_msgs.msg.Image", as some recorders write it, are the same."""
    return schema_name.replace(".", "/").replace("/msg/", "/")


class Decoder:
    """Decodes a channel's messages. polar: whether they are pings. senders: the frame_ids of the
    messages so far."""

    def __init__(self, name: str, fields: Decode) -> None:
        """name: of the message type, a key of MESSAGES. fields: of a message by its bytes."""
        self._fields, self._read = fields, MESSAGES[name]
        self.polar = name in PINGS
        self.senders = set[str]()

    def __call__(self, message: memoryview) -> Decoded:
        """What a message holds. Raises UnusableError if it cannot be used."""
        with np.errstate(all="ignore"):  # damaged numbers overflow; results are checked
            fields = Fields(self._fields(message))
            self.senders.update(fields.sender())
            return self._read(fields)


def decoder_for(
    schema_name: str, schema_encoding: str, schema_data: bytes, message_encoding: str
) -> Decoder | None:
    """The decoder of a channel's messages; None if they are not sonar images or cannot be decoded.
    schema_encoding, schema_data: the message definition in the file ("ros2msg", ...). Raises
    DefinitionError if it cannot be used and we have none of our own."""
    name = message_type(schema_name)
    if name not in MESSAGES:
        return None
    fields = fields_decoder(name, schema_encoding, schema_data, message_encoding)
    return None if fields is None else Decoder(name, fields)


def fields_decoder(
    name: str, schema_encoding: str, schema_data: bytes, message_encoding: str
) -> Decode | None:
    """The decoder of a message type (package/Name); None if it cannot be decoded. Encodings: CDR,
    ROS 1, JSON, and for Foxglove's own types protobuf and flatbuffer. A ROS message is decoded by
    the definition in the file, whose version may differ from ours; if the file has none, by our
    own. Raises DefinitionError if the only definition cannot be used."""
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
