"""Reads the messages of an MCAP file in log-time order, whatever the order of its chunks.

Chunks are opened in the order of their first messages. Messages of chunks that overlap in time are
merged. Only the position of a message is kept until it is read.

A chunk without a checksum is compared with the message index behind it: from the first message that
is not where the index has it, the chunk's messages are lost. Lost messages that the index names
keep their places, so that later frames keep their numbers.
"""

from __future__ import annotations

import heapq
import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from mcap.opcode import Opcode

from sonarrec.errors import SonarrecError, number_of
from sonarrec.readers.containers.mcap.chunks import (
    RECORD_HEAD,
    ChunkHead,
    Contents,
    DamagedError,
)
from sonarrec.readers.containers.mcap.salvage import (
    CHUNK,
    FIRST_PRIVATE,
    MESSAGE_HEAD,
    McapFile,
    records_in,
)
from sonarrec.readers.containers.recording import Message
from sonarrec.readers.raw import MAX_FRAME_BYTES

_MAX_INDEX_BYTES = 2**20
_INDEX_HEAD = struct.Struct("<HI")  # channel, length of the entries
_INDEX_ENTRY = struct.Struct("<QQ")  # log time, offset in the chunk
_OF_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


@dataclass(frozen=True, slots=True, order=True)
class Position:
    """Where a message is: ordered by log time, then by position in the file.

    log_time, publish_time: ns. unit: of the message's chunk in the file, or of the message itself
    if it is in no chunk. contents: what it is read from; None if the message is lost. offset,
    length: of the message's body in `contents`, bytes.
    """

    log_time: int
    unit: int
    offset: int
    channel: int = field(compare=False)
    publish_time: int = field(compare=False)
    contents: Contents | None = field(compare=False)
    length: int = field(compare=False)


def positions(
    contents: Contents, at: int, unit: int | None, channels: Collection[int]
) -> Iterator[Position]:
    """The messages of some channels from `at` on. unit: the chunk; None: they are in none."""
    file = contents.file
    for opcode, body, length in records_in(contents, at):
        if opcode != Opcode.MESSAGE or length < MESSAGE_HEAD.size:
            continue
        file.seek(body)
        head = file.read(MESSAGE_HEAD.size)
        if len(head) < MESSAGE_HEAD.size:  # the file has become shorter
            return
        channel, _, log_time, publish_time = MESSAGE_HEAD.unpack(head)
        if channel in channels:
            chunk = body if unit is None else unit
            yield Position(log_time, chunk, body, channel, publish_time, contents, length)


class _Scan:
    """What one pass over a chunk found.

    end: where the last whole record ends. entries: (offset of the record in the chunk, channel, log
    time in ns) of each message of the chosen channels; 24 bytes of memory a message. oddities: how
    many records of each kind should not be there.
    """

    def __init__(
        self, contents: Contents, channels: Collection[int], defined: Collection[int]
    ) -> None:
        """defined: the channels that the file defines."""
        self.end, self.oddities = contents.start, Counter[str]()
        self.offsets, self.channels, self.times = array("Q"), array("Q"), array("Q")
        for opcode, body, length in records_in(contents, contents.start):
            self.end = body + length
            if opcode != Opcode.MESSAGE:
                if opcode not in _OF_CHUNKS and opcode < FIRST_PRIVATE:
                    self.oddities["records that no chunk may hold"] += 1
                continue
            contents.file.seek(body)
            head = contents.file.read(min(length, MESSAGE_HEAD.size))
            if len(head) < MESSAGE_HEAD.size:
                self.oddities["messages too short for a head"] += 1
                continue
            channel, _, time, _ = MESSAGE_HEAD.unpack(head)
            if channel in channels:
                self.offsets.append(body - RECORD_HEAD.size - contents.start)
                self.channels.append(channel)
                self.times.append(time)
            elif channel not in defined:
                self.oddities["messages of channels that nothing defines"] += 1

    def agreeing(self, index: list[tuple[int, int, int]]) -> int:
        """How many messages, from the first on, are as an index has them."""
        found = zip(self.offsets, self.channels, self.times, strict=True)
        unlike = (k for k, (a, b) in enumerate(zip(found, index, strict=False)) if a != b)
        return next(unlike, min(len(self.offsets), len(index)))

    def back_ns(self) -> int:
        """By how much times go back at most."""
        times = np.frombuffer(self.times, np.uint64)
        return int((np.maximum.accumulate(times) - times).max(initial=0))


