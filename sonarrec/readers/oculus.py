"""Reads pings of Blueprint Subsea's Oculus sonars: as the sonar sends them, or in `.oculus` logs.

A further message is one function, from its bytes to a Ping and its header, and one row in MESSAGES.
All numbers are little-endian and packed. The layouts are public through free drivers and readers;
no description by the maker is.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.readers.file_bytes import FileBytes
from sonarrec.readers.raw import (
    MAX_FRAME_BYTES,
    HeaderInfo,
    Ping,
    RawFrame,
    RawLog,
    UnusableError,
    ping_geometry,
)
from sonarrec.records import FloatArray, SonarrecError, Stamps, number_of, shown
from sonarrec.sonar import PingGeometry

Header = dict[str, Any]
Fields = list[tuple[str, str]]

# What pings hold; the MCAP messages of its drivers hold the same.


def oculus_geometry(
    hundredths: FloatArray, resolution_m: float, bins: int, beams: int
) -> PingGeometry:
    """Bearings in hundredths of a degree; bins of one length from the sonar on."""
    if len(hundredths) != beams:
        raise UnusableError(f"{beams} beams with {len(hundredths)} bearings")
    if not 0 < resolution_m < math.inf:
        raise UnusableError(f"range resolution {resolution_m:g} m")
    ranges = (np.arange(bins) + 0.5) * resolution_m
    # Rows of an image: which axis is which need not be found out.
    return replace(ping_geometry(ranges, hundredths / 100), beam_order="range-major")


def oculus_samples(
    data: bytes | memoryview, bins: int, beams: int, size: int, *, gains: bool, step: int = 0
) -> np.ndarray:
    """(bins, beams) samples of `size` bytes; step: bytes from row to row, at least a row's own.

    gains: each row begins with a gain of 4 bytes, by whose root it is divided (float32 then).
    Raises UnusableError where the numbers do not fit the data.
    """
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


# What each message means

_HEAD: Fields = [
    ("id", "<u2"), ("source", "<u2"), ("target", "<u2"), ("message", "<u2"), ("version", "<u2"),
    ("payload", "<u4"), ("part", "<u2"),
]  # fmt: skip
_FIRE: Fields = [  # what the sonar was asked for
    ("mode", "u1"), ("rate", "u1"), ("network", "u1"), ("gamma", "u1"), ("flags", "u1"),
    ("range", "<f8"), ("gain", "<f8"), ("sound_speed_asked", "<f8"), ("salinity", "<f8"),
]  # fmt: skip
_WATER: Fields = [
    ("ping", "<u4"), ("status", "<u4"), ("frequency", "<f8"), ("temperature", "<f8"),
    ("pressure", "<f8"),
]  # fmt: skip
_IMAGE: Fields = [("data_size", "u1"), ("resolution", "<f8"), ("ranges", "<u2"), ("beams", "<u2")]
_PLACE: Fields = [("offset", "<u4"), ("size", "<u4"), ("total", "<u4")]
# The start of a ping of the first version is a count of unknown unit.
_RESULT = np.dtype(
    [*_HEAD, *_FIRE, *_WATER, ("sound_speed", "<f8"), ("start", "<u4"), *_IMAGE, *_PLACE]
)
_RESULT_2 = np.dtype(
    [
        *_HEAD, *_FIRE, ("more_flags", "<u4"), ("reserved", "<u4", (8,)), *_WATER,
        ("heading", "<f8"), ("pitch", "<f8"), ("roll", "<f8"), ("sound_speed", "<f8"),
        ("start", "<f8"), *_IMAGE, ("spare", "<u4", (4,)), *_PLACE,
    ]
)  # fmt: skip
_HEAD_TYPE = np.dtype(_HEAD)
_ID = b"SO"
_KNOWN_MESSAGES = (0x15, 0x22, 0x23, 0x55, 0x80, 0xFF)  # fire, pings, settings, logs, nothing
_FULL_PING = 0x22
_BYTES_OF_SAMPLE = {0: 1, 1: 2, 3: 4}


def read_simple_ping(message: bytes) -> tuple[Ping, Header]:
    """OculusSimplePingResult, the first version: without a time."""
    return _ping(message, _RESULT)


def read_simple_ping_2(message: bytes) -> tuple[Ping, Header]:
    """OculusSimplePingResult2: with heading, pitch, roll, and seconds since switched on."""
    ping, header = _ping(message, _RESULT_2)
    fields = np.frombuffer(message, _RESULT_2, 1)[0]
    for key in ("heading", "pitch", "roll"):
        header[f"{key}_deg"] = _within(fields[key], -360, 360)
    start = _within(fields["start"], 0, 2**33)
    stamp = None if start is None else round(start * 1e9)
    return replace(ping, stamp_ns=stamp), header


MESSAGES: dict[tuple[int, int], Callable[[bytes], tuple[Ping, Header]]] = {
    (0x23, 0): read_simple_ping,  # as the first version's sonars send it
    (0x23, 1): read_simple_ping,
    (0x23, 2): read_simple_ping_2,
}
"""By message number and version."""


def _ping(message: bytes, layout: np.dtype[Any]) -> tuple[Ping, Header]:
    """What both versions hold alike."""
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
    gains = len(image) == bins * (beams * size + 4)  # the flag that announces them may be wrong
    hundredths = np.frombuffer(message, "<i2", beams, layout.itemsize).astype(float)
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
    return Ping(pixels, sonar=geometry), header


def _within(value: float, low: float, high: float) -> float | None:
    """The number, None where it cannot be one: sonars send what lay in memory there."""
    in_memory = 0 < abs(value) < 1e-9
    return float(f"{value:.7g}") if low <= value <= high and not in_memory else None


# How messages follow each other


@dataclass(frozen=True, slots=True)
class _Framing:
    """How to tell where a message begins and ends. length: of its first `head` bytes, None where
    they begin none."""

    mark: bytes
    head: int
    length: Callable[[bytes], int | None]


def _message_length(head: bytes) -> int | None:
    if len(head) < _HEAD_TYPE.itemsize or head[:2] != _ID:
        return None
    fields = np.frombuffer(head, _HEAD_TYPE, 1)[0]
    length = _HEAD_TYPE.itemsize + int(fields["payload"])
    return length if fields["message"] in _KNOWN_MESSAGES and length <= MAX_FRAME_BYTES else None


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
_LOOKED_THROUGH = 2 * MAX_FRAME_BYTES  # for the first ping, in a file that may be of another kind
_Q_COMPRESSED = 1  # of Qt: the length in four bytes, most significant first, then zlib


def _item_length(head: bytes) -> int | None:
    if len(head) < _ITEM.itemsize or head[:4] != _ITEM_MARK:
        return None
    fields = np.frombuffer(head, _ITEM, 1)[0]
    length = int(fields["head"]) + int(fields["payload"])
    return length if 36 <= fields["head"] <= 4096 and length <= MAX_FRAME_BYTES else None


_STREAM = _Framing(_ID, _HEAD_TYPE.itemsize, _message_length)
_LOG = _Framing(_ITEM_MARK, _ITEM.itemsize, _item_length)


def _next(file: FileBytes, framing: _Framing, start: int, end: int) -> int | None:
    """Where the next message begins at `start` or later and before `end`."""
    place = file.find(framing.mark, start, end)
    while place is not None and framing.length(file.at(place, framing.head)) is None:
        place = file.find(framing.mark, place + 1, end)
    return place


def _messages(
    file: FileBytes, framing: _Framing, start: int, limit: int
) -> Iterator[tuple[int, int, bool]]:
    """(where, how many bytes, whole) of each message from `start` to `limit`, and of what is lost.

    A message that is not followed by another, or by the end, has lost bytes if another begins
    inside of it.
    """
    at = start
    while at < limit:
        length = framing.length(file.at(at, framing.head))
        end = limit if length is None else min(at + length, limit)
        whole = length is not None and at + length <= limit
        followed = whole and (
            end == limit or framing.length(file.at(end, framing.head)) is not None
        )
        if not followed:
            inside = _next(file, framing, at + 1, end)
            if inside is not None:
                whole, end = False, inside
        yield at, end - at, whole
        at = end


class OculusPings(RawLog):
    """The pings of a raw stream or of an `.oculus` log, in the order of the file."""

    def __init__(self, path: Path) -> None:
        """Raises SonarrecError where the file holds no ping that can be read."""
        super().__init__()
        self.polar = True
        self._name = shown(path.name)
        self._file = FileBytes(path)
        try:
            self._framing, self._start = self._framed(shown(path))
            self.header_info = HeaderInfo(values=self._first_header(shown(path)))
        except BaseException:
            self._file.close()
            raise

    def _framed(self, where: str) -> tuple[_Framing, int]:
        """How the file's messages follow each other, and where the first may begin."""
        head = self._file.at(0, _LOG_HEAD_BYTES)
        if head.startswith(b"SQLite format 3\0"):
            raise SonarrecError(
                f"{where}: a log of the second ViewPoint (a database), which is not read; "
                "let ViewPoint export it as .oculus of the first"
            )
        if not head.startswith(_LOG_MARK):
            return _STREAM, 0
        size, encryption = (int.from_bytes(head[a:b], "little") for a, b in ((4, 8), (26, 28)))
        if encryption:
            raise SonarrecError(f"{where}: an encrypted log, which is not read; record it openly")
        return _LOG, size if _LOG_HEAD_BYTES <= size <= 4096 else _LOG_HEAD_BYTES

    def _first_header(self, where: str) -> Header:
        problem = ""
        for _, _, message, reason in self._read([], min(self._file.size, _LOOKED_THROUGH)):
            if message is not None:
                try:
                    return _decoded(message)[1]
                except UnusableError as error:
                    reason = str(error)
            problem = problem or f" ({reason})"
        raise SonarrecError(f"{where}: no ping of an Oculus can be read in it{problem}")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __iter__(self) -> Iterator[RawFrame]:
        for number, (at, time_ns, message, problem) in enumerate(
            self._read(self.faults, self._file.size)
        ):
            name = f"ping {number} at byte {at}"
            if message is None or number in self.passed_over:
                yield RawFrame(name, time_ns, None, problem or None)
                continue
            try:
                ping, _ = _decoded(message)
            except UnusableError as error:
                yield RawFrame(name, time_ns, None, str(error))
                continue
            stamps = Stamps(time_ns, None, ping.stamp_ns)
            named = ping.stamp_ns if time_ns is None else time_ns
            yield RawFrame(name, named, ping.pixels, None, ping.sonar, stamps)

    def _read(
        self, faults: list[str], limit: int
    ) -> Iterator[tuple[int, int | None, bytes | None, str]]:
        """(where, time in ns, bytes, problem) of every ping; without bytes where it is damaged.

        limit: where in the file to stop. faults: is given a line for what belongs to no ping, once
        all was read.
        """
        passed_over = places = full = 0
        for at, length, whole in _messages(self._file, self._framing, self._start, limit):
            if self._framing.length(self._file.at(at, self._framing.head)) is None:
                passed_over += length
                places += 1
                continue
            if not whole:
                yield at, None, None, f"only {length} bytes of it are there"
                continue
            try:
                message, time_ns = self._message(at, length)
            except UnusableError as error:
                yield at, None, None, str(error)
                continue
            kind = _kind(message)
            full += kind == _FULL_PING
            if kind == 0x23:
                yield at, time_ns, message, ""
        if places:
            faults.append(
                f"{self._name}: {passed_over} bytes in {places} places belong to no message; "
                "damaged, so pings may be missing there, or wrong before them"
            )
        if full:
            faults.append(
                f"{self._name}: {number_of(full, 'ping')} in the full format, which is not public, "
                "cannot be read; let the sonar send simple results"
            )

    def _message(self, at: int, length: int) -> tuple[bytes, int | None]:
        """A message and the time at which its log says it came; b"" of what is none."""
        contents = self._file.at(at, length)
        if self._framing is _STREAM:
            return contents, None
        item = np.frombuffer(contents, _ITEM, 1)[0]
        if item["type"] != _SONAR_ITEM:
            return b"", None
        payload = contents[int(item["head"]) :]
        if item["compression"] == _Q_COMPRESSED:
            payload = _inflated(payload, int(item["original"]))
        elif item["compression"]:
            raise UnusableError(f"unknown compression {item['compression']}")
        time_s = float(item["time"])
        return payload, round(time_s * 1e9) if 0 <= time_s < 2**33 else None


def _kind(message: bytes) -> int | None:
    """The number of a message; None of what is none."""
    if len(message) < _HEAD_TYPE.itemsize or message[:2] != _ID:
        return None
    return int(np.frombuffer(message, _HEAD_TYPE, 1)[0]["message"])


def _inflated(payload: bytes, declared: int) -> bytes:
    """What Qt compressed. Raises UnusableError where it is damaged or longer than it declares."""
    if declared > MAX_FRAME_BYTES:
        raise UnusableError(f"it declares {declared} bytes, more than is read")
    inflater = zlib.decompressobj()
    try:
        contents = inflater.decompress(payload[4:], declared + 1)
    except zlib.error:
        raise UnusableError("its compressed contents are damaged") from None
    if len(contents) != declared:
        raise UnusableError(f"its contents inflate to another size than {declared} bytes")
    return contents


def _decoded(message: bytes) -> tuple[Ping, Header]:
    head = np.frombuffer(message, _HEAD_TYPE, 1)[0]
    read = MESSAGES.get((int(head["message"]), int(head["version"])))
    if read is None:
        raise UnusableError(f"a ping of version {head['version']}, which is not known")
    with np.errstate(all="ignore"):  # damaged numbers overflow; what comes of them is checked
        return read(message)
