"""Finds out what an MCAP file holds, even if the file is cut short, has no index or is damaged.

The `mcap` package stops at the first damage. This module goes from record to record, with or
without an index; it uses the package only to parse single records.
"""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, Schema, Statistics

from sonarrec.errors import SonarrecError, number_of
from sonarrec.readers.containers.mcap.chunks import (
    RECORD_HEAD,
    ChunkHead,
    Contents,
    DamagedError,
    open_chunk,
    read_chunk_head,
)

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK = -1  # stands for a channel in McapFile.channels_of_units
_MAX_DEFINITION_BYTES = 4 * 2**20
_CHUNK_INDEX_HEAD = struct.Struct("<QQQ")  # start, end, position of the chunk
_FOOTER_BYTES = 20


def records_in(contents: Contents, at: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start of the body, its length) of every whole record from `at` on."""
    file = contents.file
    while at + RECORD_HEAD.size <= contents.end:
        file.seek(at)
        head = file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:  # the file has become shorter
            return
        opcode, length = RECORD_HEAD.unpack(head)
        body = at + RECORD_HEAD.size
        if opcode == 0 or body + length > contents.end:
            return
        yield opcode, body, length
        at = body + length


class McapFile:
    """An open MCAP file and a summary of what it holds.

    schemas, channels: by id. counts: number of messages by channel. header: profile and library;
    None if the file has no header. span: first and last log time, ns; None without messages.
    chunks: number of chunks by compression. whole: whether the file has its footer.

    times, positions, channels_of_units: the units to read, one element each: its first log time
    (ns), its position in the file, and its channel. A unit is a chunk (channel CHUNK), or a run of
    messages of one channel that are in no chunk and whose times do not go back.
    """

    def __init__(self, path: Path, fault: Callable[[str], None]) -> None:
        """fault: is told what is wrong. Raises SonarrecError if it is no MCAP file, OSError if it
        cannot be read."""
        self.path, self.fault = path, fault
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.header: Header | None = None
        self.span: tuple[int, int] | None = None
        self.chunks: Counter[str] = Counter()
        self.whole = False
        self.times, self.positions = array("Q"), array("Q")
        self.channels_of_units = array("l")
        self._statistics: Statistics | None = None
        self._damaged = 0  # definitions
        self._data_ended = False
        self.file = path.open("rb")
        try:
            self.size = self._end = self.file.seek(0, 2)
            self._scan()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def chunk_at(self, position: int) -> ChunkHead:
        """The head of the chunk at `position`. Raises DamagedError if it cannot be used."""
        head = read_chunk_head(self.file, position, self.size)
        if head is None:
            raise DamagedError("has no readable head")
        return head

    def _scan(self) -> None:
        self.file.seek(0)
        if self.file.read(len(MAGIC)) != MAGIC:
            raise SonarrecError(f"{self.path}: not an MCAP file (it does not begin like one)")
        stop = self._scan_from(len(MAGIC))
        while not self.whole:
            resume = next((p for p in self._indexed_positions() if p > stop), None)
            if resume is None:
                what = "what is whole before it is read, the rest cannot be counted"
                if self._data_ended:
                    what = "only the summary is lost, no message"
                self.fault(
                    f"cut short or damaged at byte {stop} of {self.size} (no footer): {what}"
                )
                break
            self.fault(
                f"damaged at byte {stop}; read on from byte {resume}, where the index knows what "
                "follows"
            )
            stop = self._scan_from(resume)
        if self.whole and (more := self.size - self._end):
            self.fault(f"{more} bytes follow its end at byte {self._end} and were not read")
        for position, channel in zip(self.positions, self.channels_of_units, strict=True):
            if self._summary_is_complete():
                break
            if channel == CHUNK:
                self._look_into(position)
        if self._statistics is not None and self._summary_is_complete():
            self.counts = Counter(self._statistics.channel_message_counts)
        if self._damaged:
            self.fault(f"not read: {number_of(self._damaged, 'damaged definition')}")

    def _summary_is_complete(self) -> bool:
        """Whether the summary counts all messages, and every channel and schema is defined. Some
        writers leave out the counts by channel, or channels, or schemas."""
        statistics = self._statistics
        if statistics is None:
            return False
        counts = statistics.channel_message_counts
        return (
            sum(counts.values()) == statistics.message_count
            and set(counts) <= set(self.channels)
            and statistics.channel_count <= len(self.channels)
            and {c.schema_id for c in self.channels.values()} <= {0, *self.schemas}
        )

    def _scan_from(self, at: int) -> int:
        """Register every record from `at` to the footer or to the first incomplete record. Returns
        the position at which it stopped."""
        last_times: dict[int, int] = {}
        for opcode, body, length in records_in(Contents(self.file, at, self.size), at):
            if opcode == Opcode.FOOTER and length == _FOOTER_BYTES:
                self.file.seek(body + length)
                self.whole = self.file.read(len(MAGIC)) == MAGIC
                self._end = body + length + len(MAGIC)
                return at
            self._data_ended |= opcode == Opcode.DATA_END
            if opcode == Opcode.CHUNK:
                self._add_chunk(at)
            else:
                self._note(opcode, at, length, last_times)
            at = body + length
        self.file.seek(at)
        if self.file.read(1) == bytes([Opcode.CHUNK]):  # cut: what is there of it is read
            self._add_chunk(at)
        return at

    def _note(self, opcode: int, at: int, length: int, last_times: dict[int, int]) -> None:
        """Register a whole record at `at`. last_times: log time of the last message, by channel."""
        self.file.seek(at + RECORD_HEAD.size)
        if opcode != Opcode.MESSAGE:
            self._define(self.file, opcode, length)
            return
        head = self.file.read(min(length, MESSAGE_HEAD.size))
        if len(head) < MESSAGE_HEAD.size:
            return
        channel, _, time, _ = MESSAGE_HEAD.unpack(head)
        if time < last_times.get(channel, time + 1):
            self._add_unit(time, at, channel)
        last_times[channel] = time
        self._count(channel, time)

    def _add_chunk(self, position: int) -> None:
        try:
            head = read_chunk_head(self.file, position, self.size)
        except DamagedError as error:
            self.fault(f"the chunk at byte {position} {error}; its frames are lost")
            return
        if head is not None:
            self.chunks[head.compression or "none"] += 1
            self._add_unit(head.start_time, position, CHUNK)

    def _add_unit(self, time: int, position: int, channel: int) -> None:
        self.times.append(time)
        self.positions.append(position)
        self.channels_of_units.append(channel)

    def _count(self, channel: int, time: int) -> None:
        self.counts[channel] += 1
        first, last = self.span or (time, time)
        self.span = min(first, time), max(last, time)

    def _define(self, file: IO[bytes], opcode: int, length: int) -> None:
        """Register a header, schema, channel or statistics record; only count a damaged one."""
        if opcode not in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            return
        stream = ReadDataStream(BytesIO(file.read(min(length, _MAX_DEFINITION_BYTES))))
        try:
            if opcode == Opcode.HEADER:
                self.header = Header.read(stream)
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
            else:
                self._statistics = statistics = Statistics.read(stream)
                if statistics.message_count:
                    self.span = statistics.message_start_time, statistics.message_end_time
        except (struct.error, UnicodeDecodeError, McapError):
            self._damaged += 1

    def _look_into(self, position: int) -> None:
        """Register the definitions inside a chunk and count its messages."""
        try:
            contents = open_chunk(self.file, self.chunk_at(position))
        except DamagedError:
            return  # reported when the messages are read
        for opcode, body, length in records_in(contents, contents.start):
            contents.file.seek(body)
            if opcode == Opcode.MESSAGE:
                head = contents.file.read(min(length, MESSAGE_HEAD.size))
                if len(head) == MESSAGE_HEAD.size:
                    channel, _, time, _ = MESSAGE_HEAD.unpack(head)
                    self._count(channel, time)
            else:
                self._define(contents.file, opcode, length)
        contents.release()

    def _indexed_positions(self) -> list[int]:
        """Positions of the chunks according to the summary, and of the summary itself, rising."""
        end = self.size - len(MAGIC) - _FOOTER_BYTES - RECORD_HEAD.size
        self.file.seek(max(end, 0))
        record = self.file.read()
        head = RECORD_HEAD.pack(Opcode.FOOTER, _FOOTER_BYTES)
        if not record.startswith(head) or not record.endswith(MAGIC):
            return []  # the recording does not end with a footer
        start = Footer.read(ReadDataStream(BytesIO(record[len(head) :]))).summary_start
        positions = [start]
        for opcode, body, length in records_in(Contents(self.file, start, end), start):
            if opcode == Opcode.CHUNK_INDEX and length >= _CHUNK_INDEX_HEAD.size:
                self.file.seek(body)
                head = self.file.read(_CHUNK_INDEX_HEAD.size)
                positions.append(_CHUNK_INDEX_HEAD.unpack(head)[2])
        return sorted(p for p in positions if 0 < p < end)
