"""Reads MCAP files, also those that are cut short, have no index or are damaged.

The `mcap` package stops at the first damage. This module goes from record to record, with or
without an index; it uses the package only to parse single records.

Messages come in log-time order, whatever the order of chunks: these are opened in the order of
their first messages, and those that overlap in time are merged. Only the position of a message is
kept until it is read. A chunk that contradicts itself is not read. Lost messages that the index
behind it names keep their places, so that later frames keep their numbers.
"""

from __future__ import annotations

import heapq
import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.containers.mcap_chunks import (
    RECORD_HEAD,
    Chunk,
    Contents,
    DamagedError,
    open_chunk,
    read_chunk_head,
    records_in,
)
from sonarrec.readers.raw import MAX_FRAME_BYTES, Channel, Message, Recording

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_DEFINITIONS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.STATISTICS: records.Statistics,
}
_MAX_DEFINITION_BYTES = 4 * 2**20
_INDEX_HEAD = struct.Struct("<HI")  # channel, length of the entries
_MAX_INDEX_BYTES = 2**20
_FOOTER_BYTES = 20
_NO_SCHEMA = records.Schema(id=0, name="", encoding="", data=b"")


class McapRecording(Recording):
    """A `Recording` of an MCAP file. A damaged or cut file is read as far as possible. times,
    positions: the units to read, one element each: its first log time (ns) and its position in the
    file. A unit is a chunk, or a run of messages that are in no chunk and whose times do not go
    back. size: of the file, in bytes."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if it is no MCAP file, OSError if it cannot be read."""
        super().__init__(path, diagnostics)
        self.whole = False
        self.times, self.positions = array("Q"), array("Q")
        self._schemas, self._listed = dict[int, Any](), dict[int, Any]()
        self._statistics: Any = None
        self._damaged = 0  # definitions
        self._data_ended = False
        self.file = path.open("rb")
        self.close = self.file.close
        self.size = self._end = self.file.seek(0, 2)
        self._scan()
        for number, channel in self._listed.items():
            schema = self._schemas.get(channel.schema_id, _NO_SCHEMA)
            self.channels[number] = Channel(
                channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding
            )

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order; those of equal time as in the file."""
        run = _Pass(self, channels)
        yield from run.messages()
        self.note_set_back(((first, last) for _, first, last in sorted(run.spans)), run.back_ns)

    def _scan(self) -> None:
        """Find out what the file holds."""
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
        for position in self.positions:
            if self._summary_is_complete():
                break
            if self.is_chunk(position):
                self._look_into(position)
        if self._summary_is_complete():
            self.counts = Counter(self._statistics.channel_message_counts)
        if unlisted := sum(n for c, n in self.counts.items() if c not in self._listed):
            self.fault(
                f"{number_of(unlisted, 'message')} of channels that it does not define, not read"
            )
        if self._damaged:
            self.fault(f"not read: {number_of(self._damaged, 'damaged definition')}")

    def _summary_is_complete(self) -> bool:
        """Whether the summary counts all messages, and every channel and schema is defined. Some
        writers leave out the counts by channel, or channels, or schemas."""
        if self._statistics is None:
            return False
        counts = self._statistics.channel_message_counts
        return (
            sum(counts.values()) == self._statistics.message_count
            and set(counts) <= set(self._listed)
            and self._statistics.channel_count <= len(self._listed)
            and {c.schema_id for c in self._listed.values()} <= {0, *self._schemas}
        )

    def _scan_from(self, at: int) -> int:
        """Register every record from `at` to the footer or to the first incomplete record. Returns
        the position at which it stopped."""
        last = -1  # time of the message before, if no chunk is between
        for opcode, body, length in records_in(self.file, at, self.size):
            if opcode == Opcode.FOOTER and length == _FOOTER_BYTES:
                self.file.seek(body + length)
                self.whole = self.file.read(len(MAGIC)) == MAGIC
                self._end = body + length + len(MAGIC)
                return at
            self._data_ended |= opcode == Opcode.DATA_END
            if opcode == Opcode.CHUNK:
                self._add_chunk(at)
                last = -1
            elif (time := self._register(self.file, opcode, body, length)) is not None:
                if last < 0 or time < last:
                    self._add_unit(time, at)
                last = time
            at = body + length
        if self.is_chunk(at):  # cut: what is there of it is read
            self._add_chunk(at)
        return at

    def _add_chunk(self, position: int) -> None:
        try:
            chunk = read_chunk_head(self.file, position, self.size)
        except DamagedError as error:
            self.fault(f"the chunk at byte {position} {error}; its frames are lost")
            return
        if chunk is not None:
            self.chunks[chunk.compression or "none"] += 1
            self._add_unit(chunk.start_time, position)

    def _add_unit(self, time: int, position: int) -> None:
        self.times.append(time)
        self.positions.append(position)

    def _register(self, file: IO[bytes], opcode: int, body: int, length: int) -> int | None:
        """Count a message, and return its time; or keep a definition, of which a damaged one is
        only counted."""
        file.seek(body)
        if opcode == Opcode.MESSAGE and length >= MESSAGE_HEAD.size:
            channel, _, time, _ = MESSAGE_HEAD.unpack(file.read(MESSAGE_HEAD.size))
            self.counts[channel] += 1
            first, last = self.span or (time, time)
            self.span = min(first, time), max(last, time)
            return int(time)
        if opcode not in _DEFINITIONS:
            return None
        stream = ReadDataStream(BytesIO(file.read(min(length, _MAX_DEFINITION_BYTES))))
        try:
            record = _DEFINITIONS[opcode].read(stream)
        except (struct.error, UnicodeDecodeError, McapError):
            self._damaged += 1
            return None
        if opcode == Opcode.HEADER:
            self.profile, self.library = record.profile, record.library
        elif opcode == Opcode.STATISTICS:
            self._statistics = record
            if record.message_count:
                self.span = record.message_start_time, record.message_end_time
        else:
            (self._schemas if opcode == Opcode.SCHEMA else self._listed)[record.id] = record
        return None

    def is_chunk(self, position: int) -> bool:
        """Whether the unit there is a chunk."""
        self.file.seek(position)
        return self.file.read(1) == bytes([Opcode.CHUNK])

    def chunk_at(self, position: int) -> Chunk:
        """The head of the chunk there. Raises DamagedError if it cannot be used."""
        chunk = read_chunk_head(self.file, position, self.size)
        if chunk is None:
            raise DamagedError("has no readable head")
        return chunk

    def _look_into(self, position: int) -> None:
        """Register the definitions inside a chunk and count its messages."""
        try:
            contents = open_chunk(self.file, self.chunk_at(position))
        except DamagedError:  # reported when the messages are read
            return
        for opcode, body, length in records_in(contents.file, contents.start, contents.end):
            self._register(contents.file, opcode, body, length)
        contents.release()

    def _indexed_positions(self) -> list[int]:
        """Positions of the chunks according to the summary, and of the summary itself, rising."""
        end = self.size - len(MAGIC) - _FOOTER_BYTES - RECORD_HEAD.size
        self.file.seek(max(end, 0))
        record = self.file.read()
        head = RECORD_HEAD.pack(Opcode.FOOTER, _FOOTER_BYTES)
        if not record.startswith(head) or not record.endswith(MAGIC):
            return []  # the recording does not end with a footer
        found = [int.from_bytes(record[len(head) : len(head) + 8], "little")]
        for opcode, body, length in records_in(self.file, found[0], end):
            if opcode == Opcode.CHUNK_INDEX and length >= 24:  # start, end, position of the chunk
                self.file.seek(body + 16)
                found.append(int.from_bytes(self.file.read(8), "little"))
        return sorted(p for p in found if 0 < p < end)


@dataclass(frozen=True, slots=True, order=True)
class _Position:
    """Where a message is: ordered by log time, then by position in the file. log_time,
    publish_time: ns. unit: position of the message's chunk in the file, or of the message itself if
    it is in no chunk. contents: what it is read from; None if the message is lost. offset, length:
    of the message's body in `contents`, bytes."""

    log_time: int
    unit: int
    offset: int
    channel: int = field(compare=False)
    publish_time: int = field(compare=False)
    contents: Contents | None = field(compare=False)
    length: int = field(compare=False)


