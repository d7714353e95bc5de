"""Finds where messages begin and end: in a raw stream, and in the items of an `.oculus` log."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sonarrec.errors import SonarrecError
from sonarrec.readers.containers.file_bytes import FileBytes
from sonarrec.readers.containers.oculus.pings import HEAD_TYPE, KNOWN_MESSAGES, MESSAGE_MARK
from sonarrec.readers.raw import MAX_FRAME_BYTES, UnusableError


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

    def length_at(self, file: FileBytes, place: int) -> int | None:
        """The length of what begins at a place of the file; None if nothing does."""
        return self.length(file.at(place, self.head))


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
_Q_COMPRESSED = 1  # by Qt: the length in four bytes, most significant first, then zlib


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
        payload = _inflated(payload, int(item["original"]))
    elif item["compression"]:
        raise UnusableError(f"unknown compression {item['compression']}")
    time_s = float(item["time"])
    return payload, round(time_s * 1e9) if 0 <= time_s < 2**33 else None


_STREAM = Framing(
    MESSAGE_MARK, HEAD_TYPE.itemsize, _message_length, lambda message: (message, None)
)
_LOG = Framing(_ITEM_MARK, _ITEM.itemsize, _item_length, _message_of_item)


def framing_of(file: FileBytes, where: str) -> tuple[Framing, int]:
    """(framing of a file, where its first message may begin). where: names the file.

    Raises SonarrecError for kinds of logs that are not read.
    """
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
    place = file.find(framing.mark, start, end)
    while place is not None and framing.length_at(file, place) is None:
        place = file.find(framing.mark, place + 1, end)
    return place


def messages(
    file: FileBytes, framing: Framing, start: int, limit: int
) -> Iterator[tuple[int, int, bool]]:
    """Yield (place, length in bytes, whether it is whole) of each message from `start` to `limit`.

    Bytes that belong to no message are yielded too; there `Framing.length_at` is None. If a message
    is not followed by another, or by the end, and another begins inside it, it has lost bytes.
    """
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


def _inflated(payload: bytes, declared: int) -> bytes:
    """What Qt compressed. Raises UnusableError if it is damaged or not of the declared size."""
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
