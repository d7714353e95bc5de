"""Tritech's Gemini sonars: the `.glf` logs of Genesis and of the maker's software kit.

A `.glf` is a ZIP, in which a `.dat` holds record after record. All numbers are little-endian and
packed. The layout is known from two free readers and a header file by the maker, who has published
no description.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.raw import (
    MAX_FRAME_BYTES,
    Decoded,
    FileBytes,
    HeaderInfo,
    RawLog,
    StoredFrame,
    UnusableError,
    frame_of,
    ping_geometry,
)

Header = dict[str, Any]
"""What a record says about the sonar, by name and unit; None for impossible values."""

_BEGIN = [
    ("star", "u1"), ("version", "u1"), ("length", "<u4"), ("time", "<f8"), ("type", "u1"),
    ("device", "<u2"), ("node", "<u2"), ("spare", "<u2"), ("record", "<u2"), ("mark", "<u2"),
    ("image_version", "<u2"), ("first_bin", "<u4"), ("end_bin", "<u4"),
    ("range_compression", "<u2"), ("first_beam", "<u4"), ("end_beam", "<u4"),
]  # fmt: skip
_HEAD = np.dtype([*_BEGIN, ("size", "<u4")])
"""How an image's record begins, up to its samples, in versions 1 and 2."""
_HEAD_3 = np.dtype([*_BEGIN, ("compression", "<u2"), ("size", "<u4")])
"""The same from version 3 on."""
_TAIL = np.dtype(
    [
        ("state", "<u4"), ("bins_hz", "<u4"), ("aperture", "<f4"), ("time", "<f8"),
        ("flags", "<u2"), ("sound_speed", "<f4"), ("gain", "<i2"), ("chirp", "u1"),
        ("processing", "u1"), ("model", "u1"), ("zoomed", "u1"), ("end", "<u2"),
    ]
)  # fmt: skip
"""How it ends, after the samples and the bearings. zoomed: whether a second image, a magnified part
of the first, follows before the end mark."""
_OTHERS = (1, 2, 3, 98, 99)  # types of records: V4, video, status, serial, generic
_STAR, _IMAGE_TYPE, _END_MARK = ord("*"), 0, 0xDEDE
_RECORD, _RECORD_MARK = 1, 0xEFEF  # what an image's record begins with, after every message's head
_MARK = _RECORD.to_bytes(2, "little") + _RECORD_MARK.to_bytes(2, "little")
_MARK_AT = 21  # bytes from the beginning of a record
_ZLIB, _PLAIN = 0, 1  # compressions; 2 is H.264
_UPSIDE_DOWN = 0xE000  # bits of `state`
_MOST_BEAMS, _MOST_BINS = 4096, 2**16
_MODELS = {
    1: "720is", 2: "720ik", 3: "720im", 4: "1200ik", 5: "720ik", 6: "720ik", 7: "720ik",
    8: "1200ik", 9: "1200id", 10: "Micron 1200d",
}  # fmt: skip
_EPOCH_S = 315_532_800  # 1980-01-01, in seconds since 1970


def _head(record: bytes) -> tuple[Any, int, int]:
    """(fields of a record's head, number of beams, number of bins)."""
    fields = np.frombuffer(record, _HEAD, 1)[0]
    if fields["image_version"] >= 3:
        fields = np.frombuffer(record, _HEAD_3, 1)[0]
    beams = int(fields["end_beam"]) - int(fields["first_beam"])
    return fields, beams, int(fields["end_bin"]) - int(fields["first_bin"])


def _tail(record: bytes) -> Any:
    return np.frombuffer(record, _TAIL, 1, len(record) - _TAIL.itemsize)[0]


def _record_length(head: bytes) -> int | None:
    """The length in bytes of an image's record; None if none begins with these bytes."""
    fields, beams, bins = _head(head)
    marks = (fields["star"], fields["type"], fields["record"], fields["mark"])
    size = int(fields["size"])
    if marks != (_STAR, _IMAGE_TYPE, _RECORD, _RECORD_MARK) or not (
        0 < beams <= _MOST_BEAMS and 0 < bins <= _MOST_BINS and size <= MAX_FRAME_BYTES
    ):
        return None
    return int(fields.dtype.itemsize) + size + 8 * beams + _TAIL.itemsize


