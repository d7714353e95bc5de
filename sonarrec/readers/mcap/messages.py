"""Which messages are sonar images, and how each is read.

A further message type is one function, from Fields to a Ping, and one row in MESSAGES. How the
fields come out of the bytes (CDR, ROS 1, JSON, protobuf, flatbuffers) is kept apart from that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sonarrec.readers.mcap.decode import Decode, fields_decoder
from sonarrec.readers.mcap.fields import Fields
from sonarrec.readers.pixels import decode_image, raw_pixels
from sonarrec.readers.raw import Ping, UnusableError
from sonarrec.records import FloatArray
from sonarrec.sonar import MIN_WINDOW_M, PingGeometry

# What each message means


def read_image(message: Fields) -> Ping:
    """sensor_msgs/Image, foxglove.RawImage: pixels as they lie in memory."""
    encoding = message.text("encoding")
    height, width, step = message.whole("height"), message.whole("width"), message.whole("step", 0)
    big_endian = message.whole("is_bigendian", 0) != 0
    pixels = raw_pixels(message.octets("data"), height, width, encoding, step, big_endian)
    return Ping(pixels, message.stamp_ns())


def read_compressed_image(message: Fields) -> Ping:
    """sensor_msgs/CompressedImage, foxglove.CompressedImage: an image file.

    The format ("png", "mono8; png compressed mono8", ...) is not needed: the data tell it.
    """
    return Ping(decode_image(message.octets("data")), message.stamp_ns())


# marine_acoustic_msgs/SonarImageData numbers its types so.
_SAMPLE_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")


def _samples(image: Fields, bins: int, beams: int) -> np.ndarray:
    """(bins, beams) samples of a SonarImageData, taken to be range-major."""
    if bins < 2 or beams < 2:
        raise UnusableError(f"{beams} beams of {bins} samples are no image")
    number = image.whole("dtype")
    if number >= len(_SAMPLE_TYPES):
        raise UnusableError(f"unknown sample type {number}")
    order = ">" if image.whole("is_bigendian") else "<"
    dtype = np.dtype(order + _SAMPLE_TYPES[number])
    data = image.octets("data")
    if bins * beams * dtype.itemsize != len(data):
        raise UnusableError(
            f"{beams} beams of {bins} samples, {dtype.itemsize} bytes each, do not fit "
            f"{len(data)} bytes"
        )
    return np.frombuffer(data, dtype).reshape(bins, beams)


def _beam_count(image: Fields, bearings: np.ndarray) -> int:
    beams = image.whole("beam_count")
    if beams != len(bearings):
        raise UnusableError(f"{beams} beams with {len(bearings)} directions")
    return beams


def _left_to_right(bearings_deg: FloatArray) -> FloatArray:
    """Drivers disagree on which side is positive, but all list their beams from left to right."""
    falls = len(bearings_deg) > 1 and bearings_deg[0] > bearings_deg[-1]
    return -bearings_deg if falls else bearings_deg


def _fan_bearings(directions: FloatArray) -> FloatArray:
    """(beams,) degrees from left to right, of (beams, 3) unit vectors.

    Forward is the axis they point along on the whole (z in the definition, x in some drivers),
    across it the one along which they differ most.
    """
    if len(directions) < 2:
        raise UnusableError("fewer than two beams")
    middle = directions.mean(axis=0)
    forward = int(np.argmax(np.abs(middle)))
    spread = np.ptp(directions, axis=0)
    spread[forward] = -1
    across = int(np.argmax(spread))
    ahead = directions[:, forward] * np.sign(middle[forward])
    return _left_to_right(np.degrees(np.arctan2(directions[:, across], ahead)))


def _geometry(ranges_m: FloatArray, bearings_deg: FloatArray) -> PingGeometry:
    """The geometry of a ping from the middles of its bins and beams.

    Raises UnusableError where they are no window in front of a sonar.
    """
    steps = np.diff(ranges_m)
    if len(ranges_m) < 2 or ranges_m[0] < 0 or not np.all(steps > 0):
        raise UnusableError("ranges do not rise from bin to bin")
    if ranges_m[-1] - ranges_m[0] < MIN_WINDOW_M:
        raise UnusableError(f"a window of {ranges_m[-1] - ranges_m[0]:g} m")
    turns = np.diff(bearings_deg)
    if len(bearings_deg) < 2 or not (np.all(turns > 0) or np.all(turns < 0)):
        raise UnusableError("bearings do not run one way from beam to beam")
    if np.abs(bearings_deg).max() >= 90:
        raise UnusableError("bearings of 90 deg and more")
    even = np.linspace(ranges_m[0], ranges_m[-1], len(ranges_m))
    first = last = even[1] - even[0]
    ranges = None
    if np.abs(ranges_m - even).max() > first / 64:  # resampling does not resolve less
        first, last = steps[0], steps[-1]
        ranges = tuple(ranges_m.tolist())
    return PingGeometry(
        range_min_m=max(float(ranges_m[0] - first / 2), 0.0),
        range_max_m=float(ranges_m[-1] + last / 2),
        bearings_deg=tuple(bearings_deg.tolist()),
        ranges_m=ranges,
    )


def read_projected_sonar_image(message: Fields) -> Ping:
    """marine_acoustic_msgs/ProjectedSonarImage: a direction per beam, a range per bin."""
    image = message.inner("image")
    bearings = _fan_bearings(message.vectors("beam_directions"))
    ranges = message.numbers("ranges")
    pixels = _samples(image, len(ranges), _beam_count(image, bearings))
    return Ping(pixels, message.stamp_ns(), _geometry(ranges, bearings))


def read_raw_sonar_image(message: Fields) -> Ping:
    """marine_acoustic_msgs/RawSonarImage: ranges follow from the time of each sample."""
    image = message.inner("image")
    bearings = _left_to_right(np.degrees(message.numbers("rx_angles")))
    speed = message.inner("ping_info").number("sound_speed")
    rate = message.number("sample_rate")
    if speed <= 0 or rate <= 0:
        raise UnusableError(f"sound speed {speed:g} m/s at {rate:g} samples a second")
    bins = message.whole("samples_per_beam")
    pixels = _samples(image, bins, _beam_count(image, bearings))
    ranges = (message.whole("sample0") + np.arange(bins)) * speed / (2 * rate)
    return Ping(pixels, message.stamp_ns(), _geometry(ranges, bearings))


def _oculus_geometry(message: Fields, bins: int, beams: int) -> PingGeometry:
    """Bearings in hundredths of a degree; bins of one length from the sonar on."""
    bearings = message.numbers("bearings") / 100
    if len(bearings) != beams:
        raise UnusableError(f"{beams} beams with {len(bearings)} bearings")
    resolution = message.number("range_resolution")
    if resolution <= 0:
        raise UnusableError(f"range resolution {resolution:g} m")
    ranges = (np.arange(bins) + 0.5) * resolution
    # Rows of an image: which axis is which need not be found out.
    return replace(_geometry(ranges, bearings), beam_order="range-major")


def read_oculus_ping(message: Fields) -> Ping:
    """sonar_oculus/OculusPing: an image, compressed in later versions, and its geometry."""
    inner = message.inner("ping")
    image = read_image(inner) if "encoding" in inner else read_compressed_image(inner)
    geometry = _oculus_geometry(message, *image.pixels.shape[:2])
    return Ping(image.pixels, message.stamp_ns(), geometry)


def read_oculus_interfaces_ping(message: Fields) -> Ping:
    """oculus_interfaces/Ping: rows may begin with a gain, by whose root they are divided."""
    bins, beams, step = (message.whole(k) for k in ("n_ranges", "n_beams", "step"))
    size = message.whole("sample_size")
    if size not in (1, 2, 4):
        raise UnusableError(f"samples of {size} bytes")
    data = message.octets("ping_data")
    head = 4 if message.whole("has_gains") else 0
    row = head + beams * size
    if len(data) != bins * step or step < row:  # as with images, a wrong step is not believed
        step = row
    if not bins or not beams or len(data) != bins * step:
        raise UnusableError(f"{beams} beams of {bins} samples do not fit {len(data)} bytes")
    rows = np.frombuffer(data, np.uint8).reshape(bins, step)
    pixels = np.ascontiguousarray(rows[:, head:row]).view(f"<u{size}")
    if head:
        gains = np.ascontiguousarray(rows[:, :head]).view("<u4")
        pixels = (pixels / np.sqrt(np.maximum(gains, 1))).astype(np.float32)
    return Ping(pixels, message.stamp_ns(), _oculus_geometry(message, bins, beams))


@dataclass(frozen=True, slots=True)
class MessageType:
    """How a message is read, and whether it is polar and tells its own geometry."""

    read: Callable[[Fields], Ping]
    polar: bool = False


_IMAGE, _COMPRESSED = MessageType(read_image), MessageType(read_compressed_image)
_PROJECTED = MessageType(read_projected_sonar_image, polar=True)
_OCULUS = MessageType(read_oculus_ping, polar=True)
MESSAGES = {
    "sensor_msgs/Image": _IMAGE,
    "sensor_msgs/CompressedImage": _COMPRESSED,
    "foxglove/RawImage": _IMAGE,
    "foxglove/CompressedImage": _COMPRESSED,
    "foxglove_msgs/RawImage": _IMAGE,
    "foxglove_msgs/CompressedImage": _COMPRESSED,
    "marine_acoustic_msgs/ProjectedSonarImage": _PROJECTED,
    "marine_acoustic_msgs/RawSonarImage": MessageType(read_raw_sonar_image, polar=True),
    "acoustic_msgs/ProjectedSonarImage": _PROJECTED,  # its name before 2022
    "sonar_oculus/OculusPing": _OCULUS,
    "sonar_oculus/OculusPingUncompressed": _OCULUS,
    "sonar_oculus_interface/OculusPing": _OCULUS,
    "oculus_interfaces/Ping": MessageType(read_oculus_interfaces_ping, polar=True),
}

READABLE = f"{', '.join(MESSAGES)} (CDR, ROS 1 or JSON; foxglove also protobuf and flatbuffer)"
"""What is read, for error messages."""


def message_type(schema_name: str) -> str:
    """package/Name of a schema: "sensor_msgs/msg/Image" and the dotted names of some recorders
    ("sensor_msgs.msg.Image") mean the same."""
    return schema_name.replace(".", "/").replace("/msg/", "/")


@dataclass(frozen=True, slots=True)
class Decoder:
    """Gives the Ping of one message's bytes; raises UnusableError where they cannot be used."""

    fields: Decode
    kind: MessageType

    @property
    def polar(self) -> bool:
        """Whether pings tell their own geometry."""
        return self.kind.polar

    def __call__(self, message: memoryview) -> Ping:
        with np.errstate(all="ignore"):  # damaged numbers overflow; what comes of them is checked
            return self.kind.read(Fields(self.fields(message)))


def decoder_for(
    schema_name: str, schema_encoding: str, schema_data: bytes, message_encoding: str
) -> Decoder | None:
    """The decoder of a channel's messages, or None where they are not read.

    schema_encoding, schema_data: the message definition as the file holds it ("ros2msg", ...).
    Raises DefinitionError where it cannot be used and there is none of ours.
    """
    name = message_type(schema_name)
    kind = MESSAGES.get(name)
    if kind is None:
        return None
    fields = fields_decoder(name, schema_encoding, schema_data, message_encoding)
    return None if fields is None else Decoder(fields, kind)
