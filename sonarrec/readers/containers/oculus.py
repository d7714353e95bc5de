"""Blueprint Subsea's Oculus sonars: pings as the sonar sends them, or in `.oculus` logs.

All numbers are little-endian and packed. The layouts are known from free drivers and readers; the
maker has published no description. To add a message, write one function from its bytes to a Ping
and its header, and add one row to MESSAGES. The drivers' messages in recordings hold the same
samples (`messages/types.py`).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.containers.file_bytes import FileBytes
from sonarrec.readers.raw import (
    MAX_FRAME_BYTES,
    HeaderInfo,
    Ping,
    RawFrame,
    RawLog,
    UnusableError,
    frame_of,
    ping_geometry,
)
from sonarrec.sonar import PingGeometry


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
    """The (bins, beams) samples of a ping, unsigned integers of `size` bytes.

    step: bytes from row to row; those beyond a row's own are skipped. gains: whether each row
    begins with its gain, 4 bytes; then its samples are divided by the gain's root, as float32.
    Raises UnusableError if the numbers do not fit the data.
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


Header = dict[str, Any]
"""What a ping says about the sonar, by name and unit; None if the sonar did not measure it."""
Fields = list[tuple[str, str]]

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
# In the first version the start of a ping is a count of unknown unit.
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
HEAD_TYPE = np.dtype(_HEAD)
"""How every message begins."""
MESSAGE_MARK = b"SO"
"""The first bytes of every message: its `id`."""
FULL_PING, SIMPLE_PING = 0x22, 0x23
KNOWN_MESSAGES = (0x15, FULL_PING, SIMPLE_PING, 0x55, 0x80, 0xFF)
"""The numbers of all messages; those without a name are fire, settings, logs and dummy."""
_BYTES_OF_SAMPLE = {0: 1, 1: 2, 3: 4}


def read_ping(message: bytes, layout: np.dtype[Any] = _RESULT) -> tuple[Ping, Header]:
    """OculusSimplePingResult, the first version: without a time. Raises UnusableError."""
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
    """The value; None out of bounds, which is what happened to be in the sonar's memory."""
    leftover = 0 < abs(value) < 1e-9
    return float(f"{value:.7g}") if low <= value <= high and not leftover else None


def read_simple_ping_2(message: bytes) -> tuple[Ping, Header]:
    """OculusSimplePingResult2: with heading, pitch, roll, and seconds since switched on."""
    ping, header = read_ping(message, _RESULT_2)
    fields = np.frombuffer(message, _RESULT_2, 1)[0]
    for key in ("heading", "pitch", "roll"):
        header[f"{key}_deg"] = _within(fields[key], -360, 360)
    start = _within(fields["start"], 0, 2**33)
    stamp = None if start is None else round(start * 1e9)
    return replace(ping, stamp_ns=stamp), header


MESSAGES: dict[tuple[int, int], Callable[[bytes], tuple[Ping, Header]]] = {
    (SIMPLE_PING, 0): read_ping,  # as the first version's sonars send it
    (SIMPLE_PING, 1): read_ping,
    (SIMPLE_PING, 2): read_simple_ping_2,
}
"""What reads a ping, by message number and version."""


def decoded(message: bytes) -> tuple[Ping, Header]:
    """The ping of a message, and its header. Raises UnusableError if it cannot be used."""
    head = np.frombuffer(message, HEAD_TYPE, 1)[0]
    parse = MESSAGES.get((int(head["message"]), int(head["version"])))
    if parse is None:
        raise UnusableError(f"a ping of version {head['version']}, which is not known")
    with np.errstate(all="ignore"):  # damaged numbers overflow; results are checked
        return parse(message)


@dataclass(frozen=True, slots=True)
class Framing:
    """How a file is divided into messages, or into items that hold them.

    mark: the first bytes of each. head: how many bytes `length` needs. length: takes these, returns
    the length in bytes, or None if no message or item begins with them. contents: takes all bytes,
    returns the message (b"" for an item without one) and when it came in ns (None if unknown);
    raises UnusableError.
    """

    mark: bytes
    head: int
    length: Callable[[bytes], int | None]
    contents: Callable[[bytes], tuple[bytes, int | None]]

    def length_at(self, file: FileBytes, position: int) -> int | None:
        """The length of what begins at a position of the file; None if nothing does."""
        return self.length(file.at(position, self.head))


def _message_length(head: bytes) -> int | None:
    if len(head) < HEAD_TYPE.itemsize or head[:2] != MESSAGE_MARK:
        return None
    fields = np.frombuffer(head, HEAD_TYPE, 1)[0]
    length = HEAD_TYPE.itemsize + int(fields["payload"])
    return length if fields["message"] in KNOWN_MESSAGES and length <= MAX_FRAME_BYTES else None


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


def _item_length(head: bytes) -> int | None:
    if len(head) < _ITEM.itemsize or head[:4] != _ITEM_MARK:
        return None
    fields = np.frombuffer(head, _ITEM, 1)[0]
    length = int(fields["head"]) + int(fields["payload"])
    return length if 36 <= fields["head"] <= 4096 and length <= MAX_FRAME_BYTES else None


def _message_of_item(contents: bytes) -> tuple[bytes, int | None]:
    item = np.frombuffer(contents, _ITEM, 1)[0]
    if item["type"] != _SONAR_ITEM:
        return b"", None
    payload = contents[int(item["head"]) :]
    if item["compression"] == _Q_COMPRESSED:
        declared = int(item["original"])
        if declared > MAX_FRAME_BYTES:
            raise UnusableError(f"it declares {declared} bytes, more than is read")
        try:
            stored = payload[_INFLATED_SIZE_BYTES:]
            payload = zlib.decompressobj().decompress(stored, declared + 1)
        except zlib.error:
            raise UnusableError("its compressed contents are damaged") from None
        if len(payload) != declared:
            raise UnusableError(f"its contents inflate to another size than {declared} bytes")
    elif item["compression"]:
        raise UnusableError(f"unknown compression {item['compression']}")
    time_s = float(item["time"])
    return payload, round(time_s * 1e9) if 0 <= time_s < 2**33 else None