def _begins(head: bytes) -> bool:
    """Whether a record of any kind begins here, or the mark at the end of all records."""
    fields = np.frombuffer(head, _HEAD, 1)[0]
    is_other = fields["star"] == _STAR and fields["type"] in _OTHERS
    is_end = head.startswith(_END_MARK.to_bytes(2, "little"))
    return bool(is_other or is_end or _record_length(head) is not None)


def decoded(record: bytes) -> tuple[Decoded, Header]:
    """The ping of a record, and its header. Raises UnusableError if it cannot be used."""
    fields, beams, bins = _head(record)
    start, size = fields.dtype.itemsize, int(fields["size"])
    samples = _samples(record[start : start + size], fields, beams * bins)
    table, tail = np.frombuffer(record, "<f8", beams, start + size), _tail(record)
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
    model, gain = _MODELS.get(int(tail["model"])), int(tail["gain"])
    header: Header = {
        "sonar": f"Gemini{f' {model}' if model else ''}, device {fields['device']}",
        "mounted": "upside down" if upside_down else "upright",
        "sound_speed_m_s": float(f"{speed:.7g}"),
        "range_resolution_m": float(f"{bin_m:.7g}"),
        "gain_percent": gain if 0 <= gain <= 100 else None,
        "chirp": "yes" if tail["chirp"] else "no",
    }
    pixels = np.frombuffer(samples, np.uint8).reshape(bins, beams)
    return Decoded(pixels, _since_1970(float(tail["time"])), geometry), header


def _samples(data: bytes, fields: Any, count: int) -> bytes:
    """The `count` samples of a record, range after range. Raises UnusableError."""
    compression = _PLAIN if len(data) == count else _ZLIB
    if "compression" in fields.dtype.names:
        compression = int(fields["compression"])
    if compression == _ZLIB:
        try:
            data = zlib.decompressobj().decompress(data, count + 1)
        except zlib.error:
            raise UnusableError("its compressed samples are damaged") from None
    elif compression != _PLAIN:
        video = "its samples are compressed as video (H.264), which is not read"
        raise UnusableError(video if compression == 2 else f"unknown compression {compression}")
    if len(data) != count:
        raise UnusableError(f"{len(data)} samples, not the {count} of its beams and bins")
    return data


def _since_1970(time_s: float) -> int | None:
    """ns since 1970, from seconds since 1980; None if impossible."""
    if not 0 < time_s < 2**32:
        return None
    fraction, seconds = math.modf(time_s)
    return (int(seconds) + _EPOCH_S) * 10**9 + round(fraction * 1e9)


_PIECE = 2**20  # bytes
_ENTRY_MARK, _ENTRY_BYTES = b"PK\x03\x04", 30  # before a file in a ZIP
_STORED, _DEFLATED = 0, 8
_ENCRYPTED = 1  # of an entry's flags


def _pieces(path: Path) -> Iterator[bytes]:
    """The `.dat` of a file, in pieces, for it may be of any length. Python's zipfile is not used,
    because it does not open a file whose end is missing, and returns nothing of contents with a
    wrong checksum. Raises SonarrecError if the file is no such log; if it is cut or damaged, raises
    UnusableError after all that can be read."""
    file = FileBytes(path)
    try:
        entry = _find_dat(file, path, 0)
        while entry is not None:  # more than one if files were joined
            method, position = entry
            inflater = zlib.decompressobj(-zlib.MAX_WBITS)
            while not inflater.eof and (piece := file.read(position, _PIECE)):
                position += len(piece)
                yield inflater.decompress(piece) if method == _DEFLATED else piece
            if method == _DEFLATED and not inflater.eof:
                raise UnusableError("its end is missing")
            entry = _find_dat(file, path, position - len(inflater.unused_data))
    except zlib.error:
        raise UnusableError("its compressed contents are damaged") from None
    finally:
        file.close()


def _find_dat(file: FileBytes, path: Path, start: int) -> tuple[int, int] | None:
    """(ZIP method of the `.dat`, where its contents begin); None if none follows. start: where to
    search from; at 0 there must be one."""
    position = file.find(_ENTRY_MARK, start, file.size if start else 1)
    if position is None and not start:
        raise SonarrecError(f"{path}: not a .glf of a Gemini, which is a ZIP")
    while position is not None:
        head = file.read(position, _ENTRY_BYTES)
        flags, method, name, extra = (
            int.from_bytes(head[i : i + 2], "little") for i in (6, 8, 26, 28)
        )
        if file.read(position + _ENTRY_BYTES, name).lower().endswith(b".dat"):
            if flags & _ENCRYPTED or method not in (_STORED, _DEFLATED):
                raise SonarrecError(
                    f"{path}: packed or encrypted in a way that is not read (ZIP method {method}, "
                    f"flags {flags:#x}); unpack it, and pack it again as a plain ZIP"
                )
            return method, position + _ENTRY_BYTES + name + extra
        position = file.find(_ENTRY_MARK, position + 1, file.size)
    if start:
        return None
    raise SonarrecError(f"{path}: a ZIP without a .dat, which holds a Gemini's images")


