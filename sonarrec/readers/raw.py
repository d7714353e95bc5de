"""What every reader yields, and the one place where its pixels become 8-bit grey."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from sonarrec.records import NO_STAMPS, Stamps
from sonarrec.sonar import Sonar


class UnusableError(Exception):
    """One frame cannot be used; the text says why. It never leaves the readers."""


@dataclass(frozen=True, slots=True)
class Ping:
    """What one message holds.

    pixels: (rows, columns) or (rows, columns, channels; BGR first), any dtype. stamp_ns: the
    header's stamp, None without one. sonar: the geometry that a polar ping tells of itself (all
    but tilt and height); None for an image that does not say what it shows.
    """

    pixels: np.ndarray
    stamp_ns: int | None = None
    sonar: Sonar | None = None


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One frame as its log holds it.

    name: what to call it in a message. timestamp_ns: None where the log carries no time.
    pixels, sonar: as of a Ping; pixels is None where it could not be read, and then `problem` says
    why; without a problem it is one of many lost together, which the log's `faults` tell once.
    stamps: every time that the log keeps of it.
    """

    name: str
    timestamp_ns: int | None
    pixels: np.ndarray | None
    problem: str | None = None
    sonar: Sonar | None = None
    stamps: Stamps = NO_STAMPS


class RawLog(Protocol):
    """One opened log: a single pass over its frames, in time order, one in memory at a time.

    frame_count: frames to come, None where unknown before the end. topic: the channel read, None
    where there are none. polar: its frames tell their own geometry.
    faults: lines about what is wrong with the log as a whole, complete after the pass.
    """

    frame_count: int | None
    topic: str | None
    polar: bool
    faults: list[str]

    def __iter__(self) -> Iterator[RawFrame]: ...

    def close(self) -> None: ...


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Sends file descriptor 2 to nowhere: libpng writes there past every logging setting."""
    try:
        kept = os.dup(2)
    except OSError:  # stderr is closed, so there is nothing to silence
        yield
        return
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNK = struct.Struct(">I4s")  # length, name; a checksum of 4 bytes follows the contents


def _png_is_whole(data: memoryview) -> bool:
    """Whether a PNG holds all its chunks up to the last; True of anything else.

    OpenCV believes the length of a chunk, and makes room for it (up to 4 GB), before it reads.
    """
    if data[: len(_PNG)] != _PNG:
        return True
    at = len(_PNG)
    while at + _PNG_CHUNK.size <= len(data):
        length, name = _PNG_CHUNK.unpack_from(data, at)
        at += _PNG_CHUNK.size + int(length) + 4
        if name == b"IEND":
            return at <= len(data)
    return False


def decode_image(data: bytes | memoryview | np.ndarray) -> np.ndarray:
    """The pixels of an image file in memory (PNG, JPEG, TIFF, BMP, PGM, ...), as stored.

    Raises UnusableError where OpenCV cannot read it whole.
    """
    buffer = np.frombuffer(data, np.uint8)
    if not buffer.size:
        raise UnusableError("empty image")
    if not _png_is_whole(buffer.data):
        raise UnusableError("unreadable image")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with _quiet_stderr():
            image = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise UnusableError("unreadable image")
    return np.asarray(image)


_RAW_ENCODINGS: dict[str, tuple[str, int, bool]] = {
    # encoding: (dtype without byte order, channels, red first)
    "mono8": ("u1", 1, False),
    "8UC1": ("u1", 1, False),
    "mono16": ("u2", 1, False),
    "16UC1": ("u2", 1, False),
    "32FC1": ("f4", 1, False),
    "64FC1": ("f8", 1, False),
    "8UC3": ("u1", 3, False),
    "8UC4": ("u1", 4, False),
    "bgr8": ("u1", 3, False),
    "rgb8": ("u1", 3, True),
    "bgra8": ("u1", 4, False),
    "rgba8": ("u1", 4, True),
}


def raw_pixels(
    data: memoryview | bytes,
    height: int,
    width: int,
    encoding: str,
    step: int,
    big_endian: bool,
) -> np.ndarray:
    """The pixels of an uncompressed image message, without a copy where they lie in BGR order.

    step: bytes from row to row. Some drivers state it wrongly: where step * height is not the
    length of the data but the pixels without padding are, the width is believed.
    Raises UnusableError where the numbers do not fit together or the encoding is unknown.
    """
    if encoding not in _RAW_ENCODINGS:
        known = ", ".join(_RAW_ENCODINGS)
        raise UnusableError(f"encoding {encoding!r} is not supported (only {known})")
    kind, channels, red_first = _RAW_ENCODINGS[encoding]
    dtype = np.dtype((">" if big_endian else "<") + kind)
    row = width * channels * dtype.itemsize
    if not height or not width:
        raise UnusableError("empty image")
    if not (step >= row and step * (height - 1) + row <= len(data) <= step * height):
        if row * height != len(data):
            raise UnusableError(
                f"{width} x {height} {encoding} pixels do not fit {len(data)} bytes (step {step})"
            )
        step = row
    pixels: np.ndarray = np.ndarray(
        (height, width, channels),
        dtype,
        buffer=data,
        strides=(step, channels * dtype.itemsize, dtype.itemsize),
    )
    if red_first:
        pixels = pixels[:, :, [2, 1, 0, 3][:channels]]
    return pixels[:, :, 0] if channels == 1 else pixels