_STREAM = Framing(
    MESSAGE_MARK, HEAD_TYPE.itemsize, _message_length, lambda message: (message, None)
)
_LOG = Framing(_ITEM_MARK, _ITEM.itemsize, _item_length, _message_of_item)


def framing_of(file: FileBytes, where: str) -> tuple[Framing, int]:
    """(framing of a file, where its first message may begin). where: names the file. Raises
    SonarrecError for kinds of logs that are not read."""
    head = file.at(0, _LOG_HEAD_BYTES)
    if head.startswith(b"SQLite format 3\0"):
        raise SonarrecError(
            f"{where}: a log of the second ViewPoint (a database), which is not read; "
            "let ViewPoint export it as an .oculus log of the first"
        )
    if not head.startswith(_LOG_MARK):
        return _STREAM, 0
    size, encryption = (int.from_bytes(head[a:b], "little") for a, b in ((4, 8), (26, 28)))
    if encryption:
        raise SonarrecError(
            f"{where}: an encrypted log, which is not read; record it without encryption"
        )
    return _LOG, size if _LOG_HEAD_BYTES <= size <= 4096 else _LOG_HEAD_BYTES


def _find_next(file: FileBytes, framing: Framing, start: int, end: int) -> int | None:
    """Where the next message begins, at `start` or later and before `end`; None if none does."""
    position = file.find(framing.mark, start, end)
    while position is not None and framing.length_at(file, position) is None:
        position = file.find(framing.mark, position + 1, end)
    return position


def messages(
    file: FileBytes, framing: Framing, start: int, limit: int
) -> Iterator[tuple[int, int, bool]]:
    """Yield (position, length in bytes, whether it is whole) of messages from `start` to `limit`.
    Bytes that belong to no message are yielded too; there `Framing.length_at` is None. If a message
    is not followed by another, or by the end, and another begins inside it, it has lost bytes."""
    at = start
    while at < limit:
        length = framing.length_at(file, at)
        end = limit if length is None else min(at + length, limit)
        whole = length is not None and at + length <= limit
        followed = whole and (end == limit or framing.length_at(file, end) is not None)
        if not followed:
            inside = _find_next(file, framing, at + 1, end)
            if inside is not None:
                whole, end = False, inside
        yield at, end - at, whole
        at = end


def _ping_of(message: bytes) -> Ping:
    return decoded(message)[0]


# Bytes looked through for a first ping, since the file may be of another kind.
_LOOKED_THROUGH = 2 * MAX_FRAME_BYTES


class OculusPings(RawLog):
    """The pings of a raw stream or of an `.oculus` log, in the order of the file."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if the file holds no ping that can be read."""
        super().__init__(diagnostics)
        self.polar = True
        self._name = path.name
        self._file = FileBytes(path)
        with self._file.closed_on_error():
            self._framing, self._start = framing_of(self._file, str(path))
            self.header_info = HeaderInfo(values=self._first_header(str(path)))

    def _first_header(self, where: str) -> Header:
        """The header of the first ping that can be read. where: names the file."""
        problem, untold = "", Diagnostics("")
        within = min(self._file.size, _LOOKED_THROUGH)
        for _, _, message, reason in self._read(untold, within):
            if message is not None:
                try:
                    return decoded(message)[1]
                except UnusableError as error:
                    reason = str(error)
            problem = problem or f" ({reason})"
        raise SonarrecError(f"{where}: no ping of an Oculus can be read in it{problem}")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __iter__(self) -> Iterator[RawFrame]:
        for number, (at, time_ns, message, problem) in enumerate(
            self._read(self.diagnostics, self._file.size)
        ):
            name = f"ping {number} at byte {at}"
            if message is None or number in self.passed_over:
                yield RawFrame(name, time_ns, None, problem or None)
            else:
                yield frame_of(name, time_ns, partial(_ping_of, message))

    def _read(
        self, diagnostics: Diagnostics, limit: int
    ) -> Iterator[tuple[int, int | None, bytes | None, str]]:
        """Yield (position, time in ns, message, problem) of each ping; no message if damaged.
        limit: where in the file to stop. diagnostics: after all is read, it is told of bytes that
        belong to no message, and of pings in a format that is not read."""
        stray_bytes = stray_places = full = 0
        for at, length, whole in messages(self._file, self._framing, self._start, limit):
            if self._framing.length_at(self._file, at) is None:
                stray_bytes += length
                stray_places += 1
                continue
            if not whole:
                yield at, None, None, f"only {length} bytes of it are there"
                continue
            try:
                message, time_ns = self._framing.contents(self._file.at(at, length))
            except UnusableError as error:
                yield at, None, None, str(error)
                continue
            number = None
            if len(message) >= HEAD_TYPE.itemsize and message[:2] == MESSAGE_MARK:
                number = int(np.frombuffer(message, HEAD_TYPE, 1)[0]["message"])
            full += number == FULL_PING
            if number == SIMPLE_PING:
                yield at, time_ns, message, ""
        if stray_places:
            diagnostics.fault(
                f"{stray_bytes} bytes in {stray_places} places belong to no message; damaged, so "
                "pings may be missing there, or wrong before them",
                self._name,
            )
        if full:
            diagnostics.fault(
                f"{number_of(full, 'ping')} in the full format, which is not public, cannot be "
                "read; let the sonar send simple results",
                self._name,
            )
