"""Blueprint Subsea's Oculus sonars: pings as the sonar sends them, or in `.oculus` logs.

All numbers are little-endian and packed. The layouts are known from free drivers and readers; the
maker has published no description. The drivers' messages in recordings hold the same samples
(`messages/types.py`).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.raw import (
    MAX_FRAME_BYTES,
    Decoded,
    FileBytes,
    HeaderInfo,
    PingGeometry,
    RawLog,
    StoredFrame,
    UnusableError,
    frame_of,
    ping_geometry,
)


def oculus_geometry(
    hundredths: FloatArray, resolution_m: float, bins: int, beams: int
) -> PingGeometry:
    """The geometry of a ping whose bins are `resolution_m` long and begin at the sonar. hundredths:
    (beams,) bearings in hundredths of a degree. Raises UnusableError if the numbers are
    impossible."""
    if len(hundredths) != beams:
        raise UnusableError(f"{beams} beams with {len(hundredths)} bearings")
    if not 0 < resolution_m < math.inf:
        raise UnusableError(f"range resolution {resolution_m:g} m")
    ranges = (np.arange(bins) + 0.5) * resolution_m
    # The pixels come as the rows of an image, so their order is known.
    return replace(ping_geometry(ranges, hundredths / 100), beam_order="range-major")


def oculus_samples(
    data: bytes | memoryview, bins: int, beams: int, size: int, *, gains: bool, step: int = 0
) -> np.ndarray:
    """The (bins, beams) samples of a ping, unsigned integers of `size` bytes. step: bytes from row
    to row; those beyond a row's own are skipped. gains: whether each row begins with its gain, 4
    bytes; then its samples are divided by the gain's root, as float32. Raises UnusableError if the
    numbers do not fit the data."""
    if size not in (1, 2, 4):
        raise UnusableError(f"samples of {size} bytes")
    head = 4 if gains else 0
    row = head + beams * size
    step = max(step, row)
    if not bins or not beams or len(data) != bins * step:
        raise UnusableError(f"{beams} beams of {bins} samples do not fit {len(data)} bytes")
    rows = np.frombuffer(data, np.uint8).reshape(bins, step)
    pixels = np.ascontiguousarray(rows[:, head:row]).view(f"<u{size}")
    if head:
        gain = np.ascontiguousarray(rows[:, :head]).view("<u4")
        pixels = (pixels / np.sqrt(np.maximum(gain, 1))).astype(np.float32)
    return pixels


Header = dict[str, Any]
"""What a ping says about the sonar, by name and unit; None if the sonar did not measure it."""

_HEAD = [
    ("id", "<u2"), ("source", "<u2"), ("target", "<u2"), ("message", "<u2"), ("version", "<u2"),
    ("payload", "<u4"), ("part", "<u2"),
]  # fmt: skip
_FIRE = [  # what the sonar was asked for
    ("mode", "u1"), ("rate", "u1"), ("network", "u1"), ("gamma", "u1"), ("flags", "u1"),
    ("range", "<f8"), ("gain", "<f8"), ("sound_speed_asked", "<f8"), ("salinity", "<f8"),
]  # fmt: skip
_WATER = [
    ("ping", "<u4"), ("status", "<u4"), ("frequency", "<f8"), ("temperature", "<f8"),
    ("pressure", "<f8"),
]  # fmt: skip
_IMAGE = [("data_size", "u1"), ("resolution", "<f8"), ("ranges", "<u2"), ("beams", "<u2")]
_POSITION = [("offset", "<u4"), ("size", "<u4"), ("total", "<u4")]
_HEAD_TYPE = np.dtype(_HEAD)  # how every message begins
# In the first version the start of a ping is a count of unknown unit; the second adds the sonar's
# attitude, and counts seconds since it was switched on.
_RESULT = np.dtype(
    [*_HEAD, *_FIRE, *_WATER, ("sound_speed", "<f8"), ("count", "<u4"), *_IMAGE, *_POSITION]
)
_RESULT_2 = np.dtype(
    [
        *_HEAD, *_FIRE, ("more_flags", "<u4"), ("reserved", "V32"), *_WATER,
        ("heading", "<f8"), ("pitch", "<f8"), ("roll", "<f8"), ("sound_speed", "<f8"),
        ("start", "<f8"), *_IMAGE, ("spare", "V16"), *_POSITION,
    ]
)  # fmt: skip
_LAYOUTS = {0: _RESULT, 1: _RESULT, 2: _RESULT_2}
"""Of a simple ping, by version; sonars of the first version send 0 too."""
_FULL_PING, _SIMPLE_PING = 0x22, 0x23
_KNOWN_MESSAGES = (0x15, _FULL_PING, _SIMPLE_PING, 0x55, 0x80, 0xFF)
"""The numbers of all messages; those without a name are fire, settings, logs and dummy."""
_BYTES_OF_SAMPLE = {0: 1, 1: 2, 3: 4}
_MESSAGE_MARK = b"SO"


def decoded(message: bytes) -> tuple[Decoded, Header]:
    """The ping of a message, OculusSimplePingResult or OculusSimplePingResult2, and its header.
    Raises UnusableError if it cannot be used."""
    version = int(np.frombuffer(message, _HEAD_TYPE, 1)[0]["version"])
    layout = _LAYOUTS.get(version)
    if layout is None:
        raise UnusableError(f"a ping of version {version}, which is not known")
    if len(message) < layout.itemsize:
        raise UnusableError(f"a ping of {len(message)} bytes")
    fields = np.frombuffer(message, layout, 1)[0]
    bins, beams, offset = int(fields["ranges"]), int(fields["beams"]), int(fields["offset"])
    image = message[offset : offset + int(fields["size"])]
    if len(image) != fields["size"] or offset < layout.itemsize + 2 * beams:
        raise UnusableError(f"its image of {fields['size']} bytes from {offset} on lies outside")
    size = _BYTES_OF_SAMPLE.get(int(fields["data_size"]))
    if size is None:
        raise UnusableError(f"unknown sample type {fields['data_size']}")
    gains = len(image) == bins * (beams * size + 4)  # the flag that announces gains may be wrong
    hundredths = np.frombuffer(message, "<i2", beams, layout.itemsize).astype(float)
    with np.errstate(all="ignore"):  # damaged numbers overflow; results are checked
        geometry = oculus_geometry(hundredths, float(fields["resolution"]), bins, beams)
        pixels = oculus_samples(image, bins, beams, size, gains=gains)
    header: Header = {
        "sonar": f"Oculus, device {fields['source']}",
        "mode": {1: "low frequency", 2: "high frequency"}.get(int(fields["mode"])),
        "frequency_hz": _within(fields["frequency"], 1e4, 1e8),
        "sound_speed_m_s": _within(fields["sound_speed"], 1000, 2000),
        "range_resolution_m": float(fields["resolution"]),
        "range_asked_m": _within(fields["range"], 0, 1000) if fields["flags"] & 1 else None,
        "gain_percent": _within(fields["gain"], 0, 100),
        "gamma": _within(1.0 if fields["gamma"] in (0, 255) else fields["gamma"] / 254, 0, 1),
        "gains_sent": "yes" if gains else "no",
        "temperature_c": _within(fields["temperature"], -5, 60),
        "pressure_bar": _within(fields["pressure"], 1e-3, 1e4),
    }
    stamp_ns = None
    if layout is _RESULT_2:
        header |= {f"{k}_deg": _within(fields[k], -360, 360) for k in ("heading", "pitch", "roll")}
        start_s = _within(fields["start"], 0, 2**33)
        stamp_ns = None if start_s is None else round(start_s * 1e9)
    return Decoded(pixels, stamp_ns, geometry), header


def _within(value: float, low: float, high: float) -> float | None:
    """The value; None out of bounds, which is what happened to be in the sonar's memory."""
    leftover = 0 < abs(value) < 1e-9
    return float(f"{value:.7g}") if low <= value <= high and not leftover else None