class MessageReader:
    """One pass over the messages of some channels of a file.

    spans: (position, first log time, last log time) of each chunk that was read, and of each run of
    messages in no chunk. back_ns: by how much times go back at most within a chunk.
    """

    def __init__(self, log: McapFile, channels: Collection[int]) -> None:
        self._log = log
        self._channels = frozenset(channels)
        # A heap, sorted by the next message of each run: (next message, the others, contents). A
        # chunk is one run, or none; its contents are released after its last message.
        self._runs: list[tuple[Position, Iterator[Position], Contents | None]] = []
        self._passed_count = self._lost_count = 0
        self._last_time, self._in_order = 0, True
        self._all_checked = True  # by a checksum of its chunk
        self.spans: list[tuple[int, int, int]] = []
        self.back_ns = 0

    def __iter__(self) -> Iterator[Message]:
        """Yield the messages in log-time order; messages of equal time in the file's order.

        Damage is reported in the file's faults. Raises SonarrecError if the file cannot be read
        any more.
        """
        log = self._log
        times = np.frombuffer(log.times, np.uint64)
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
                    self._all_checked = False
                    everything = Contents(log.file, 0, log.size)
                    self._add_run(self._rising(everything, position, channel))
            while self._runs:
                yield self._next()
            self._report_faults()
        except OSError as error:
            raise SonarrecError(f"{log.path}: cannot be read ({error.strerror})") from None

    def _rising(self, contents: Contents, position: int, channel: int) -> Iterator[Position]:
        """The messages of a channel in no chunk, up to the first whose time goes back."""
        first, last = 2**64, 0
        for message in positions(contents, position, None, {channel}):
            if message.log_time < last:
                break
            first, last = min(first, message.log_time), message.log_time
            yield message
        self.spans.append((position, first, last))

    def _next(self) -> Message:
        """The next message of all runs."""
        at, run, contents = self._runs[0]
        data, problem = None, None
        self._passed_count += 1
        if at.contents is None:
            self._lost_count += 1
        elif at.length > MAX_FRAME_BYTES:
            problem = f"a message of {at.length} bytes, more than is read"
        else:
            at.contents.file.seek(at.offset + MESSAGE_HEAD.size)
            data = memoryview(at.contents.file.read(at.length - MESSAGE_HEAD.size))
        self._in_order &= at.log_time >= self._last_time
        self._last_time = at.log_time
        following = next(run, None)
        if following is not None:
            heapq.heapreplace(self._runs, (following, run, contents))
        else:
            heapq.heappop(self._runs)
            if contents is not None:
                self._log.store.release(contents)
        return Message(at.channel, at.log_time, at.publish_time, data, problem)

    def _add_run(self, run: Iterable[Position], contents: Contents | None = None) -> None:
        """Merge in a run of messages. contents: of its chunk, to be released at its end."""
        run = iter(run)
        first = next(run, None)
        if first is not None:
            heapq.heappush(self._runs, (first, run, contents))
        elif contents is not None:
            self._log.store.release(contents)

    def _open_chunk(self, position: int) -> None:
        log = self._log
        try:
            chunk = log.chunk_at(position)
        except DamagedError as error:  # overwritten since the file was opened
            log.fault(f"the chunk at byte {position} {error}; its frames are lost")
            return
        try:
            contents = log.store.open(chunk)
        except DamagedError as error:
            self._lose(chunk, self._indexed(chunk), f"{error}; its")
            return
        self._all_checked &= chunk.crc != 0
        found = _Scan(contents, self._channels, log.channels)
        count, stopped = len(found.offsets), found.end < contents.end
        if chunk.cut:
            share = chunk.size / max(found.end - contents.start, 1)
            if more := round(count * (share - 1)):
                log.fault(
                    f"by its size, the chunk that is cut held {number_of(more, 'more frame')}"
                )
        elif stopped or not chunk.crc:
            index = self._indexed(chunk)
            sound = found.agreeing(index)
            if stopped or (len(index) >= count and sound < len(index)):
                # An index that knows fewer messages than are there is of no help.
                count = sound if len(index) >= count else count
                at = [*found.offsets, found.end - contents.start][count]
                where = f"at byte {at} of its contents (`mcap recover` may save more)"
                self._lose(chunk, index[count:], f"is damaged {where}; its last")
        for oddity, number in found.oddities.items():
            log.fault(f"not read: {number} {oddity}, in the chunk at byte {position}")
        if count:
            times = np.frombuffer(found.times, np.uint64)[:count]
            self.spans.append((position, int(times.min()), int(times.max())))
            self.back_ns = max(self.back_ns, found.back_ns())
        self._add_run(self._by_time(contents, position, found, count), contents)

    def _by_time(
        self, contents: Contents, chunk: int, found: _Scan, count: int
    ) -> Iterator[Position]:
        """The first messages of a chunk by log time, those of equal time as in the file."""
        for k in np.argsort(np.frombuffer(found.times, np.uint64)[:count], kind="stable"):
            at = contents.start + found.offsets[k]
            yield from islice(positions(contents, at, chunk, self._channels), 1)

    def _indexed(self, chunk: ChunkHead) -> list[tuple[int, int, int]]:
        """(offset of the record in the chunk, channel, log time in ns), by rising offset, of the
        messages of the chosen channels by the indexes behind the chunk; empty if there are none.
        """
        log, entries = self._log, list[tuple[int, int, int]]()
        for opcode, body, length in records_in(Contents(log.file, chunk.end, log.size), chunk.end):
            if opcode != Opcode.MESSAGE_INDEX or length > _MAX_INDEX_BYTES:
                break
            log.file.seek(body)
            record = log.file.read(length)
            if len(record) < _INDEX_HEAD.size:
                break
            channel, size = _INDEX_HEAD.unpack_from(record)
            pairs = record[_INDEX_HEAD.size : _INDEX_HEAD.size + size]
            if channel in self._channels and len(pairs) % _INDEX_ENTRY.size == 0:
                pairs_read = _INDEX_ENTRY.iter_unpack(pairs)
                entries += [(offset, channel, time) for time, offset in pairs_read]
        return sorted(entries)

    def _lose(self, chunk: ChunkHead, index: list[tuple[int, int, int]], why: str) -> None:
        """Tell that messages of a chunk are lost; those that its index names keep their places."""
        number = f"{len(index)} " if index else ""
        self._log.fault(f"the chunk at byte {chunk.position} {why} {number}frames are lost")
        self._add_run(sorted(Position(t, chunk.position, at, c, t, None, 0) for at, c, t in index))

    def _report_faults(self) -> None:
        log = self._log
        if log.file.seek(0, 2) < log.size:
            log.fault("the file became shorter while it was read")
        count = sum(log.counts[c] for c in self._channels)
        if self._passed_count < count:
            gone = count - self._passed_count + self._lost_count
            log.fault(f"in all, {gone} of {count} frames are lost")
        if not self._in_order:
            log.fault("a chunk states a later time than it holds; frames are out of order there")
        if not self._all_checked and not log.data_are_sound():
            log.fault("its data fail their checksum; which frames are wrong cannot be known")
