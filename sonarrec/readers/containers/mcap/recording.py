"""An MCAP file as a recording: its messages in log-time order, whatever the order of its chunks.

Chunks are opened in the order of their first messages. Messages of chunks that overlap in time are
merged. Only the position of a message is kept until it is read.

A chunk that contradicts itself is not read. Lost messages that the index behind it names keep their
places, so that later frames keep their numbers.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Schema

from sonarrec.errors import Diagnostics, SonarrecError
from sonarrec.readers.containers.mcap.chunks import (
    ChunkHead,
    Contents,
    DamagedError,
    open_chunk,
)
from sonarrec.readers.containers.mcap.salvage import (
    CHUNK,
    MESSAGE_HEAD,
    McapFile,
    records_in,
)
from sonarrec.readers.containers.recording import Channel, Message, Recording
from sonarrec.readers.raw import MAX_FRAME_BYTES

_MAX_INDEX_BYTES = 2**20
_INDEX_HEAD = struct.Struct("<HI")  # channel, length of the entries
_INDEX_ENTRY = struct.Struct("<QQ")  # log time, offset in the chunk
_NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")


class McapRecording(Recording):
    """A `Recording` of an MCAP file. A damaged or cut file is read as far as possible."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if it is no MCAP file, OSError if it cannot be read."""
        super().__init__(path, diagnostics)
        log = self._log = McapFile(path, self.fault)
        for channel in log.channels.values():
            schema = log.schemas.get(channel.schema_id, _NO_SCHEMA)
            self.channels[channel.id] = Channel(
                channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding
            )
        if log.header is not None:
            self.profile, self.library = log.header.profile, log.header.library
        self.counts, self.chunks = log.counts, log.chunks
        self.span, self.whole = log.span, log.whole

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order; those of equal time as in the file."""
        run = _Pass(self._log, channels)
        yield from run.messages()
        self.note_set_back(((first, last) for _, first, last in sorted(run.spans)), run.back_ns)

    def close(self) -> None:
        """Close the file."""
        self._log.close()


@dataclass(frozen=True, slots=True, order=True)
class _Position:
    """Where a message is: ordered by log time, then by position in the file.

    log_time, publish_time: ns. unit: position of the message's chunk in the file, or of the message
    itself if it is in no chunk. contents: what it is read from; None if the message is lost.
    offset, length: of the message's body in `contents`, bytes.
    """

    log_time: int
    unit: int
    offset: int
    channel: int = field(compare=False)
    publish_time: int = field(compare=False)
    contents: Contents | None = field(compare=False)
    length: int = field(compare=False)


def _positions(
    contents: Contents, start: int, unit: int | None, channels: Collection[int]
) -> Iterator[_Position]:
    """The messages of some channels from `start` on. unit: the chunk; None: they are in none."""
    file = contents.file
    for opcode, body, length in records_in(contents, start):
        if opcode != Opcode.MESSAGE or length < MESSAGE_HEAD.size:
            continue
        file.seek(body)
        head = file.read(MESSAGE_HEAD.size)
        if len(head) < MESSAGE_HEAD.size:  # the file has become shorter
            return
        channel, _, log_time, publish_time = MESSAGE_HEAD.unpack(head)
        if channel in channels:
            chunk = body if unit is None else unit
            yield _Position(log_time, chunk, body, channel, publish_time, contents, length)


class _Pass:
    """One pass over the messages of some channels of a file.

    spans: (position, first log time, last log time) of each chunk that was read, and of each run of
    messages in no chunk. back_ns: by how much times go back at most within a chunk.
    """

    def __init__(self, log: McapFile, channels: Collection[int]) -> None:
        self._log = log
        self._channels = frozenset(channels)
        # A heap, sorted by the next message of each run: (next message, the others, contents). A
        # chunk is one run, or none; its contents are released after its last message.
        self._runs: list[tuple[_Position, Iterator[_Position], Contents | None]] = []
        self._passed_count = self._lost_count = 0
        self.spans: list[tuple[int, int, int]] = []
        self.back_ns = 0

    def messages(self) -> Iterator[Message]:
        """Yield the messages in log-time order; messages of equal time in the file's order. Raises
        SonarrecError if the file cannot be read any more."""
        log = self._log
        times = np.frombuffer(log.times, np.uint64)
        everything = Contents(log.file, 0, log.size)
        try:
            for unit in np.lexsort((np.frombuffer(log.positions, np.uint64), times)):
                channel, position = log.channels_of_units[unit], log.positions[unit]
                if channel != CHUNK and channel not in self._channels:
                    continue
                while self._runs and self._runs[0][0].log_time < log.times[unit]:
                    yield self._next()
                if channel == CHUNK:
                    self._open_chunk(position)
                else:
                    self._add_run(self._rising(everything, position, channel))
            while self._runs:
                yield self._next()
            if log.file.seek(0, 2) < log.size:
                log.fault("the file became shorter while it was read")
            count = sum(log.counts[c] for c in self._channels)
            if self._passed_count < count:
                gone = count - self._passed_count + self._lost_count
                log.fault(f"in all, {gone} of {count} frames are lost")
        except OSError as error:
            raise SonarrecError(f"{log.path}: cannot be read ({error.strerror})") from None

    def _rising(self, contents: Contents, position: int, channel: int) -> Iterator[_Position]:
        """The messages of a channel in no chunk, up to the first whose time goes back."""
        first, last = 2**64, 0
        for message in _positions(contents, position, None, {channel}):
            if message.log_time < last:
                break
            first, last = min(first, message.log_time), message.log_time
            yield message
        self.spans.append((position, first, last))

    def _next(self) -> Message:
        """The next message of all runs."""
        message, run, contents = self._runs[0]
        data, problem = None, None
        self._passed_count += 1
        if message.contents is None:
            self._lost_count += 1
        elif message.length > MAX_FRAME_BYTES:
            problem = f"a message of {message.length} bytes, more than is read"
        else:
            file = message.contents.file
            file.seek(message.offset + MESSAGE_HEAD.size)
            data = memoryview(file.read(message.length - MESSAGE_HEAD.size))
        heapq.heappop(self._runs)
        self._add_run(run, contents)
        return Message(message.channel, message.log_time, message.publish_time, data, problem)

    def _add_run(self, run: Iterable[_Position], contents: Contents | None = None) -> None:
        """Merge in a run of messages. contents: of its chunk, to be released at its end."""
        run = iter(run)
        first = next(run, None)
        if first is not None:
            heapq.heappush(self._runs, (first, run, contents))
        elif contents is not None:
            contents.release()

    def _open_chunk(self, position: int) -> None:
        log = self._log
        try:
            chunk = log.chunk_at(position)
        except DamagedError as error:  # overwritten since the file was opened
            log.fault(f"the chunk at byte {position} {error}; its frames are lost")
            return
        try:
            contents = open_chunk(log.file, chunk)
        except DamagedError as error:
            self._lose(chunk, str(error))
            return
        end = contents.start
        for _, body, length in records_in(contents, end):
            end = body + length
        if end < contents.end and not chunk.cut:
            where = f"is damaged at byte {end - contents.start} of its contents"
            self._lose(chunk, f"{where} (`mcap recover` may save some)")
            contents.release()
            return
        found = list(_positions(contents, contents.start, position, self._channels))
        if found:
            times = np.array([message.log_time for message in found], np.uint64)
            self.spans.append((position, int(times.min()), int(times.max())))
            self.back_ns = max(self.back_ns, int((np.maximum.accumulate(times) - times).max()))
        self._add_run(sorted(found), contents)

    def _indexed(self, chunk: ChunkHead) -> list[tuple[int, int, int]]:
        """(offset of the record in the chunk, channel, log time in ns), by rising offset, of the
        messages of the chosen channels by the indexes behind the chunk; empty if there are none."""
        log, entries = self._log, list[tuple[int, int, int]]()
        for opcode, body, length in records_in(Contents(log.file, chunk.end, log.size), chunk.end):
            if opcode != Opcode.MESSAGE_INDEX or not _INDEX_HEAD.size <= length <= _MAX_INDEX_BYTES:
                break
            log.file.seek(body)
            record = log.file.read(length)
            channel, size = _INDEX_HEAD.unpack_from(record)
            pairs = record[_INDEX_HEAD.size : _INDEX_HEAD.size + size]
            if channel in self._channels and len(pairs) % _INDEX_ENTRY.size == 0:
                pairs_read = _INDEX_ENTRY.iter_unpack(pairs)
                entries += [(offset, channel, time) for time, offset in pairs_read]
        return sorted(entries)

    def _lose(self, chunk: ChunkHead, why: str) -> None:
        """Tell that a chunk is lost; the messages that its index names keep their places."""
        index = self._indexed(chunk)
        number = f"{len(index)} " if index else ""
        self._log.fault(f"the chunk at byte {chunk.position} {why}; its {number}frames are lost")
        self._add_run(sorted(_Position(t, chunk.position, at, c, t, None, 0) for at, c, t in index))