# How a raw stream is divided into messages, and a log into items that hold them.
_LOG_MARK, _ITEM_MARK = b"\x44\x33\x22\x11", b"\xdd\xcc\xbb\xaa"
_LOG_HEAD_BYTES = 48
_ITEM = np.dtype(
    {
        "names": ["head", "type", "time", "compression", "original", "payload"],
        "formats": ["<u4", "<u2", "<f8", "<u2", "<u4", "<u4"],
        "offsets": [4, 8, 16, 24, 28, 32],
        "itemsize": 40,
    }
)
_SONAR_ITEM = 10
_Q_COMPRESSED = 1  # by Qt: the inflated size in four bytes, then zlib
_INFLATED_SIZE_BYTES = 4


def _message_of_item(contents: bytes) -> tuple[bytes, int | None]:
    """(the message in an item, b"" if it is of another kind, when it came in ns, None if unknown).
    Raises UnusableError."""
    item = np.frombuffer(contents, _ITEM, 1)[0]
    if item["type"] != _SONAR_ITEM:
        return b"", None
    payload = contents[int(item["head"]) :]
    if item["compression"] == _Q_COMPRESSED:
        declared = int(item["original"])
        if declared > MAX_FRAME_BYTES:
            raise UnusableError(f"it declares {declared} bytes, more than is read")
        try:
            payload = zlib.decompressobj().decompress(payload[_INFLATED_SIZE_BYTES:], declared + 1)
        except zlib.error:
            raise UnusableError("its compressed contents are damaged") from None
        if len(payload) != declared:
            raise UnusableError(f"its contents inflate to another size than {declared} bytes")
    elif item["compression"]:
        raise UnusableError(f"unknown compression {item['compression']}")
    time_s = float(item["time"])
    return payload, round(time_s * 1e9) if 0 <= time_s < 2**33 else None