def _records(data: Iterator[bytes]) -> Iterator[tuple[int, bytes | None, str | None]]:
    """Yield (position, bytes, problem) of each image's record; no bytes if it is damaged. data: the
    `.dat`, in pieces. position: in the `.dat`. Other records (the sonar's status, a compass) are
    skipped. An error of `data` is raised after the records before it."""
    held, position = bytearray(), 0  # bytes that are not used yet, and where they begin
    broken: UnusableError | None = None
    follows = True  # whether `held` begins where a record ended

    def fill(count: int) -> bool:
        """Hold at least so many bytes; False if the data end before."""
        nonlocal broken
        try:
            while len(held) < count and (piece := next(data, None)) is not None:
                held.extend(piece)
        except UnusableError as error:
            broken = error
        return len(held) >= count

    def drop(count: int) -> None:
        nonlocal position
        del held[:count]
        position += count

    while fill(_HEAD_3.itemsize):
        if follows and not _begins(bytes(held[: _HEAD_3.itemsize])):
            yield position, None, "no record begins there; damaged"
        follows = False
        position = held.find(_MARK, _MARK_AT)
        drop(len(held) - _HEAD_3.itemsize + 1 if position < 0 else position - _MARK_AT)
        if position < 0 or not fill(_HEAD_3.itemsize):
            continue
        length = _record_length(bytes(held[: _HEAD_3.itemsize]))
        if length is None:
            drop(1)
        elif not fill(length):
            yield position, None, f"only {len(held)} of its {length} bytes are there"
            drop(_MARK_AT)
        else:
            record = bytes(held[:length])
            zoomed = _tail(record)["zoomed"] == 1
            if not zoomed and _tail(record)["end"] != _END_MARK:
                yield position, None, "its end mark is missing; bytes are lost or wrong"
                drop(_MARK_AT)
            else:
                yield position, record, None
                drop(length)
                follows = not zoomed
    if broken is not None:
        raise broken


class GeminiPings(RawLog):
    """The images of one sonar, the first in the file, in the order of the file."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if the file holds no image that can be read."""
        super().__init__(diagnostics, polar=True)
        self._path = path
        self._device, header = self._first()
        self.header_info = HeaderInfo(values=header)
        diagnostics.note(
            "left and right are as free readers show them; if a landmark lies on the wrong side, "
            "state bearings_deg in reverse order",
            "times are those of the recording computer, whose time zone is not stated; UTC is "
            "assumed",
        )

    def _first(self) -> tuple[int, Header]:
        """The number of the first sonar, and the header of its first image that can be read."""
        problem = ""
        try:
            for _, record, reason in _records(_pieces(self._path)):
                if record is not None:
                    try:
                        return int(_head(record)[0]["device"]), decoded(record)[1]
                    except UnusableError as error:
                        reason = str(error)
                problem = problem or f" ({reason})"
        except UnusableError as error:
            problem = problem or f" ({error})"
        raise SonarrecError(f"{self._path}: no image of a Gemini can be read in it{problem}")

    def __iter__(self) -> Iterator[StoredFrame]:
        number, others = 0, 0
        try:
            for position, record, problem in _records(_pieces(self._path)):
                fields = None if record is None else _head(record)[0]
                if fields is not None and fields["device"] != self._device:
                    others += 1
                    continue
                name = f"image {number} at byte {position}"
                logged_ns = None if fields is None else _since_1970(float(fields["time"]))
                if record is None or number in self.passed_over:
                    yield StoredFrame(name, logged_ns, problem=problem)
                else:
                    yield frame_of(name, logged_ns, lambda r: decoded(r)[0], record)
                number += 1
        except UnusableError as error:
            self.diagnostics.fault(f"{error}; what comes before is read", self._path.name)
        if others:
            self.diagnostics.fault(
                f"{number_of(others, 'image')} of other sonars than device {self._device} are not "
                "read; record one sonar to a file",
                self._path.name,
            )
