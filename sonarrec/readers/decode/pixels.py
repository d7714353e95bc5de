"""Decodes images, from files or messages, into pixels."""

from __future__ import annotations

import contextlib
import os
import re
import struct
import tempfile
from collections.abc import Iterator
from functools import cache
from itertools import islice
from typing import BinaryIO

import cv2
import numpy as np

from sonarrec.readers.raw import UnusableError


@contextlib.contextmanager
def _stderr_to(file: int) -> Iterator[None]:
    """Sends file descriptor 2 to another: decoders write there past every logging setting."""
    if file == 2:  # stderr was closed when the other was opened
        yield
        return
    try:
        saved = os.dup(2)
    except OSError:  # it is closed
        saved = None
    try:
        os.dup2(file, 2)
        yield
    finally:
        if saved is None:
            os.close(2)
        else:
            os.dup2(saved, 2)
            os.close(saved)


@cache
def _warnings_file() -> BinaryIO:
    """The temporary file to which the decoders' warnings go."""
    return tempfile.TemporaryFile(prefix="sonarrec_", buffering=0)


_JPEG = b"\xff\xd8"
_EXTRA = re.compile(rb"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")
_IN_HEAD = re.compile(rb"Corrupt JPEG data: \d+ extraneous bytes before marker 0x(?:[^d].|d[abd])")


def _jpeg_is_damaged(data: np.ndarray, warning: bytes) -> bool:
    """Whether the decoder of a JPEG met damage, by its warning. libjpeg gives an image all the
    same. Zeros before the end marker are padding: some cameras write them."""
    warning = _IN_HEAD.sub(b"", warning)  # no pixel is lost there
    if b"Corrupt JPEG" not in warning and b"Premature end" not in warning:
        return False
    extra = _EXTRA.search(warning)
    if extra is None:
        return True
    end = data.tobytes().rfind(b"\xff\xd9")
    return bool(data[max(0, end - int(extra[1])) : end].any())


_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNK = struct.Struct(">I4s")  # length, name; a checksum of 4 bytes follows the contents


def _png_is_whole(data: memoryview) -> bool:
    """Whether a PNG has all its chunks up to the last; True for anything else. OpenCV trusts the
    stated length of a chunk, and allocates it (up to 4 GB), before it reads."""
    if data[: len(_PNG)] != _PNG:
        return True
    at = len(_PNG)
    while at + _PNG_CHUNK.size <= len(data):
        length, name = _PNG_CHUNK.unpack_from(data, at)
        at += _PNG_CHUNK.size + int(length) + 4
        if name == b"IEND":
            return at <= len(data)
    return False


_PGM = re.compile(rb"P[25](?:\s|#.*\n)+\d+(?:\s|#.*\n)+\d+(?:\s|#.*\n)+(\d{1,5})\s")


def pgm_maxval(data: np.ndarray) -> int | None:
    """The value that a PGM states as white; None if it is the largest of its type, and for other
    files."""
    header = _PGM.match(data[:1000].tobytes())
    return int(header[1]) if header and int(header[1]) not in (0, 255, 65535) else None


# By the first bytes of a TIFF, struct formats: byte order, where the offset of the first directory
# is, an offset, the length of a directory, and the bytes of an entry.
_TIFFS = {
    b"II*\0": ("<", 4, "I", "H", 12),
    b"MM\0*": (">", 4, "I", "H", 12),
    b"II+\0": ("<", 8, "Q", "Q", 20),
    b"MM\0+": (">", 8, "Q", "Q", 20),
}
_SUBFILE_TYPE, _PART_OF_ANOTHER = 254, 0b101  # bits: a smaller copy of another image, its mask
_PHOTOMETRIC, _WHITE_IS_ZERO = 262, 0
_PLANES, _APART = 284, 2
_SHORT = 3  # type of a field


