"""Decodes images, from files or messages, into pixels."""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import tempfile
from collections.abc import Iterator
from functools import cache
from typing import BinaryIO

import cv2
import numpy as np

from sonarrec.readers.raw import UnusableError
from sonarrec.tables import something_else


@cache
def warnings_file() -> BinaryIO:
    """The temporary file to which the decoders' warnings go."""
    return tempfile.TemporaryFile(prefix="sonarrec_", buffering=0)


@contextlib.contextmanager
def warnings_to(file: BinaryIO) -> Iterator[None]:
    """Sends file descriptor 2 to an emptied file: decoders write there past every logging
    setting."""
    file.seek(0)
    file.truncate()
    if file.fileno() == 2:  # stderr was closed when the file was opened
        yield
        return
    try:
        saved = os.dup(2)
    except OSError:  # it is closed
        saved = None
    try:
        os.dup2(file.fileno(), 2)
        yield
    finally:
        if saved is None:
            os.close(2)
        else:
            os.dup2(saved, 2)
            os.close(saved)


def written(file: BinaryIO) -> bytes:
    """The first warnings that were sent to the file."""
    if not file.tell():
        return b""
    file.seek(0)
    return file.read(4096)


_JPEG = b"\xff\xd8"
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # segments that state size and colours
_JPEG_EXIF = 0xE1
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


_PNG_HEADER = struct.Struct(">II5B")  # columns, rows, bits, colours, and three that are 0
_PLAIN_GREY = (8, 0, 0, 0, 0)
_ROTATED_OR_TRANSPARENT = {b"eXIf", b"tRNS"}
_MOST_PIXELS = 2**24  # as OpenCV, see sonarrec/__init__.py


def _png_chunks(data: memoryview) -> set[bytes] | None:
    """The names of a PNG's chunks; None if one is cut or missing. OpenCV trusts the stated length
    of a chunk, and allocates it (up to 4 GB), before it reads."""
    names, position = set(), len(_PNG)
    while position + _PNG_CHUNK.size <= len(data):
        length, name = _PNG_CHUNK.unpack_from(data, position)
        names.add(name)
        position += _PNG_CHUNK.size + int(length) + 4
        if name == b"IEND":
            return names if position <= len(data) else None
    return None


def _plain_png(data: memoryview) -> np.ndarray | None:
    """The pixels of an 8-bit grey PNG with all its chunks, in half of OpenCV's time. None for any
    other PNG, and for one that is damaged: OpenCV is the judge of these."""
    if len(data) < len(_PNG) + _PNG_CHUNK.size + _PNG_HEADER.size:
        return None
    columns, rows, *kind = _PNG_HEADER.unpack_from(data, len(_PNG) + _PNG_CHUNK.size)
    if tuple(kind) != _PLAIN_GREY or not 0 < rows * columns <= _MOST_PIXELS:
        return None
    try:
        from kornia_rs.io import decode_image_png_u8

        return np.asarray(decode_image_png_u8(bytes(data), (rows, columns), "mono"))[:, :, 0]
    except Exception:  # it has no narrower type
        return None


_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"
HEAD_BYTES, END_BYTES = 1024, len(_PNG_END)


def kind_if_complete(head: bytes, end: bytes) -> bytes | None:
    """What the header of an image says of its pixels (size, bits, colours), if its end is there.

    head, end: its first HEAD_BYTES and last END_BYTES. None where only decoding it can tell: it is
    cut or damaged there, neither PNG nor JPEG, or may be rotated by EXIF data.
    """
    if head.startswith(_PNG) and end == _PNG_END:
        return head[: len(_PNG) + _PNG_CHUNK.size + _PNG_HEADER.size + 4]  # with its checksum
    if head.startswith(_JPEG) and end.endswith(_JPEG_END):
        position = len(_JPEG)
        while (part := head[position : position + 4]) and len(part) == 4 and part[0] == 0xFF:
            after = position + 2 + int.from_bytes(part[2:], "big")
            if part[1] in _JPEG_FRAMES:
                return head[position:after] if after <= len(head) else None
            if part[1] == _JPEG_EXIF:
                return None
            position = after
    return None


_PGM = re.compile(rb"P[25](?:\s|#.*\n)+\d+(?:\s|#.*\n)+\d+(?:\s|#.*\n)+(\d{1,5})\s")


def pgm_maxval(data: np.ndarray) -> int | None:
    """The value that a PGM states as white; None if it is the largest of its type, and for other
    files."""
    header = _PGM.match(data[:1000].tobytes())
    return int(header[1]) if header and int(header[1]) not in (0, 255, 65535) else None


_ONE = "one image a file is read"
_TIFFS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# Of any type, and rotated by EXIF data as viewers and annotation tools show it. A TIFF is rotated
# in any case, and one of four channels of floats can only be read unchanged.
_AS_SHOWN = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR


_NPY = b"\x93NUMPY"


