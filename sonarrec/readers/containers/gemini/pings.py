"""What an image record of a Gemini means."""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from typing import Any

import numpy as np

from sonarrec.readers.raw import MAX_FRAME_BYTES, Ping, UnusableError, ping_geometry

Header = dict[str, Any]
"""What a record says about the sonar, by name and unit; None for impossible values."""
Fields = list[tuple[str, str]]

_MESSAGE: Fields = [
    ("star", "u1"), ("version", "u1"), ("length", "<u4"), ("time", "<f8"), ("type", "u1"),
    ("device", "<u2"), ("node", "<u2"), ("spare", "<u2"), ("record", "<u2"), ("mark", "<u2"),
]  # fmt: skip
_IMAGE: Fields = [
    ("image_version", "<u2"), ("first_bin", "<u4"), ("end_bin", "<u4"),
    ("range_compression", "<u2"), ("first_beam", "<u4"), ("end_beam", "<u4"),
]  # fmt: skip
_SIZE: Fields = [("size", "<u4")]
HEAD = np.dtype([*_MESSAGE, *_IMAGE, *_SIZE])
"""How an image's record begins, up to its samples, in versions 1 and 2."""
HEAD_3 = np.dtype([*_MESSAGE, *_IMAGE, ("compression", "<u2"), *_SIZE])
"""The same from version 3 on."""
TAIL = np.dtype(
    [
        ("state", "<u4"), ("bins_hz", "<u4"), ("aperture", "<f4"), ("time", "<f8"),
        ("flags", "<u2"), ("sound_speed", "<f4"), ("gain", "<i2"), ("chirp", "u1"),
        ("processing", "u1"), ("model", "u1"), ("zoomed", "u1"), ("end", "<u2"),
    ]
)  # fmt: skip
"""How it ends, after the samples and the bearings."""
_OTHERS = (1, 2, 3, 98, 99)  # types of records: V4, video, status, serial, generic
_STAR, _IMAGE_TYPE, _END_MARK = ord("*"), 0, 0xDEDE
RECORD, RECORD_MARK = 1, 0xEFEF
"""What an image's record begins with, after the head of every message."""
_ZLIB, _PLAIN = 0, 1  # compressions; 2 is H.264
_UPSIDE_DOWN = 0xE000  # bits of `state`
_MOST_BEAMS, _MOST_BINS = 4096, 2**16
_MODELS = {
    1: "720is", 2: "720ik", 3: "720im", 4: "1200ik", 5: "720ik", 6: "720ik", 7: "720ik",
    8: "1200ik", 9: "1200id", 10: "Micron 1200d",
}  # fmt: skip
_EPOCH_S = 315_532_800  # 1980-01-01, in seconds since 1970


def record_length(head: bytes) -> int | None:
    """The length in bytes of an image's record; None if none begins with these bytes.

    head: its first HEAD_3.itemsize bytes.
    """
    fields, beams, bins = _head(head)
    marks = (fields["star"], fields["type"], fields["record"], fields["mark"])
    if marks != (_STAR, _IMAGE_TYPE, RECORD, RECORD_MARK):
        return None
    size = int(fields["size"])
    if not (0 < beams <= _MOST_BEAMS and 0 < bins <= _MOST_BINS and size <= MAX_FRAME_BYTES):
        return None
    return int(fields.dtype.itemsize) + size + 8 * beams + TAIL.itemsize


def device_of(record: bytes) -> int:
    """The number of the sonar that a record comes from."""
    return int(_head(record)[0]["device"])


def time_ns(record: bytes) -> int | None:
    """When a record was logged, ns since 1970; None if its time is impossible."""
    return _since_1970(float(_head(record)[0]["time"]))


def begins(head: bytes) -> bool:
    """Whether a record of any kind begins here, or the mark at the end of all records.

    head: its first HEAD_3.itemsize bytes.
    """
    fields = np.frombuffer(head, HEAD, 1)[0]
    is_other = fields["star"] == _STAR and fields["type"] in _OTHERS
    is_end = head.startswith(_END_MARK.to_bytes(2, "little"))
    return bool(is_other or is_end or record_length(head) is not None)


