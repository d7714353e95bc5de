"""The one place where image bytes become pixels, and pixels the 8-bit grey of recognition.

Recognition expects a logarithmic scale.

| pixels | `pixel_scale` | `full_scale`, which becomes 255 |
|---|---|---|
| 8 bit | linear: sonars compress before they store so few bits; but log where the speckle of the
  first frames is that of amplitudes (`holds_amplitudes`) | 255; log: by the first frame |
| 16 bit | linear, but log where the first frame would be next to black, or where the speckle is
  that of amplitudes | 65535; log: by the first frame |
| floating-point images within 0 to 1 | linear | 1 |
| floating-point, some negative | db: decibels | by the first frame |
| 32 and 64 bit, all other floating-point | log: echo amplitudes | by the first frame |

`linear` is 255 v / full_scale, `log` 255 (1 + 20 log10(v / full_scale) / dynamic_range_db), `db`
255 (1 + (v - full_scale) / dynamic_range_db), each cut to 0 to 255. These are the defaults; keys of
the geometry state others. The full scale of log and db is such that the median of the first frame's
echoes, floor speckle whatever bright things lie on it, comes to a third of the range. Later frames
never enter.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, BinaryIO, Literal

import cv2
import numpy as np

from sonarrec.readers.raw import UnusableError
from sonarrec.records import ByteImage, SonarrecError
from sonarrec.sonar import Sonar

DYNAMIC_RANGE_DB = 50.0
_MEDIAN_AT = 1 / 3  # where floor speckle lies in the range: high enough for shadows to show
_NEXT_TO_BLACK = 1 / 32  # of full scale: no compressed image has its median below

# Of `holds_amplitudes`: rows and columns of a block, what makes one of use, and from where slope
# and skew together tell amplitudes. In the simulator's pictures (77 of tuning and model seeds) they
# come to .94 at most as logarithms, as amplitudes to 1.05 or more in 95 of 100: not where a floor
# in relief has no speckle.
_BLOCK = (16, 4)
_MOST_BLACK, _LEAST_LEVEL, _LEAST_SPREAD, _LEAST_BLOCKS = 0.2, 4.0, 0.5, 50
_DIM, _LEAST_SPECKLE = 1 / 8, 0.2  # of full scale; spread over level
_LEAST_RANGE = 0.12  # standard deviation of the logarithm of levels
_AMPLITUDES = 1.0

Scale = Literal["linear", "log", "db"]


@dataclass(frozen=True, slots=True)
class GreyScale:
    """How the pixels of one log become grey; see the module. bounded: finite pixels below 0 or
    above full_scale are a fault rather than black or white."""

    pixel_scale: Scale
    full_scale: float
    dynamic_range_db: float
    bounded: bool = False

    def as_table(self) -> dict[str, Any]:
        """The keys of the geometry that would state this scale."""
        table = {"pixel_scale": self.pixel_scale, "full_scale": self.full_scale}
        linear = self.pixel_scale == "linear"
        return table if linear else table | {"dynamic_range_db": self.dynamic_range_db}


def single_channel(pixels: np.ndarray) -> np.ndarray:
    """(rows, columns) in this machine's byte order, of pixels as a Ping holds them.

    Colour becomes grey by OpenCV's weights (.299 R + .587 G + .114 B; alpha is left out).
    Raises UnusableError for other pixels.
    """
    if pixels.dtype.kind not in "uif" or pixels.dtype == np.float16:
        raise UnusableError(f"{pixels.dtype} pixels are not supported")
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.float64:
        with np.errstate(over="ignore"):  # beyond 32 bits is infinite, hence white
            pixels = pixels.astype(np.float32)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    if pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        if pixels.dtype not in (np.uint8, np.uint16, np.float32):
            raise UnusableError(f"{pixels.dtype} colour pixels are not supported")
        code = cv2.COLOR_BGR2GRAY if pixels.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        pixels = cv2.cvtColor(np.ascontiguousarray(pixels), code)
    if pixels.ndim != 2 or not pixels.size:
        raise UnusableError(f"an image of shape {pixels.shape} is not supported")
    return np.asarray(pixels)


def grey_scale(sonar: Sonar, pixels: np.ndarray, amplitudes: bool) -> GreyScale | None:
    """The scale of a log by its first frame, as far as `sonar` does not state it.

    pixels: of single_channel. amplitudes: they are echo amplitudes, of floating point whatever
    their size. None where the frame is blank, and so black on any scale.
    Raises SonarrecError for a full scale that cannot be meant.
    """
    values = pixels[np.isfinite(pixels)]
    if not values.any():
        return None
    floating = pixels.dtype.kind == "f"
    unit = floating and not amplitudes and values.min() >= 0 and values.max() <= 1
    largest = 1.0 if unit else None
    if not floating and pixels.itemsize <= 2:
        largest = float(np.iinfo(pixels.dtype).max)
    scale = sonar.pixel_scale or _usual_scale(values, largest)
    if sonar.pixel_scale is None and amplitudes and not floating:
        scale = "log"
    span = sonar.dynamic_range_db or DYNAMIC_RANGE_DB
    if sonar.full_scale is not None:
        if sonar.full_scale <= 0 and scale != "db":
            raise SonarrecError(
                f"full_scale = {sonar.full_scale:g} must be above 0 ({scale} scale)"
            )
        return GreyScale(scale, sonar.full_scale, span)
    if scale == "linear":
        full = float(values.max()) if largest is None else largest
        return GreyScale(scale, full, span, bounded=unit)
    above = (1 - _MEDIAN_AT) * span
    if scale == "db":
        return GreyScale(scale, float(np.median(values)) + above, span)
    echoes = values[values > 0]
    if not echoes.size:
        return None
    return GreyScale(scale, float(np.median(echoes) * 10 ** (above / 20)), span)


def _usual_scale(values: np.ndarray, largest: float | None) -> Scale:
    """The default for finite values of a type whose full scale is `largest`, None if unknown."""
    if largest is None:
        return "db" if values.dtype.kind == "f" and values.min() < 0 else "log"
    return "log" if values.itemsize == 2 and next_to_black(values) else "linear"


def _middle(values: np.ndarray) -> float:
    return float(np.median(values[values != 0]))


def next_to_black(pixels: np.ndarray) -> bool:
    """Whether 16-bit integers, not all 0, are so dark that they are read as log for that."""
    return _middle(pixels) < _NEXT_TO_BLACK * np.iinfo(pixels.dtype).max


def dim_level(pixels: np.ndarray) -> str | None:
    """How dim 16-bit integers, not all 0, would be as linear grey; None where they are not."""
    middle, full = _middle(pixels), np.iinfo(pixels.dtype).max
    return f"median {middle:.0f} of {full}" if middle < _DIM * full else None


def holds_amplitudes(images: Sequence[np.ndarray]) -> bool:
    """Whether images of integers hold echo amplitudes rather than their logarithm, by speckle.

    images: of single_channel, all of 8 or all of 16 bits; of the latter none next to black. In
    amplitudes speckle spreads in proportion to its level, and its peaks reach farther than its
    troughs; in logarithms it spreads evenly, and its troughs reach farther. So dim an 8-bit picture
    that what lies far is next to black is taken for amplitudes as well: if it is none, little is
    lost. Measured in small blocks; False where too few show speckle.
    """
    rows, columns = _BLOCK
    # 16 bits hold far more steps than their content may fill: its brightest pixel is its white.
    deep = bool(images) and images[0].dtype != np.uint8
    white = np.float32(max(image.max() for image in images) if deep else 255)
    parts = [np.empty((0, rows * columns), np.float32)]
    for image in images:
        down, across = image.shape[0] // rows, image.shape[1] // columns
        blocks = image[: down * rows, : across * columns].reshape(down, rows, across, columns)
        block = blocks.swapaxes(1, 2).reshape(-1, rows * columns).astype(np.float32)
        parts.append(block * 255 / white if deep else block)
    block = np.concatenate(parts)
    level, spread = block.mean(axis=1), block.std(axis=1)
    # Black has no speckle, and what is cut off at either end has another.
    whole = ((block == 0).mean(axis=1) < _MOST_BLACK) & (block.max(axis=1) < 255)
    whole &= (level > _LEAST_LEVEL) & (spread > _LEAST_SPREAD)
    if np.count_nonzero(whole) < _LEAST_BLOCKS:
        return False
    block, level, spread = block[whole], level[whole], spread[whole]
    dim = not deep and np.median(level) < _DIM * 256
    if dim and np.median(spread / level) > _LEAST_SPECKLE:
        return True
    if np.log(level).std() < _LEAST_RANGE:  # at one level a spread tells nothing
        return False
    slope = np.polyfit(np.log(level), np.log(spread), 1)[0]  # 1 of amplitudes, 0 of logarithms
    off = (block - level[:, None]) / spread[:, None]
    skew = np.median((off * off * off).mean(axis=1))  # a power takes twenty times as long
    return bool(slope + skew > _AMPLITUDES)


def to_grey8(pixels: np.ndarray, scale: GreyScale) -> ByteImage:
    """(rows, columns) uint8 of the pixels of single_channel; NaN (no data) becomes 0.

    Raises UnusableError where pixels are out of bounds.
    """
    full = scale.full_scale
    if scale.pixel_scale == "linear":
        if pixels.dtype == np.uint8 and full == 255:
            return np.ascontiguousarray(pixels)
        if pixels.dtype == np.uint16:
            return _rounded(np.ascontiguousarray(pixels), 255 / full)
    values = np.nan_to_num(pixels.astype(np.float32), nan=0.0, posinf=np.inf, neginf=-np.inf)
    # Infinities are no fault, as `grey_scale` settles on what is finite.
    if scale.bounded and (((values < 0) | (values > full)) & np.isfinite(values)).any():
        raise UnusableError(
            f"floating-point pixels must lie in 0 to {full:g}, as in the first frame"
        )
    if scale.pixel_scale == "log":
        decibels = np.log10(np.maximum(values, np.finfo(np.float32).tiny)) * np.float32(20)
        values = decibels - np.float32(20 * np.log10(full)) + np.float32(scale.dynamic_range_db)
    elif scale.pixel_scale == "db":
        no_data = np.isnan(pixels)
        values = values - np.float32(full - scale.dynamic_range_db)
        values[no_data] = 0
    white = full if scale.pixel_scale == "linear" else scale.dynamic_range_db
    return _rounded(np.clip(values, 0, np.float32(white)), 255 / white)


def _rounded(values: np.ndarray, factor: float) -> ByteImage:
    return np.asarray(cv2.convertScaleAbs(values, alpha=factor), np.uint8)


@contextlib.contextmanager
def _stderr_to(file: int) -> Iterator[None]:
    """Sends file descriptor 2 to another: decoders write there past every logging setting."""
    if file == 2:  # stderr was closed when the other was opened
        yield
        return
    try:
        kept = os.dup(2)
    except OSError:  # it is closed
        kept = None
    try:
        os.dup2(file, 2)
        yield
    finally:
        if kept is None:
            os.close(2)
        else:
            os.dup2(kept, 2)
            os.close(kept)


@cache
def _heard() -> BinaryIO:
    """Where the decoders' warnings go."""
    return tempfile.TemporaryFile(prefix="sonarrec_", buffering=0)