def _array(data: np.ndarray) -> np.ndarray:
    """The pixels in an array of NumPy. Raises UnusableError if it is damaged or of another kind."""
    try:
        pixels = np.asarray(np.load(io.BytesIO(data.tobytes()), allow_pickle=False))
    except Exception:  # it raises errors of many classes
        raise UnusableError("a damaged array of NumPy, or one of objects") from None
    if pixels.ndim == 3:
        pixels = pixels.squeeze(tuple(axis for axis in (0, 2) if pixels.shape[axis] == 1))
    if pixels.ndim != 2 or pixels.dtype.kind not in "uif" or pixels.size > _MOST_PIXELS:
        what = f"an array of {pixels.dtype}, shape {pixels.shape}"
        raise UnusableError(f"{what}; two dimensions of numbers are read")
    if pixels.dtype.kind == "f":
        return pixels.astype(np.float64 if pixels.itemsize > 4 else np.float32)
    # NumPy's own type of integers is wide, whatever they are: those of a picture are not.
    low, high = (int(f(initial=0)) for f in (pixels.min, pixels.max))
    fits = (kind for kind in (np.uint8, np.uint16) if low >= 0 and high <= np.iinfo(kind).max)
    narrow = next(fits, pixels.dtype) if pixels.itemsize > 2 else pixels.dtype
    return pixels.astype(np.float32 if low < 0 else narrow)


def _is_misread_tiff(data: bytes, image: np.ndarray) -> bool:
    """Whether OpenCV does not read a TIFF of other than 8 bits right, by the tags in it."""
    order, count = "<" if data[:1] == b"I" else ">", "Q" if b"+" in data[2:4] else "I"
    white_is_zero, in_planes = (
        any(
            struct.pack(f"{order}HH{count}{form}", tag, kind, 1, value) in data
            for kind, form in ((3, "H"), (4, "I"))
        )
        for tag, value in ((262, 0), (284, 2))
    )
    is_negative = image.dtype.kind == "i" and image.min() < 0
    return bool(white_is_zero or is_negative or (in_planes and image.ndim > 2))


def decode_image(data: bytes | memoryview | np.ndarray) -> np.ndarray:
    """The pixels of an image file in memory (PNG, JPEG, TIFF, BMP, PGM, ...), as viewers show it.
    Raises UnusableError if OpenCV cannot read it whole and right, if its header states too many
    pixels, or if it holds several images."""
    buffer = np.frombuffer(data, np.uint8)
    if not buffer.size:
        raise UnusableError("empty image")
    if buffer[: len(_PNG)].tobytes() == _PNG:
        chunks = _png_chunks(buffer.data)
        if chunks is None:
            raise UnusableError("unreadable image")
        if b"acTL" in chunks:
            raise UnusableError(f"an animated PNG; {_ONE}")
        if not chunks & _ROTATED_OR_TRANSPARENT and (plain := _plain_png(buffer.data)) is not None:
            return plain
    if buffer[: len(_NPY)].tobytes() == _NPY:
        return _array(buffer)
    if what := something_else(buffer[:32].tobytes()):
        raise UnusableError(what)
    if buffer[8:16].tobytes() == b"WEBPVP8X" and buffer[20] & 2:
        raise UnusableError(f"an animated WebP; {_ONE}")
    if buffer[:4].tobytes() == b"GIF8":  # OpenCV would take the first of its images
        raise UnusableError("a GIF, which is not read; convert it, as to PNG")
    is_tiff, several = buffer[:4].tobytes() in _TIFFS, False
    flags = cv2.IMREAD_UNCHANGED if is_tiff else _AS_SHOWN
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with warnings_to(captured := warnings_file()):
            image = cv2.imdecode(buffer, flags)
            if is_tiff:
                several = cv2.imdecodemulti(buffer, cv2.IMREAD_REDUCED_GRAYSCALE_8, range=(1, 2))[0]
    except cv2.error as error:
        if "CV_IO_MAX_IMAGE" in str(error):  # see sonarrec/__init__.py
            raise UnusableError("an image of more than 4096 x 4096 pixels") from None
        raise UnusableError("unreadable image") from None
    if image is None:
        raise UnusableError("unreadable image")
    if several:
        raise UnusableError(f"a TIFF of several images; {_ONE}")
    if is_tiff and image.dtype != np.uint8 and _is_misread_tiff(buffer.tobytes(), image):
        raise UnusableError(
            f"a TIFF of {image.dtype} with negative pixels, white as zero or colours in planes, "
            "which is not read; convert it, as to PNG"
        )
    is_jpeg = buffer[:2].tobytes() == _JPEG
    if (warning := written(captured)) and is_jpeg and _jpeg_is_damaged(buffer, warning):
        raise UnusableError("a JPEG that is damaged inside")
    return np.asarray(image)


# Type of a sample without byte order, channels, and whether red is the first.
_RAW_ENCODINGS: dict[str, tuple[str, int, bool]] = {
    **dict.fromkeys(("mono8", "8UC1"), ("u1", 1, False)),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", 1, False)),
    **{"32FC1": ("f4", 1, False), "64FC1": ("f8", 1, False)},
    **dict.fromkeys(("8UC3", "bgr8"), ("u1", 3, False)),
    **dict.fromkeys(("8UC4", "bgra8"), ("u1", 4, False)),
    **{"rgb8": ("u1", 3, True), "rgba8": ("u1", 4, True)},
}


def raw_pixels(
    data: memoryview, height: int, width: int, encoding: str, step: int, big_endian: bool
) -> np.ndarray:
    """The pixels of an uncompressed image message, without a copy if they are in BGR order. step:
    bytes from row to row. Some drivers state it wrongly: it is ignored if it does not fit the
    length of the data but rows without padding do. Raises UnusableError if the numbers do not fit
    together or the encoding is unknown."""
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
    # With a single row the step may be anything.
    strides = min(step, len(data)), channels * dtype.itemsize, dtype.itemsize
    pixels: np.ndarray = np.ndarray((height, width, channels), dtype, data, strides=strides)
    if red_first:
        pixels = pixels[:, :, [2, 1, 0, 3][:channels]]
    return pixels[:, :, 0] if channels == 1 else pixels
