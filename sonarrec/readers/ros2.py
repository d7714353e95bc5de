"""Decodes the image messages of ROS 2: CDR, in either byte order."""

from __future__ import annotations

import struct

import numpy as np

from sonarrec.readers.raw import UnusableError, decode_image, raw_pixels

# Second byte of the encapsulation header: plain CDR and plain XCDR2, big- and little-endian. They
# differ in the alignment of 8-byte numbers only, of which these messages have none.
_BYTE_ORDERS = {0: ">", 1: "<", 6: ">", 7: "<"}


class CdrReader:
    """Reads the fields of one CDR message in turn; numbers are aligned to their own size.

    Every method raises UnusableError where the message ends too early.
    """

    def __init__(self, message: memoryview) -> None:
        """message: with its 4-byte encapsulation header."""
        if len(message) < 4 or message[0] != 0 or message[1] not in _BYTE_ORDERS:
            raise UnusableError("malformed message (no CDR header)")
        self._order = _BYTE_ORDERS[message[1]]
        self._body = message[4:]
        self._at = 0

    def _take(self, size: int) -> memoryview:
        start, self._at = self._at, self._at + size
        if self._at > len(self._body):
            raise UnusableError("malformed message (it ends too early)")
        return self._body[start : self._at]

    def uint8(self) -> int:
        """One byte."""
        return self._take(1)[0]

    def uint32(self) -> int:
        """A 4-byte number at the next multiple of 4."""
        self._at += -self._at % 4
        return int(struct.unpack(self._order + "I", self._take(4))[0])

    def octets(self) -> memoryview:
        """A uint8[] sequence, not copied."""
        return self._take(self.uint32())

    def string(self) -> str:
        """A string without its closing NUL."""
        return bytes(self.octets()).rstrip(b"\0").decode(errors="replace")

    def header(self) -> None:
        """Skip a std_msgs/Header: stamp and frame_id."""
        self.uint32()
        self.uint32()
        self.octets()


def ros2_image(message: memoryview) -> np.ndarray:
    """Pixels of a sensor_msgs/msg/Image. Raises UnusableError where it is malformed."""
    cdr = CdrReader(message)
    cdr.header()
    height, width = cdr.uint32(), cdr.uint32()
    encoding = cdr.string()
    big_endian = bool(cdr.uint8())
    step = cdr.uint32()
    return raw_pixels(cdr.octets(), height, width, encoding, step, big_endian)


def ros2_compressed_image(message: memoryview) -> np.ndarray:
    """Pixels of a sensor_msgs/msg/CompressedImage. Raises UnusableError where it is malformed.

    The format ("png", "mono8; png compressed mono8", ...) is not needed: the data tell it.
    """
    cdr = CdrReader(message)
    cdr.header()
    cdr.octets()
    return decode_image(cdr.octets())