class OculusPings(RawLog):
    """The pings of a raw stream or of an `.oculus` log, in the order of the file."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if the file holds no ping that can be read."""
        super().__init__(diagnostics, polar=True)
        self._name, self._file = path.name, FileBytes(path)
        self.close = self._file.close
        head = self._file.read(0, _LOG_HEAD_BYTES)
        if head.startswith(b"SQLite format 3\0"):
            raise SonarrecError(
                f"{path}: a log of the second ViewPoint (a database), which is not read; "
                "let ViewPoint export it as an .oculus log of the first"
            )
        self._is_log, self._start = head.startswith(_LOG_MARK), 0
        if self._is_log:
            size, encryption = (int.from_bytes(head[a:b], "little") for a, b in ((4, 8), (26, 28)))
            self._start = size if _LOG_HEAD_BYTES <= size <= 4096 else _LOG_HEAD_BYTES
            if encryption:
                raise SonarrecError(
                    f"{path}: an encrypted log, which is not read; record it without encryption"
                )
        self._mark = _ITEM_MARK if self._is_log else _MESSAGE_MARK
        self.header_info = HeaderInfo(values=self._first_header(path))

    def _first_header(self, path: Path) -> Header:
        """The header of the first ping that can be read."""
        problem = ""
        # Not through all bytes, since the file may be of another kind.
        within = min(self._file.size, 2 * MAX_FRAME_BYTES)
        for _, _, message, reason in self._pings(Diagnostics(""), within):
            if message is not None:
                try:
                    return decoded(message)[1]
                except UnusableError as error:
                    reason = str(error)
            problem = problem or f" ({reason})"
        raise SonarrecError(f"{path}: no ping of an Oculus can be read in it{problem}")

    def __iter__(self) -> Iterator[StoredFrame]:
        for number, (position, time_ns, message, problem) in enumerate(
            self._pings(self.diagnostics, self._file.size)
        ):
            name = f"ping {number} at byte {position}"
            if message is None or number in self.passed_over:
                yield StoredFrame(name, time_ns, problem=problem)
            else:
                yield frame_of(name, time_ns, lambda m: decoded(m)[0], message)

    def _pings(
        self, diagnostics: Diagnostics, limit: int
    ) -> Iterator[tuple[int, int | None, bytes | None, str | None]]:
        """Yield (position, time in ns, message, problem) of each ping; no message if damaged.
        limit: where in the file to stop. diagnostics: receives, after all is read, the number of
        bytes that belong to no message, and of pings in a format that is not read."""
        stray_bytes = stray_gaps = full = 0
        for position, length, complete in self._divided(limit):
            if self._length_at(position) is None:
                stray_bytes += length
                stray_gaps += 1
                continue
            if not complete:
                yield position, None, None, f"only {length} bytes of it are there"
                continue
            contents, time_ns = self._file.read(position, length), None
            try:
                message, time_ns = _message_of_item(contents) if self._is_log else (contents, None)
            except UnusableError as error:
                yield position, None, None, str(error)
                continue
            number = None
            if len(message) >= _HEAD_TYPE.itemsize and message[:2] == _MESSAGE_MARK:
                number = int(np.frombuffer(message, _HEAD_TYPE, 1)[0]["message"])
            full += number == _FULL_PING
            if number == _SIMPLE_PING:
                yield position, time_ns, message, None
        if stray_gaps:
            diagnostics.fault(
                f"{stray_bytes} bytes in {stray_gaps} gaps belong to no message; damaged, so "
                "pings may be missing there, or wrong before them",
                self._name,
            )
        if full:
            diagnostics.fault(
                f"{number_of(full, 'ping')} in the full format, which is not public, cannot be "
                "read; let the sonar send simple results",
                self._name,
            )

    def _divided(self, limit: int) -> Iterator[tuple[int, int, bool]]:
        """Yield (position, length in bytes, whether it is whole) of messages or items up to
        `limit`, and of bytes that belong to none. If one is not followed by another, or by the end,
        and another begins inside it, it has lost bytes."""
        position = self._start
        while position < limit:
            length = self._length_at(position)
            end = limit if length is None else min(position + length, limit)
            complete = length is not None and position + length <= limit
            followed = complete and (end == limit or self._length_at(end) is not None)
            if not followed:
                inside = self._file.find(self._mark, position + 1, end, self._begins)
                complete, end = (complete, end) if inside is None else (False, inside)
            yield position, end - position, complete
            position = end

    def _begins(self, position: int) -> bool:
        return self._length_at(position) is not None

    def _length_at(self, position: int) -> int | None:
        """The length of the message or item that begins there; None if none does."""
        dtype = _ITEM if self._is_log else _HEAD_TYPE
        head = self._file.read(position, dtype.itemsize)
        if len(head) < dtype.itemsize or not head.startswith(self._mark):
            return None
        fields = np.frombuffer(head, dtype, 1)[0]
        if self._is_log:
            length, known = int(fields["head"]), 36 <= fields["head"] <= 4096
        else:
            length, known = dtype.itemsize, fields["message"] in _KNOWN_MESSAGES
        length += int(fields["payload"])
        return length if known and length <= MAX_FRAME_BYTES else None
