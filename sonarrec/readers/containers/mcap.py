"""Reads MCAP files, also those that are cut short, have no index or are damaged.

The reader of the `mcap` package stops at the first damage, and inflates without a bound; of the
package the parsers of single records are used. The heads of all records are walked first, which
reads a few bytes a chunk. Messages come in log-time order, whatever the order of chunks: these are
opened in the order of their first messages, and merged where they overlap in time.

A chunk that contradicts itself is not read. Lost messages that the index behind it names are still
counted, so that later frames keep their numbers.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.raw import MAX_FRAME_BYTES, Channel, FileBytes, Message, Recording

MAX_CHUNK_BYTES = 2**28
"""Largest inflated size, for a chunk is held in memory; of one that is not compressed four times as
many. One that declares more, or inflates to more than it declares, is not read."""
MAX_WINDOW_BYTES = 2**27  # of zstd: how much of its output it keeps in memory
MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first and last time, inflated size, CRC, length of a name
_FOOTER_BYTES = 20
_MAX_DEFINITION_BYTES = 4 * 2**20
_DEFINITIONS: dict[int, Any] = {
    Opcode.HEADER: records.Header, Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel, Opcode.STATISTICS: records.Statistics,
}  # fmt: skip
_NO_SCHEMA = records.Schema(id=0, name="", encoding="", data=b"")
_UNREADABLE = (struct.error, UnicodeDecodeError, McapError)


class _DamagedError(Exception):
    """A chunk that cannot be used; the text says why."""


@dataclass(frozen=True, slots=True)
class _Chunk:
    """The head of a chunk, and where its data are in the file."""

    time: int
    """The first log time, ns."""
    size: int
    """Bytes after inflation."""
    crc: int
    compression: str
    start: int
    stored: int
    """start, stored: where its bytes begin in the file, and how many."""
    end: int
    """Of the record."""


class McapRecording(Recording):
    """A `Recording` of an MCAP file. A damaged or cut file is read as far as possible."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if it is no MCAP file, OSError if it cannot be read."""
        super().__init__(path, diagnostics)
        self.complete = False
        # First log time (ns) and position of each unit: a chunk, or a message that is in none.
        self._times, self._positions = array("Q"), array("Q")
        self._schemas, self._listed = dict[int, Any](), dict[int, Any]()
        self._statistics: Any = None
        self._damaged = 0  # definitions
        self._data_ended = False
        self._file = FileBytes(path)
        self.close = self._file.close
        if self._file.read(0, len(MAGIC)) != MAGIC:
            raise SonarrecError(f"{path}: not an MCAP file (it does not begin like one)")
        stop = self._scan(len(MAGIC))
        for resume in self._indexed() if not self.complete else ():
            if resume > stop and not self.complete:
                self.fault(
                    f"damaged at byte {stop}; reading continues at byte {resume}, where the index "
                    "knows what follows"
                )
                stop = self._scan(resume)
        if not self.complete:
            what = "what is whole before it is read, the rest cannot be counted"
            what = "only the summary is lost, no message" if self._data_ended else what
            self.fault(
                f"cut short or damaged at byte {stop} of {self._file.size} (no footer): {what}"
            )
        for position in self._positions:
            if self._counted() is not None:
                break
            if self._file.read(position, 1)[0] == Opcode.CHUNK:
                self._count_chunk(position)
        if (counts := self._counted()) is not None:
            self.counts = Counter(counts)
        if unlisted := sum(n for c, n in self.counts.items() if c not in self._listed):
            self.fault(
                f"{number_of(unlisted, 'message')} of channels that it does not define, not read"
            )
        if self._damaged:
            self.fault(f"not read: {number_of(self._damaged, 'damaged definition')}")
        for number, channel in self._listed.items():
            schema = self._schemas.get(channel.schema_id, _NO_SCHEMA)
            self.channels[number] = Channel(
                channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding
            )

    def _heads(self, position: int) -> Iterator[tuple[int, int, int]]:
        """(opcode, start, length) of every whole record's body, from `position` on."""
        while len(head := self._file.read(position, _HEAD.size)) == _HEAD.size:
            opcode, length = _HEAD.unpack(head)
            if opcode == 0 or position + _HEAD.size + length > self._file.size:
                return
            yield opcode, position + _HEAD.size, length
            position += _HEAD.size + length

    def _scan(self, position: int) -> int:
        """Register every record up to the footer or the first that is not whole; its position."""
        for opcode, body, length in self._heads(position):
            end = body + length
            if opcode == Opcode.FOOTER and length == _FOOTER_BYTES:
                self.complete = self._file.read(end, len(MAGIC)) == MAGIC
                end += len(MAGIC)
                if self.complete and (more := self._file.size - end):
                    self.fault(f"{more} bytes follow its end at byte {end} and were not read")
                return position
            self._data_ended |= opcode == Opcode.DATA_END
            if opcode == Opcode.CHUNK:
                self._add_chunk(position)
            elif opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
                self._add(self._count(self._file.read(body, _MESSAGE.size)), position)
            elif opcode in _DEFINITIONS:
                self._define(opcode, self._file.read(body, min(length, _MAX_DEFINITION_BYTES)))
            position = end
        if self._file.read(position, 1) == bytes([Opcode.CHUNK]):  # cut: its beginning is read
            self._add_chunk(position)
        return position

    def _add_chunk(self, position: int) -> None:
        try:
            chunk = self._chunk_at(position)
        except struct.error:  # the file ends inside its head
            return
        except _DamagedError as error:
            self.fault(f"the chunk at byte {position} {error}; its frames are lost")
            return
        self.chunks[chunk.compression or "none"] += 1
        self._add(chunk.time, position)

    def _add(self, time: int, position: int) -> None:
        self._times.append(time)
        self._positions.append(position)

    def _count(self, message: bytes | memoryview) -> int:
        """Count a message, and return its log time."""
        channel, _, time, _ = _MESSAGE.unpack_from(message)
        self.counts[channel] += 1
        first, last = self.span or (time, time)
        self.span = min(first, time), max(last, time)
        return int(time)

    def _define(self, opcode: int, body: bytes | memoryview) -> None:
        """Keep a definition, of which a damaged one is only counted."""
        try:
            record = _DEFINITIONS[opcode].read(ReadDataStream(BytesIO(body)))
        except _UNREADABLE:
            self._damaged += 1
            return
        if opcode == Opcode.HEADER:
            self.profile, self.library = record.profile, record.library
        elif opcode == Opcode.STATISTICS:
            self._statistics = record
            if record.message_count:
                self.span = record.message_start_time, record.message_end_time
        else:
            (self._schemas if opcode == Opcode.SCHEMA else self._listed)[record.id] = record

    def _count_chunk(self, position: int) -> None:
        """Count the messages inside a chunk, and keep its definitions."""
        try:
            contents, _ = self._contents(self._chunk_at(position))
        except _DamagedError:  # reported when the messages are read
            return
        for opcode, body in _records(contents):
            if opcode == Opcode.MESSAGE and len(body) >= _MESSAGE.size:
                self._count(body)
            elif opcode in _DEFINITIONS:
                self._define(opcode, body)

    def _counted(self) -> dict[int, int] | None:
        """The number of messages by channel, as the summary has it; None if it does not count all,
        or a channel or schema is not defined: some writers leave these out."""
        if (stated := self._statistics) is None:
            return None
        counts: dict[int, int] = stated.channel_message_counts
        is_complete = (
            sum(counts.values()) == stated.message_count
            and set(counts) <= set(self._listed)
            and stated.channel_count <= len(self._listed)
            and {c.schema_id for c in self._listed.values()} <= {0, *self._schemas}
        )
        return counts if is_complete else None

    def _indexed(self) -> list[int]:
        """Positions of the chunks by the summary, and of the summary itself, rising."""
        end = self._file.size - len(MAGIC) - _FOOTER_BYTES - _HEAD.size
        footer, head = self._file.read(max(end, 0), 64), _HEAD.pack(Opcode.FOOTER, _FOOTER_BYTES)
        if not footer.startswith(head) or not footer.endswith(MAGIC):
            return []
        positions = [int.from_bytes(footer[len(head) : len(head) + 8], "little")]
        for opcode, body, length in self._heads(positions[0]):
            if opcode == Opcode.CHUNK_INDEX and length >= 24:  # start, end, position of the chunk
                positions.append(int.from_bytes(self._file.read(body + 16, 8), "little"))
        return sorted(p for p in positions if 0 < p < end)

    def _chunk_at(self, position: int) -> _Chunk:
        """The head of the chunk there. Raises _DamagedError if it contradicts itself, struct.error
        if the file ends inside it."""
        head = self._file.read(position, _HEAD.size + _CHUNK.size)
        _, length = _HEAD.unpack_from(head)
        time, _, size, crc, count = _CHUNK.unpack_from(head, _HEAD.size)
        if count > 32:
            raise _DamagedError("has no readable head")
        start, end = position + len(head) + count + 8, position + _HEAD.size + length
        name, stored = struct.unpack(f"<{count}sQ", self._file.read(start - count - 8, count + 8))
        if stored > end - start:  # a later version may append fields
            raise _DamagedError("contradicts its own length")
        return _Chunk(time, size, crc, name.decode(errors="replace"), start, stored, end)

    def _contents(self, chunk: _Chunk) -> tuple[memoryview, bool]:
        """(the inflated records of a chunk, whether the file is cut inside it; then only what is
        there). Raises _DamagedError if they are not what the head says."""
        largest = max(chunk.size, min(chunk.stored, self._file.size))
        if largest > MAX_CHUNK_BYTES * (1 if chunk.compression else 4):
            raise _DamagedError(f"declares {chunk.size} bytes, more than is inflated")
        data = self._file.read(chunk.start, chunk.stored)
        cut, most = len(data) < chunk.stored, chunk.size + 1
        try:
            if chunk.compression == "zstd":
                inflater = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
                with inflater.stream_reader(data, read_across_frames=True) as reader:
                    data = reader.read(most)
            elif chunk.compression == "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(data, most)
            elif chunk.compression:
                raise _DamagedError(f"has the unknown compression {chunk.compression!r}")
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
            raise _DamagedError(f"does not inflate ({error})") from None
        if len(data) > chunk.size:
            raise _DamagedError(f"inflates to more than the {chunk.size} bytes it declares")
        if not cut and len(data) < chunk.size:
            raise _DamagedError(f"inflates to less than the {chunk.size} bytes it declares")
        if not cut and chunk.crc and zlib.crc32(data) != chunk.crc:
            raise _DamagedError("fails its checksum")
        return memoryview(data), cut

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order; those of equal time as in the file."""
        times, positions = (np.frombuffer(a, np.uint64) for a in (self._times, self._positions))
        spans = np.zeros((len(times), 2), np.uint64)  # first and last log time that was read
        waiting: list[tuple[int, int, int, Message]] = []  # a heap: by time, then as in the file
        passed = lost = late = latest = back_ns = 0
        try:
            for unit in [*np.lexsort((positions, times)).tolist(), None]:
                while waiting and (unit is None or waiting[0][0] < self._times[unit]):
                    message = heapq.heappop(waiting)[-1]
                    passed, late = passed + 1, late + (message.log_time < latest)
                    lost += message.data is None and message.problem is None
                    latest = max(latest, message.log_time)
                    yield message
                if unit is not None and (messages := self._messages_at(positions[unit], channels)):
                    stamps = [message.log_time for message in messages]
                    spans[unit] = min(stamps), max(stamps)
                    highest = accumulate(stamps, max)
                    back_ns = max(back_ns, *(h - t for h, t in zip(highest, stamps, strict=True)))
                    for n, message in enumerate(messages):
                        heapq.heappush(waiting, (message.log_time, unit, n, message))
        except OSError as error:
            raise SonarrecError(f"{self.path}: cannot be read ({error.strerror})") from None
        except struct.error:
            self.fault("the file became shorter while it was read")
        if late:
            self.fault(
                f"{number_of(late, 'frame')} out of order: a chunk states a later start time than "
                "that of its first message"
            )
        if passed < (count := sum(self.counts[c] for c in channels)):
            self.fault(f"in all, {count - passed + lost} of {count} frames are lost")
        self.note_set_back(((int(a), int(b)) for a, b in spans[spans[:, 1] > 0]), back_ns)

    def _messages_at(self, position: int, channels: Collection[int]) -> list[Message]:
        """The messages of some channels in the chunk there, or the one message that is there. Of a
        damaged chunk, a fault is recorded, and the messages that the indexes behind it name are
        given without their data."""
        position, end = int(position), 0
        opcode, length = _HEAD.unpack(self._file.read(position, _HEAD.size))
        if opcode == Opcode.MESSAGE:
            body = memoryview(self._file.read(position + _HEAD.size, length))
            return _chosen(body, channels)
        chunk, messages = self._chunk_at(position), list[Message]()
        try:
            contents, cut = self._contents(chunk)
            for opcode, body in _records(contents):
                end += _HEAD.size + len(body)
                if opcode == Opcode.MESSAGE:
                    messages += _chosen(body, channels)
            if end < len(contents) and not cut:
                where = f"is damaged at byte {end} of its contents"
                raise _DamagedError(f"{where} (`mcap recover` may save some)")
        except _DamagedError as error:
            messages = self._named_behind(chunk.end, channels)
            number = f"{len(messages)} " if messages else ""
            self.fault(f"the chunk at byte {position} {error}; its {number}frames are lost")
        return messages

    def _named_behind(self, position: int, channels: Collection[int]) -> list[Message]:
        messages = list[Message]()
        for opcode, body, length in self._heads(position):
            if opcode != Opcode.MESSAGE_INDEX or length > 2**20:
                break
            try:
                stream = ReadDataStream(BytesIO(self._file.read(body, length)))
                index = records.MessageIndex.read(stream)
            except _UNREADABLE:
                break
            if index.channel_id in channels:
                messages += [Message(index.channel_id, t, t, None) for t, _ in index.records]
        return messages


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(opcode, body) of every whole record."""
    end = 0
    while end + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, end)
        end += _HEAD.size + length
        if opcode == 0 or end > len(data) or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
            return
        yield opcode, data[end - length : end]


def _chosen(record: memoryview, channels: Collection[int]) -> list[Message]:
    """The message of a record, if it is of one of the channels."""
    if len(record) < _MESSAGE.size:  # the file has become shorter
        return []
    channel, _, time, publish_time = _MESSAGE.unpack_from(record)
    if channel not in channels:
        return []
    if len(record) > MAX_FRAME_BYTES:
        problem = f"a message of {len(record)} bytes, more than is read"
        return [Message(channel, time, publish_time, None, problem)]
    return [Message(channel, time, publish_time, record[_MESSAGE.size :])]