def ended(record: bytes) -> bool:
    """Whether an image's record has its end mark; if a zoomed image follows, that one has it."""
    return bool(_tail(record)["end"] == _END_MARK) or zoomed(record)


def zoomed(record: bytes) -> bool:
    """Whether a second image, a magnified part of the first, follows before the end mark."""
    return bool(_tail(record)["zoomed"] == 1)


def decoded(record: bytes) -> tuple[Ping, Header]:
    """The ping of a record, and its header. Raises UnusableError if it cannot be used."""
    fields, beams, bins = _head(record)
    at = fields.dtype.itemsize
    samples = _samples(record[at : at + int(fields["size"])], fields, beams * bins)
    table = np.frombuffer(record, "<f8", beams, at + int(fields["size"]))
    tail = _tail(record)
    speed, bins_hz = float(tail["sound_speed"]), int(tail["bins_hz"])
    if not 1000 <= speed <= 2000:
        raise UnusableError(f"a speed of sound of {speed:g} m/s")
    if not bins_hz:
        raise UnusableError("no rate of its range bins")
    upside_down = bool(tail["state"] & _UPSIDE_DOWN)
    # The table is in radians, positive to the left if the sonar is upright.
    bearings = np.degrees(table if upside_down else -table)
    bin_m = speed / 2 / bins_hz
    ranges = (int(fields["first_bin"]) + np.arange(bins) + 0.5) * bin_m
    geometry = replace(ping_geometry(ranges, bearings), beam_order="range-major")
    model = _MODELS.get(int(tail["model"]))
    gain = int(tail["gain"])
    header: Header = {
        "sonar": f"Gemini {model}, device {fields['device']}" if model else
        f"Gemini, device {fields['device']}",
        "mounted": "upside down" if upside_down else "upright",
        "sound_speed_m_s": float(f"{speed:.7g}"),
        "range_resolution_m": float(f"{bin_m:.7g}"),
        "gain_percent": gain if 0 <= gain <= 100 else None,
        "chirp": "yes" if tail["chirp"] else "no",
    }  # fmt: skip
    pixels = np.frombuffer(samples, np.uint8).reshape(bins, beams)
    return Ping(pixels, _since_1970(float(tail["time"])), geometry), header


def _head(record: bytes) -> tuple[Any, int, int]:
    """(fields of a record's head, number of beams, number of bins)."""
    fields = np.frombuffer(record, HEAD, 1)[0]
    if fields["image_version"] >= 3:
        fields = np.frombuffer(record, HEAD_3, 1)[0]
    beams = int(fields["end_beam"]) - int(fields["first_beam"])
    return fields, beams, int(fields["end_bin"]) - int(fields["first_bin"])


def _tail(record: bytes) -> Any:
    return np.frombuffer(record, TAIL, 1, len(record) - TAIL.itemsize)[0]


def _samples(data: bytes, fields: Any, count: int) -> bytes:
    """The `count` samples of a record, range after range. Raises UnusableError."""
    if "compression" in fields.dtype.names:
        compression = int(fields["compression"])
    else:
        compression = _PLAIN if len(data) == count else _ZLIB
    if compression == _ZLIB:
        inflater = zlib.decompressobj()
        try:
            data = inflater.decompress(data, count + 1)
        except zlib.error:
            raise UnusableError("its compressed samples are damaged") from None
    elif compression != _PLAIN:
        raise UnusableError(
            "its samples are compressed as video (H.264), which is not read"
            if compression == 2
            else f"unknown compression {compression}"
        )
    if len(data) != count:
        raise UnusableError(f"{len(data)} samples, not the {count} of its beams and bins")
    return data


def _since_1970(time_s: float) -> int | None:
    """ns since 1970, from seconds since 1980; None if impossible."""
    if not 0 < time_s < 2**32:
        return None
    fraction, whole = math.modf(time_s)
    return (int(whole) + _EPOCH_S) * 10**9 + round(fraction * 1e9)