class _Pass:
    """One pass over the messages of some channels of a file. spans: (position, first log time, last
    log time) of each unit that was read. back_ns: by how much times go back at most within a
    chunk."""

    def __init__(self, log: McapRecording, channels: Collection[int]) -> None:
        self._log, self._channels = log, frozenset(channels)
        # A heap, sorted by the next message of each run: (next message, the others, contents). A
        # chunk is one run, or none; its contents are released after its last message.
        self._runs: list[tuple[_Position, Iterator[_Position], Contents | None]] = []
        self._passed_count = self._lost_count = self._late_count = 0
        self._latest = 0  # log time
        self.spans: list[tuple[int, int, int]] = []
        self.back_ns = 0

    def messages(self) -> Iterator[Message]:
        """Yield the messages in log-time order; messages of equal time in the file's order. Raises
        SonarrecError if the file cannot be read any more."""
        log = self._log
        times, positions = (np.frombuffer(a, np.uint64) for a in (log.times, log.positions))
        try:
            for unit in np.lexsort((positions, times)):
                while self._runs and self._runs[0][0].log_time < log.times[unit]:
                    yield self._next()
                if log.is_chunk(position := log.positions[unit]):
                    self._open_chunk(position)
                else:
                    self._add_run(self._positions(Contents(log.file, position, log.size), None))
            while self._runs:
                yield self._next()
            if log.file.seek(0, 2) < log.size:
                log.fault("the file became shorter while it was read")
            if self._late_count:
                log.fault(
                    "a chunk states a later start than its messages have: "
                    f"{number_of(self._late_count, 'frame')} out of order"
                )
            count = sum(log.counts[c] for c in self._channels)
            if self._passed_count < count:
                gone = count - self._passed_count + self._lost_count
                log.fault(f"in all, {gone} of {count} frames are lost")
        except OSError as error:
            raise SonarrecError(f"{log.path}: cannot be read ({error.strerror})") from None

    def _next(self) -> Message:
        """The next message of all runs."""
        message, run, contents = heapq.heappop(self._runs)
        data, problem = None, None
        self._passed_count += 1
        self._late_count += message.log_time < self._latest
        self._latest = max(self._latest, message.log_time)
        if message.contents is None:
            self._lost_count += 1
        elif message.length > MAX_FRAME_BYTES:
            problem = f"a message of {message.length} bytes, more than is read"
        else:
            file = message.contents.file
            file.seek(message.offset + MESSAGE_HEAD.size)
            data = memoryview(file.read(message.length - MESSAGE_HEAD.size))
        self._add_run(run, contents)
        return Message(message.channel, message.log_time, message.publish_time, data, problem)

    def _add_run(self, run: Iterable[_Position], contents: Contents | None = None) -> None:
        """Merge in a run of messages. contents: of its chunk, to be released at its end."""
        run = iter(run)
        if (first := next(run, None)) is not None:
            heapq.heappush(self._runs, (first, run, contents))
        elif contents is not None:
            contents.release()

    def _positions(self, contents: Contents, unit: int | None) -> Iterator[_Position]:
        """The messages of the chosen channels. unit: the chunk that holds them; None: they are in
        none, and end at the next chunk, or where times go back."""
        file, last, low, high = contents.file, 0, 2**64, -1
        for opcode, body, length in records_in(file, contents.start, contents.end):
            if opcode == Opcode.CHUNK:
                break
            if opcode != Opcode.MESSAGE or length < MESSAGE_HEAD.size:
                continue
            file.seek(body)
            head = file.read(MESSAGE_HEAD.size)
            if len(head) < MESSAGE_HEAD.size:  # the file has become shorter
                break
            channel, _, time, publish_time = MESSAGE_HEAD.unpack(head)
            if unit is None and time < last:
                break
            last = time
            if channel in self._channels:
                low, high = min(low, time), max(high, time)
                self.back_ns = max(self.back_ns, high - time)
                position = body if unit is None else unit
                yield _Position(time, position, body, channel, publish_time, contents, length)
        if high >= 0:
            self.spans.append((contents.start if unit is None else unit, low, high))

    def _open_chunk(self, position: int) -> None:
        log, chunk = self._log, None
        try:
            chunk = log.chunk_at(position)
            contents = open_chunk(log.file, chunk)
        except DamagedError as error:
            self._lose(position, chunk, str(error))
            return
        end = contents.start
        for _, body, length in records_in(contents.file, end, contents.end):
            end = body + length
        if end < contents.end and not chunk.cut:
            where = f"is damaged at byte {end - contents.start} of its contents"
            self._lose(position, chunk, f"{where} (`mcap recover` may save some)")
            contents.release()
            return
        self._add_run(sorted(self._positions(contents, position)), contents)

    def _lose(self, position: int, chunk: Chunk | None, why: str) -> None:
        """Tell that a chunk is lost; the messages that the indexes behind it name keep their
        places."""
        file, found = self._log.file, list[_Position]()
        behind = self._log.size if chunk is None else chunk.end
        for opcode, body, length in records_in(file, behind, self._log.size):
            if opcode != Opcode.MESSAGE_INDEX or not _INDEX_HEAD.size <= length <= _MAX_INDEX_BYTES:
                break
            file.seek(body)
            record = file.read(length)
            channel, size = _INDEX_HEAD.unpack_from(record)
            pairs = record[_INDEX_HEAD.size : _INDEX_HEAD.size + size]
            if channel in self._channels and len(pairs) % 16 == 0:
                for time, offset in struct.iter_unpack("<QQ", pairs):
                    found.append(_Position(time, position, offset, channel, time, None, 0))
        number = f"{len(found)} " if found else ""
        self._log.fault(f"the chunk at byte {position} {why}; its {number}frames are lost")
        self._add_run(sorted(found))