_JPEG = b"\xff\xd8"
_EXTRA = re.compile(rb"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")


def _jpeg_is_damaged(data: np.ndarray, warning: bytes) -> bool:
    """Whether the decoder of a JPEG met damage, by its warning.

    libjpeg gives an image all the same. Zeros before the end marker are padding: some cameras
    write them.
    """
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


_TIFFS = {
    # first bytes: byte order, where the first directory's offset lies, the types of an offset and
    # of a directory's length, the bytes of an entry
    b"II*\0": ("<", 4, "I", "H", 12),
    b"MM\0*": (">", 4, "I", "H", 12),
    b"II+\0": ("<", 8, "Q", "Q", 20),
    b"MM\0+": (">", 8, "Q", "Q", 20),
}
_SUBFILE_TYPE, _PART_OF_ANOTHER = 254, 0b101  # bits: a smaller copy of another image, its mask


def _tiff_holds_several(data: memoryview) -> bool:
    """Whether this is a TIFF of several images, without smaller copies of one and its mask."""
    if data[:4].tobytes() not in _TIFFS:
        return False
    order, at, offset, length, entry_bytes = _TIFFS[data[:4].tobytes()]
    images, met = 0, set[int]()
    with contextlib.suppress(struct.error, OverflowError):  # cut short, or led beyond memory
        (at,) = struct.unpack_from(order + offset, data, at)
        while at and at not in met:
            met.add(at)
            (entries,) = struct.unpack_from(order + length, data, at)
            at += struct.calcsize(order + length)
            # Entries are in the order of their tags, of which this is the lowest.
            tag, _, _, value = struct.unpack_from(f"{order}HH{offset}I", data, at)
            images += not (tag == _SUBFILE_TYPE and value & _PART_OF_ANOTHER)
            if images > 1:
                return True
            (at,) = struct.unpack_from(order + offset, data, at + entries * entry_bytes)
    return False