def _tiff_images(data: memoryview) -> Iterator[dict[int, int]]:
    """The first value of each field of each image of a TIFF, by its tag; none for other files. It
    ends where the file does, or where it leads back."""
    if (kind := data[:4].tobytes()) not in _TIFFS:
        return
    order, first_at, offset, length, entry_bytes = _TIFFS[kind]
    met = set[int]()
    with contextlib.suppress(struct.error, OverflowError):
        (at,) = struct.unpack_from(order + offset, data, first_at)
        while at and at not in met:
            met.add(at)
            (entries,) = struct.unpack_from(order + length, data, at)
            at += struct.calcsize(order + length)
            end = at + entries * entry_bytes
            (following,) = struct.unpack_from(order + offset, data, end)
            fields = {}
            for entry in range(at, end, entry_bytes):
                # A number of two bytes stands first in its field.
                tag, kind_of_field = struct.unpack_from(f"{order}HH", data, entry)
                form = f"{order}{'H' if kind_of_field == _SHORT else 'I'}"
                (fields[tag],) = struct.unpack_from(
                    form, data, entry + 4 + struct.calcsize(order + offset)
                )
            yield fields
            at = following


# Of any type, and turned by EXIF data as viewers and annotation tools show it. A TIFF is turned in
# any case, and one of four channels of floats can only be read unchanged.
_AS_SHOWN = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR


def decode_image(data: bytes | memoryview | np.ndarray) -> np.ndarray:
    """The pixels of an image file in memory (PNG, JPEG, TIFF, BMP, PGM, ...), as viewers show it.
    Raises UnusableError if OpenCV cannot read it whole, if its header states too many pixels, or if
    it is a TIFF of several images."""
    buffer = np.frombuffer(data, np.uint8)
    if not buffer.size:
        raise UnusableError("empty image")
    if not _png_is_whole(buffer.data):
        raise UnusableError("unreadable image")
    images_held = (
        not fields.get(_SUBFILE_TYPE, 0) & _PART_OF_ANOTHER for fields in _tiff_images(buffer.data)
    )
    if sum(islice(filter(None, images_held), 2)) > 1:
        raise UnusableError("a TIFF of several images; one image a file is read")
    flags = cv2.IMREAD_UNCHANGED if buffer[:4].tobytes() in _TIFFS else _AS_SHOWN
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        warnings = _warnings_file()
        with _stderr_to(warnings.fileno()):
            image = cv2.imdecode(buffer, flags)
        warning = b""
        if warnings.tell():
            warnings.seek(0)
            warning = warnings.read(4096)
            warnings.seek(0)
            warnings.truncate()
    except cv2.error as error:
        if "CV_IO_MAX_IMAGE" in str(error):  # see sonarrec/__init__.py
            raise UnusableError("an image of more than 4096 x 4096 pixels") from None
        image = None
    if image is None:
        raise UnusableError("unreadable image")
    if buffer[:2].tobytes() == _JPEG and _jpeg_is_damaged(buffer, warning):
        raise UnusableError("a JPEG that is damaged inside")
    # OpenCV itself inverts such images of 8 bits.
    if image.dtype == np.uint16:
        fields = next(_tiff_images(buffer.data), {})
        if image.ndim == 3 and fields.get(_PLANES) == _APART:
            raise UnusableError("a TIFF of 16 bit whose colours lie in planes of their own")
        if fields.get(_PHOTOMETRIC) == _WHITE_IS_ZERO:
            image = np.bitwise_not(image)
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
    """The pixels of an uncompressed image message, without a copy if they are in BGR order.

    step: bytes from row to row. Some drivers state it wrongly: it is ignored if it does not fit the
    length of the data but rows without padding do.
    Raises UnusableError if the numbers do not fit together or the encoding is unknown.
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
    step = min(step, len(data))  # with a single row it may be anything
    pixels: np.ndarray = np.ndarray(
        (height, width, channels),
        dtype,
        buffer=data,
        strides=(step, channels * dtype.itemsize, dtype.itemsize),
    )
    if red_first:
        pixels = pixels[:, :, [2, 1, 0, 3][:channels]]
    return pixels[:, :, 0] if channels == 1 else pixels