def decode_image(data: bytes | memoryview | np.ndarray) -> np.ndarray:
    """The pixels of an image file in memory (PNG, JPEG, TIFF, BMP, PGM, ...), as stored.

    Raises UnusableError where OpenCV cannot read it whole, its header states too many pixels, or
    it is a TIFF of several images.
    """
    buffer = np.frombuffer(data, np.uint8)
    if not buffer.size:
        raise UnusableError("empty image")
    if not _png_is_whole(buffer.data):
        raise UnusableError("unreadable image")
    if _tiff_holds_several(buffer.data):
        raise UnusableError("a TIFF of several images; one image a file is read")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        heard = _heard()
        with _stderr_to(heard.fileno()):
            image = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
        warning = b""
        if heard.tell():
            heard.seek(0)
            warning = heard.read(4096)
            heard.seek(0)
            heard.truncate()
    except cv2.error as error:
        if "CV_IO_MAX_IMAGE" in str(error):  # see sonarrec/__init__.py
            raise UnusableError("an image of more than 4096 x 4096 pixels") from None
        image = None
    if image is None:
        raise UnusableError("unreadable image")
    if buffer[:2].tobytes() == _JPEG and _jpeg_is_damaged(buffer, warning):
        raise UnusableError("a JPEG that is damaged inside")
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
    step = min(step, len(data))  # of a single row it may be anything
    pixels: np.ndarray = np.ndarray(
        (height, width, channels),
        dtype,
        buffer=data,
        strides=(step, channels * dtype.itemsize, dtype.itemsize),
    )
    if red_first:
        pixels = pixels[:, :, [2, 1, 0, 3][:channels]]
    return pixels[:, :, 0] if channels == 1 else pixels
